"""The world of an emulated robot without waiting: a clock that is put forward, and a client that never tires."""

import math
import socket
import struct
from collections.abc import Callable, Iterable, Iterator

from rejoint_lab.emulator.faults import Faults
from rejoint_lab.emulator.firmware import Firmware
from rejoint_lab.emulator.servers import WireSession

START = 1e6
"""[s] that the clock shows at first: as large as that of a machine that has been up for twelve days (chosen)"""


def endpoint(address: str) -> tuple[str, int]:
    """Host and port of ``tcp://HOST:PORT``."""
    host, port = address.removeprefix("tcp://").rsplit(":", 1)
    return host, int(port)


def reset_at_end(client: socket.socket) -> None:
    """Let a connection end by a reset instead of a farewell."""
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


class VirtualClient:
    """Asks ``requests`` one after the other, each when the answer to the last is there or ``patience`` [s] is over."""

    def __init__(
        self, firmware: Firmware, *, timing: dict[str, float] | None = None, faults: Faults | None = None, seed: int = 0
    ) -> None:
        self.now = START
        self.end = math.inf
        """when [s] the session ends by itself"""
        self.session = WireSession(
            firmware,
            seed=seed,
            faults=faults or {},
        )
        vars(self.session).update(timing or {})
        self.session.clock, self.session.await_data = lambda: self.now, self._await
        self.sent: Callable[[float, bytes], object] = lambda _now, _data: None
        """is told what the robot sends, and when [s]"""
        self._requests: Iterator[bytes] = iter(())
        self._ask_at, self._patience, self._pause = START, 0.3, 0.0

    def ask(self, requests: Iterable[bytes], *, pause: float = 0.0, patience: float = 0.3) -> None:
        """Hold a conversation, with ``pause`` [s] between an answer and the next request."""
        self._requests, self._pause, self._patience = iter(requests), pause, patience
        self._ask_at = self.now
        self.session.converse(self)

    def wait(self, duration: float) -> None:
        """Let ``duration`` [s] pass."""
        self.session.wait(None, self.now + duration)

    def fileno(self) -> int:
        """Stand for a descriptor, which nobody opens."""
        return -1

    def receive(self) -> bytes:
        """Give the session the next request, or the news that there are no more."""
        self._ask_at = self.now + self._patience
        return next(self._requests, b"")

    def send(self, data: bytes) -> None:
        """Take what the robot sends."""
        self.sent(self.now, data)
        self._ask_at = self.now + self._pause

    def _await(self, readable: int | None, pause: float) -> bool:
        if self.now >= self.end:
            self.session.stopping = True
        if readable is None:
            self.now += pause
            return False
        self.now = max(self.now, min(self.now + pause, self._ask_at))
        return self._ask_at <= self.now
