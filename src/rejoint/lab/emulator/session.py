"""One conversation after another with an emulated robot, in wall-clock time.

The plant is moved on by the elapsed time before every request and at least every tick, so nothing
jumps when somebody asks. An answer leaves in one piece, after the time a real robot takes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from select import select
from threading import Event
from typing import Protocol

import numpy as np

from rejoint.arms.wire.commands import answer
from rejoint.arms.wire.frames import Decoder, Frame, encode
from rejoint.lab.emulator.armfaults import ArmFaults
from rejoint.lab.emulator.faults import NONE, Faults
from rejoint.lab.emulator.firmware import Firmware
from rejoint.lab.emulator.truthlog import TruthLog
from rejoint.lab.emulator.wirefaults import SPLIT_PAUSE, LinkGoneError, WireFaults

MAX_CATCH_UP = 1.0
"""[s] of simulated time made up for at once; a longer suspension of the process is skipped (chosen)"""
HALF_FRAME_TIMEOUT = 0.05
"""[s] to wait for the rest of a frame: 50 times the length of the longest at 115200 baud (chosen)"""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """How long answers take; measured on a myCobot 280: 12-15 ms for get_angles, 7-8 ms for an acknowledgement."""

    state: float = 0.012
    """[s] from the request to the answer that reports a state"""
    acknowledgement: float = 0.008
    """[s] from an order to its acknowledgement"""
    jitter: float = 0.1
    """relative standard deviation of both (chosen)"""
    tick: float = 0.010
    """[s] at most between two advances of the plant (chosen)"""
    pace: float = 1.0
    """simulated seconds per second of the wall clock; anything but 1 is for experiments without a controller"""


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


class Session:
    """The robot's side of all conversations; one thread, one client at a time.

    ``clock`` [s] and ``await_data`` are the world's; a test that is in a hurry brings its own. ``faults`` begin with
    the first byte of the first client.
    """

    def __init__(
        self,
        firmware: Firmware,
        *,
        timing: Timing,
        seed: int = 0,
        log: TruthLog | None = None,
        faults: Faults = NONE,
        clock: Callable[[], float] = time.monotonic,
        await_data: Callable[[int | None, float], bool] = await_data,
    ) -> None:
        self._firmware = firmware
        self._timing = timing
        self._rng = np.random.default_rng(seed)
        self._log = log
        self._clock, self._await_data = clock, await_data
        self._wire, self._arm = WireFaults(faults, seed), ArmFaults(faults, firmware)
        self._began: float | None = None
        """when the first byte came"""
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
            pause = max(0.0, min(until - now, self._timing.tick))
            if self._await_data(readable, pause):
                return True
            if self._clock() >= until:
                break
        self._catch_up()
        return False

    def outlast_absence(self) -> None:
        """Let time pass until there is a link again; DeathError if the emulator has to end first."""
        while not self.stopping:
            try:
                self._wire.check(self._elapsed(self._catch_up()))
            except LinkGoneError:
                self._await_data(None, self._timing.tick)
            else:
                return

    def converse(self, channel: ByteStream) -> None:
        """Answer one client until it is gone or the end was asked for."""
        decoder = Decoder()
        try:
            while not self.stopping:
                requests = self._receive(channel, decoder)
                if requests is None:
                    return
                for request in requests:
                    self._answer(channel, request)
        except OSError:
            return  # a client that breaks the connection is gone, like one that closes it

    def _receive(self, channel: ByteStream, decoder: Decoder) -> list[Frame] | None:
        """Return the requests that came within a tick; None if the client is gone."""
        timeout = HALF_FRAME_TIMEOUT if decoder.pending else self._timing.tick
        if not self.wait(channel.fileno(), self._clock() + timeout):
            return decoder.expire()
        if not self._moves_on():
            return []
        data = channel.receive()
        if not data:
            return None
        if self._began is None:
            self._began = self._clock()
            self._arm.advance(0.0)
        return decoder.feed(data)

    def _answer(self, channel: ByteStream, request: Frame) -> None:
        """Answer with the state at the moment of the request: it is as old as its way back takes."""
        reply = answer(self._firmware, request)
        if reply is None:
            return
        self._arm.was_asked(request.command)
        mean = self._timing.state if reply.is_state else self._timing.acknowledgement
        delay = mean * max(0.0, 1.0 + self._timing.jitter * self._rng.standard_normal())
        self.wait(None, self._clock() + delay + self._wire.delay)
        for place, piece in enumerate(self._wire.pieces(encode(request), encode(reply.frame))):
            if place:
                self.wait(None, self._clock() + SPLIT_PAUSE)
            if self._moves_on():
                channel.send(piece)

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
            self._firmware.advance(min(now - self._now, MAX_CATCH_UP) * self._timing.pace)
            self._now = now
            if self._log is not None:
                self._log.write(now, self._firmware)
        return now
