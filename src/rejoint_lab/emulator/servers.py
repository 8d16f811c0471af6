"""Server of an emulated robot in wall-clock time."""

from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rejoint.robots.mycobot.wire import COMMANDS, FORMAT, Frame, answer, encode
from rejoint.robots.wireserver import (
    ByteStream,
    Conversation,
    LinkGoneError,
    Server,
    TcpServer,
)
from rejoint.system.files import writing
from rejoint.system.shell import listen_tcp
from rejoint_lab.emulator.faults import (
    NONE,
    SPLIT_PAUSE,
    EmulatedArm,
    Faults,
    WireFaults,
)
from rejoint_lab.emulator.firmware import Firmware


class TruthLog:
    """Writes the true tool and `time.monotonic`: CSV, a row per tick; FileError."""

    def __init__(self, path: Path, joints: int) -> None:
        self._path = path
        with writing(path):
            self._stream = path.open("a", encoding="utf-8", buffering=1)
        names = [f"{what}.joint{i + 1}" for what in ("encoder", "link") for i in range(joints)]
        self._titles = ",".join(["time", "x", "y", "z", *names]) + "\n"

    def write(self, now: float, arm: EmulatedArm) -> None:
        """Add a row: [s], [m], [rad]; the first one replaces what the file held."""
        row = [now, *arm.plant.true_tcp()[0], *arm.angles, *arm.plant.link_position()[0]]
        with writing(self._path):
            if self._titles:
                self._stream.truncate(0)
            self._stream.write(self._titles + ",".join(f"{value:.6f}" for value in row) + "\n")
        self._titles = ""

    def close(self) -> None:
        """Finish the file."""
        self._stream.close()


R = TypeVar("R")

MAX_CATCH_UP = 1.0
"""[s] caught up at once; longer suspensions are skipped (chosen)"""


class EmulatedConversation(Conversation[R]):
    """Lets the time of an emulated arm pass, and applies faults."""

    tick, pace = 0.010, 1.0
    """[s] longest step of the plant (chosen), and simulated seconds per second: 1 with a controller"""

    def __init__(self, arm: EmulatedArm, *, seed: int = 0, log: TruthLog | None = None, faults: Faults = NONE) -> None:
        self._emulated, self._log = arm, log
        self._wire = WireFaults(faults, seed)
        arm.faults = faults
        # when the first byte came
        self._began: float | None = None
        # when the newest bytes came; those that came while a request was worked on count as come with that one
        self._came = 0.0
        self._now: float | None = None

    def outlast_absence(self) -> None:
        """Wait for a link; DeathError."""
        while not self.stopping:
            try:
                self._look(None)
            except LinkGoneError:
                self.await_data(None, self.tick)
            else:
                break

    def converse(self, channel: ByteStream) -> None:
        """Serve one client until it is gone or the end."""
        self._came = self.clock()
        super().converse(channel)

    def _hear(self, channel: ByteStream, timeout: float) -> bytes | None:
        lay_there = self.await_data(channel.fileno(), 0.0)
        if not self.wait(channel.fileno(), self.clock() + timeout) or not self._moves_on():
            return None
        if not lay_there:
            self._came = self.clock()
        data = channel.receive()
        if data and self._began is None:
            self._began = self.clock()
            self._emulated.suffer(0.0)
        return data

    def _say(self, channel: ByteStream, pieces: list[bytes]) -> None:
        for place, piece in enumerate(pieces):
            if place:
                self.wait(None, self.clock() + SPLIT_PAUSE)
            if self._moves_on() and piece:
                channel.send(piece)

    def _moves_on(self) -> bool:
        now = self.clock()
        left = self._wire.still_until(self._elapsed(now)) - self._elapsed(now)
        if left <= 0.0:
            return True
        self.wait(None, now + left)
        return not self.stopping

    def _elapsed(self, now: float) -> float:
        """[s] since the first byte, or -1."""
        return -1.0 if self._began is None else now - self._began

    def _look(self, readable: int | None) -> None:  # noqa: ARG002 - time passes in any wait
        self._wire.check(self._elapsed(self._catch_up()))

    def _catch_up(self) -> float:
        now = self.clock()
        if self._now is None:
            self._now = now
        if now - self._now >= 1e-3:
            if self._began is not None:
                self._emulated.suffer(self._elapsed(now))
            self._emulated.advance(min(now - self._now, MAX_CATCH_UP) * self.pace)
            self._now = now
            if self._log is not None:
                self._log.write(now, self._emulated)
        return now


READINGS = frozenset({0x20, 0x23, 0x3B, 0x3D, 0xD5})
"""Questions that read encoders"""


class WireSession(EmulatedConversation[Frame]):
    """One arm's ``firmware``, with answer times as measured on a myCobot 280."""

    wire_format = FORMAT
    state, acknowledgement, jitter = 0.012, 0.008, 0.1
    """[s] to the answer of a state and an acknowledgement, and relative deviation of both (chosen)"""

    def __init__(self, firmware: Firmware, *, seed: int = 0, **options: Any) -> None:  # noqa: ANN401
        super().__init__(firmware, seed=seed, **options)
        self._firmware, self._rng = firmware, np.random.default_rng(seed)

    def _answer(self, channel: ByteStream, request: Frame) -> None:
        self._catch_up()
        reply = answer(self._firmware, request)
        if reply is None:
            return
        if request.command in READINGS:
            self._emulated.was_read()
        mean = self.state if request.command not in COMMANDS else self.acknowledgement
        delay = mean * max(0.0, 1.0 + self.jitter * self._rng.standard_normal())
        self.wait(None, self.clock() + delay + self._wire.delay)
        self._say(channel, self._wire.pieces(encode(request), encode(reply)))


def on_port(session: Conversation[Any], host: str = "127.0.0.1", port: int = 0) -> Server:
    """Serve a conversation on a TCP port (0: any free one); InputError."""
    return TcpServer(session, listen_tcp(host, port))
