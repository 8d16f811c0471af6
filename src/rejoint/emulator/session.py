"""One conversation after another with an emulated robot, in wall-clock time.

The plant is moved on by the elapsed time before every request and at least every tick, so nothing
jumps when somebody asks. An answer leaves in one piece, after the time a real robot takes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from select import select
from threading import Event
from typing import Protocol, TextIO

import numpy as np

from rejoint.emulator.commands import answer
from rejoint.emulator.firmware import Firmware
from rejoint.emulator.frames import Decoder, Frame, encode
from rejoint.errors import FileError

MAX_CATCH_UP = 1.0
"""[s] of simulated time made up for at once; a longer suspension of the process is skipped (chosen)"""
HALF_FRAME_PATIENCE = 0.05
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


class Channel(Protocol):
    """A byte stream to one client."""

    def fileno(self) -> int:
        """Descriptor to wait on."""

    def receive(self) -> bytes:
        """Return what has arrived; nothing means that the client is gone."""

    def send(self, data: bytes) -> None:
        """Send everything; OSError if the client is gone."""


class TruthLog:
    """Writes where the tool really is beside the wall clock, for experiments: CSV, one row a tick.

    The clock is `time.monotonic`, the one that the driver stamps joint states with; on one machine
    the two can be laid side by side.
    """

    def __init__(self, path: Path, stream: TextIO, joints: int) -> None:
        self._path, self._stream = path, stream
        self._put(["time", "x", "y", "z", *(f"encoder.joint{i + 1}" for i in range(joints))])

    @classmethod
    def open(cls, path: Path, joints: int) -> TruthLog:
        """Begin a new file; FileError if that is not possible."""
        try:
            stream = path.open("w", encoding="utf-8", buffering=1)
        except OSError as error:
            raise FileError(path, f"cannot be written ({error.strerror})", "choose another path") from error
        return cls(path, stream, joints)

    def write(self, now: float, firmware: Firmware) -> None:
        """Add a row: [s], [m], [rad]. FileError if the disk is full."""
        self._put(f"{value:.6f}" for value in [now, *firmware.true_tcp, *firmware.angles])

    def _put(self, row: Iterable[str]) -> None:
        try:
            self._stream.write(",".join(row) + "\n")
        except OSError as error:
            raise FileError(
                self._path, f"cannot be written ({error.strerror})", "make room or log elsewhere"
            ) from error

    def close(self) -> None:
        """Finish the file."""
        self._stream.close()


class Session:
    """The robot's side of all conversations; one thread, one client at a time."""

    def __init__(
        self,
        firmware: Firmware,
        *,
        timing: Timing,
        seed: int = 0,
        log: TruthLog | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._firmware = firmware
        self._timing = timing
        self._rng = np.random.default_rng(seed)
        self._log = log
        self._clock = clock
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
        """Let time pass until the clock shows ``until`` or the descriptor ``readable`` has data."""
        while not self.stopping:
            now = self._catch_up()
            pause = max(0.0, min(until - now, self._timing.tick))
            if select([] if readable is None else [readable], [], [], pause)[0]:
                return True
            if self._clock() >= until:
                break
        self._catch_up()
        return False

    def converse(self, channel: Channel) -> None:
        """Answer one client until it is gone or the end was asked for."""
        decoder = Decoder()
        try:
            while not self.stopping:
                patience = HALF_FRAME_PATIENCE if decoder.pending else self._timing.tick
                if self.wait(channel.fileno(), self._clock() + patience):
                    data = channel.receive()
                    if not data:
                        return
                    requests = decoder.feed(data)
                else:
                    requests = decoder.expire()
                for request in requests:
                    self._answer(channel, request)
        except OSError:
            return  # a client that breaks the connection is gone, like one that closes it

    def _answer(self, channel: Channel, request: Frame) -> None:
        """Answer with the state at the moment of the request: it is as old as its way back takes."""
        reply = answer(self._firmware, request)
        if reply is None:
            return
        mean = self._timing.state if reply.is_state else self._timing.acknowledgement
        delay = mean * max(0.0, 1.0 + self._timing.jitter * self._rng.standard_normal())
        self.wait(None, self._clock() + delay)
        channel.send(encode(reply.frame))

    def _catch_up(self) -> float:
        now = self._clock()
        if self._now is None:
            self._now = now
        if now - self._now >= 1e-3:
            self._firmware.advance(min(now - self._now, MAX_CATCH_UP) * self._timing.pace)
            self._now = now
            if self._log is not None:
                self._log.write(now, self._firmware)
        return now
