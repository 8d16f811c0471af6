"""One conversation after another with an emulated robot, in wall-clock time, whatever its wire speaks.

The plant is moved on by the elapsed time before every request and at least every tick, so nothing
jumps when somebody asks.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from select import select
from threading import Event
from typing import Generic, Protocol, TypeVar

from rejoint.robots.lab.emulator.armfaults import ArmFaults
from rejoint.robots.lab.emulator.armlike import ArmLike
from rejoint.robots.lab.emulator.faults import NONE, Faults
from rejoint.robots.lab.emulator.truthlog import TruthLog
from rejoint.robots.lab.emulator.wirefaults import LinkGoneError, WireFaults

R = TypeVar("R")

MAX_CATCH_UP = 1.0
"""[s] of simulated time made up for at once; a longer suspension of the process is skipped (chosen)"""
HALF_FRAME_TIMEOUT = 0.05
"""[s] to wait for the rest of a frame: 50 times the length of the longest at 115200 baud (chosen)"""
TICK = 0.010
"""[s] at most between two advances of the plant (chosen)"""


class ByteStream(Protocol):
    """A byte stream to one client."""

    def fileno(self) -> int:
        """Descriptor to wait on."""

    def receive(self) -> bytes:
        """Return what has arrived; nothing means that the client is gone."""

    def send(self, data: bytes) -> None:
        """Send everything; OSError if the client is gone."""


def await_data(readable: int | None, pause: float) -> bool:
    """Wait for ``pause`` [s] or until the descriptor ``readable`` has data; whether it has."""
    return bool(select([] if readable is None else [readable], [], [], pause)[0])


class Finder(Protocol[R]):
    """Finds requests in a stream of bytes."""

    @property
    def pending(self) -> bool:
        """Whether the beginning of a request is there, so that its rest is awaited."""

    def feed(self, data: bytes) -> list[R]:
        """Take bytes; return the requests that are whole now."""

    def expire(self) -> list[R]:
        """Give up the request whose rest did not come; return those that stood inside it."""


class Conversation(ABC, Generic[R]):
    """The robot's side of all conversations; one thread, one client at a time.

    ``tick`` [s] passes at most between two advances of the plant, and ``pace`` simulated seconds per second of the wall
    clock; anything but 1 is for experiments without a controller. ``clock`` [s] and ``await_data`` are the world's; a
    test that is in a hurry brings its own. ``faults`` begin with the first byte of the first client.
    """

    def __init__(
        self,
        arm: ArmLike,
        *,
        tick: float = TICK,
        pace: float = 1.0,
        seed: int = 0,
        log: TruthLog | None = None,
        faults: Faults = NONE,
        clock: Callable[[], float] = time.monotonic,
        await_data: Callable[[int | None, float], bool] = await_data,
    ) -> None:
        self._emulated, self._tick, self._pace = arm, tick, pace
        self._log = log
        self._clock, self._await_data = clock, await_data
        self._wire, self._arm = WireFaults(faults, seed), ArmFaults(faults, arm)
        self._began: float | None = None
        """when the first byte came"""
        self._came = 0.0
        """when the newest bytes came; those that came while a request was worked on count as come with that one"""
        self._now: float | None = None
        self._stopping = Event()

    @property
    def stopping(self) -> bool:
        """Whether the end was asked for."""
        return self._stopping.is_set()

    def end(self) -> None:
        """Ask for the end; the conversation stops within a tick. May be called from any thread."""
        self._stopping.set()

    def wait(self, readable: int | None, until: float) -> bool:
        """Let time pass until the clock shows ``until`` or the descriptor ``readable`` has data.

        LinkGoneError while there is no link, DeathError if the emulator has to end.
        """
        while not self.stopping:
            now = self._catch_up()
            self._wire.check(self._elapsed(now))
            pause = max(0.0, min(until - now, self._tick))
            if self._await_data(readable, pause):
                return True
            if self._clock() >= until:
                break
        return False

    def outlast_absence(self) -> None:
        """Let time pass until there is a link again; DeathError if the emulator has to end first."""
        while not self.stopping:
            try:
                self._wire.check(self._elapsed(self._catch_up()))
            except LinkGoneError:
                self._await_data(None, self._tick)
            else:
                return

    def converse(self, channel: ByteStream) -> None:
        """Answer one client until it is gone or the end was asked for."""
        finder = self._finder()
        self._came = self._clock()
        try:
            while not self.stopping:
                requests = self._receive(channel, finder)
                if requests is None:
                    return
                for request in requests:
                    self._catch_up()
                    self._answer(channel, request)
        except OSError:
            return  # a client that breaks the connection is gone, like one that closes it

    def _receive(self, channel: ByteStream, finder: Finder[R]) -> list[R] | None:
        """Return the requests that came within a tick; None if the client is gone."""
        timeout = HALF_FRAME_TIMEOUT if finder.pending else self._tick
        lay_there = self._await_data(channel.fileno(), 0.0)
        if not self.wait(channel.fileno(), self._clock() + timeout):
            return finder.expire()
        if not self._moves_on():
            return []
        if not lay_there:
            self._came = self._clock()
        data = channel.receive()
        if not data:
            return None
        if self._began is None:
            self._began = self._clock()
            self._arm.advance(0.0)
        return finder.feed(data)

    @abstractmethod
    def _finder(self) -> Finder[R]:
        """Make what finds the requests of a new client."""

    @abstractmethod
    def _answer(self, channel: ByteStream, request: R) -> None:
        """Answer with the state at the moment of the request."""

    def _moves_on(self) -> bool:
        """Let time pass while the link stands still; False if the end was asked for meanwhile."""
        now = self._clock()
        left = self._wire.still_until(self._elapsed(now)) - self._elapsed(now)
        if left <= 0.0:
            return True
        self.wait(None, now + left)
        return not self.stopping

    def _elapsed(self, now: float) -> float:
        """[s] since the first byte, -1 before it."""
        return -1.0 if self._began is None else now - self._began

    def _catch_up(self) -> float:
        now = self._clock()
        if self._now is None:
            self._now = now
        if now - self._now >= 1e-3:
            if self._began is not None:
                self._arm.advance(self._elapsed(now))
            self._emulated.advance(min(now - self._now, MAX_CATCH_UP) * self._pace)
            self._now = now
            if self._log is not None:
                self._log.write(now, self._emulated)
        return now
