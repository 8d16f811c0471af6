"""Server of an emulated robot: TCP port or pseudo-terminal, one client at a time, wall-clock time."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import pty
import socket
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from select import select
from threading import Event
from typing import Any, Generic, Protocol, Self, TextIO, TypeVar
from urllib.parse import urlsplit

import numpy as np

from rejoint.arms.wire.orders import answer
from rejoint.arms.wire.values import Decoder, Frame, encode
from rejoint.robots.lab.emulator.faults import (
    NONE,
    SPLIT_PAUSE,
    ArmFaults,
    DeathError,
    EmulatedArm,
    Faults,
    LinkGoneError,
    WireFaults,
)
from rejoint.robots.lab.emulator.firmware import Firmware
from rejoint.system.errors import FileError
from rejoint.system.shell import listen_tcp


class TruthLog:
    """Writes the true tool and `time.monotonic`: CSV, a row per tick."""

    def __init__(self, path: Path, stream: TextIO, joints: int) -> None:
        self._path, self._stream = path, stream
        self._put(
            ["time", "x", "y", "z", *(f"{what}.joint{i + 1}" for what in ("encoder", "link") for i in range(joints))]
        )

    @classmethod
    def open(cls, path: Path, joints: int) -> TruthLog:
        """Begin a file; FileError."""
        try:
            stream = path.open("w", encoding="utf-8", buffering=1)
        except OSError as error:
            raise FileError(path, f"cannot be written ({error.strerror})", "choose another path") from error
        return cls(path, stream, joints)

    def write(self, now: float, arm: EmulatedArm) -> None:
        """Add a row: [s], [m], [rad]; FileError."""
        self._put(f"{value:.6f}" for value in [now, *arm.true_tcp, *arm.angles, *arm.true_links])

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


R = TypeVar("R")

MAX_CATCH_UP = 1.0
"""[s] caught up at once; longer suspensions are skipped (chosen)"""
HALF_FRAME_TIMEOUT = 0.05
"""[s] for the rest of a frame: 50 longest frames at 115200 baud (chosen)"""
TICK = 0.010
"""[s] longest step of the plant (chosen)"""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Answer times; measured on a myCobot 280: 12-15 ms for get_angles, 7-8 ms for an acknowledgement."""

    state: float = 0.012
    """[s] to a state's answer"""
    acknowledgement: float = 0.008
    """[s] to an acknowledgement"""
    jitter: float = 0.1
    """relative deviation of both (chosen)"""
    tick: float = TICK
    """[s] longest step of the plant"""
    pace: float = 1.0
    """simulated seconds per second; 1 with a controller"""


class ByteStream(Protocol):
    """A byte stream to one client."""

    def fileno(self) -> int:
        """Descriptor."""

    def receive(self) -> bytes:
        """Return arrived bytes; empty: the client is gone."""

    def send(self, data: bytes) -> None:
        """Send all bytes; OSError."""


def await_data(readable: int | None, pause: float) -> bool:
    """Wait for ``pause`` [s] or data on ``readable``; whether there is data."""
    return bool(select([] if readable is None else [readable], [], [], pause)[0])


class Finder(Protocol[R]):
    """Finds requests in a stream of bytes."""

    @property
    def pending(self) -> bool:
        """Whether a request has begun."""

    def feed(self, data: bytes) -> list[R]:
        """Take bytes; return whole requests."""

    def expire(self) -> list[R]:
        """Drop an unfinished request; return the requests inside."""


class Conversation(ABC, Generic[R]):
    """The robot's side of all conversations; one thread, one client at a time."""

    scheme: str
    """of TCP addresses"""

    def __init__(
        self,
        arm: EmulatedArm,
        *,
        timing: Timing | None = None,
        seed: int = 0,
        log: TruthLog | None = None,
        faults: Faults = NONE,
        clock: Callable[[], float] = time.monotonic,
        await_data: Callable[[int | None, float], bool] = await_data,
    ) -> None:
        self._timing = timing or Timing()
        self._emulated, self._tick, self._pace = arm, self._timing.tick, self._timing.pace
        self._log = log
        self._clock, self._await_data = clock, await_data
        self._wire, self._arm = WireFaults(faults, seed), ArmFaults(faults, arm)
        # when the first byte came
        self._began: float | None = None
        # when the newest bytes came; those that came while a request was worked on count as come with that one
        self._came = 0.0
        self._now: float | None = None
        self._stopping = Event()

    @property
    def stopping(self) -> bool:
        """Whether the end was asked for."""
        return self._stopping.is_set()

    def end(self) -> None:
        """Ask for the end, within a tick; thread-safe."""
        self._stopping.set()

    def wait(self, readable: int | None, until: float) -> bool:
        """Wait until ``until`` [s] or data on ``readable``; LinkGoneError or DeathError by faults."""
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
        """Wait for a link; DeathError."""
        while not self.stopping:
            try:
                self._wire.check(self._elapsed(self._catch_up()))
            except LinkGoneError:
                self._await_data(None, self._tick)
            else:
                return

    def converse(self, channel: ByteStream) -> None:
        """Serve one client until it is gone or the end."""
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
        """Make the request finder of a client."""

    @abstractmethod
    def _answer(self, channel: ByteStream, request: R) -> None:
        """Answer with the state at the request."""

    def _moves_on(self) -> bool:
        now = self._clock()
        left = self._wire.still_until(self._elapsed(now)) - self._elapsed(now)
        if left <= 0.0:
            return True
        self.wait(None, now + left)
        return not self.stopping

    def _elapsed(self, now: float) -> float:
        """[s] since the first byte, or -1."""
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


class WireSession(Conversation[Frame]):
    """One arm's ``firmware`` with the answer times ``timing``."""

    scheme = "tcp"

    def __init__(self, firmware: Firmware, *, seed: int = 0, **options: Any) -> None:  # noqa: ANN401
        super().__init__(firmware, seed=seed, **options)
        self._firmware = firmware
        self._rng = np.random.default_rng(seed)

    def _finder(self) -> Decoder:
        return Decoder()

    def _answer(self, channel: ByteStream, request: Frame) -> None:
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


BACKLOG = 1
"""Waiting clients, as in the vendor's server"""
SEND_TIMEOUT = 1.0
"""[s] before a client that takes no answers is dropped (chosen)"""
_CHUNK = 1024


class Server(ABC):
    """Serves in this thread (`run`) or its own (context manager)."""

    def __init__(self, session: Conversation[Any], address: str) -> None:
        self.address = address
        """such as ``tcp://127.0.0.1:9000``"""
        self._session = session
        self._thread: threading.Thread | None = None
        self.on_death: Callable[[], object] | None = None
        """called when a fault ends the emulator"""

    def run(self) -> None:
        """Serve until `stop`, a signal or a fault."""
        try:
            while not self._session.stopping:
                try:
                    self._serve()
                except LinkGoneError:
                    self._vanish()
        except DeathError:
            self._close()
            if self.on_death is not None:
                self.on_death()

    @abstractmethod
    def _serve(self) -> None:
        """Serve clients; LinkGoneError and DeathError."""

    @abstractmethod
    def _vanish(self) -> None:
        """Be unreachable without a link."""

    def start(self) -> None:
        """Serve in a thread."""
        self._thread = threading.Thread(target=self.run, name=f"emulator {self.address}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End serving and release the port."""
        self._session.end()
        if self._thread is not None:
            self._thread.join()
        self._close()

    @abstractmethod
    def _close(self) -> None:
        """Release the port."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class _SocketChannel:
    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.settimeout(SEND_TIMEOUT)

    def fileno(self) -> int:
        return self._connection.fileno()

    def receive(self) -> bytes:
        return self._connection.recv(_CHUNK)

    def send(self, data: bytes) -> None:
        self._connection.sendall(data)


class _TcpServer(Server):
    def __init__(self, session: Conversation[Any], listener: socket.socket) -> None:
        host, port = listener.getsockname()[:2]
        super().__init__(session, f"{session.scheme}://{host}:{port}")
        self._listener = listener

    def _serve(self) -> None:
        while not self._session.stopping:
            if not self._session.wait(self._listener.fileno(), float("inf")):
                continue
            try:
                connection, _ = self._listener.accept()
            except OSError:
                continue  # the client left before it was its turn
            with connection:
                self._session.converse(_SocketChannel(connection))

    def _vanish(self) -> None:
        host, port = self._listener.getsockname()[:2]
        self._listener.close()  # refuses clients, those in the backlog too
        self._session.outlast_absence()
        if not self._session.stopping:
            self._listener = listen_tcp(host, port, BACKLOG)

    def _close(self) -> None:
        self._listener.close()


class _TerminalChannel:
    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def fileno(self) -> int:
        return self._descriptor

    def receive(self) -> bytes:
        return os.read(self._descriptor, _CHUNK)

    def send(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # no reader: lost, as on a wire
            os.write(self._descriptor, data)


class _TerminalServer(Server):
    def __init__(self, session: Conversation[Any], own: int, client: int) -> None:
        super().__init__(session, f"{session.scheme.replace('tcp', 'serial')}://{os.ttyname(client)}?baud=1000000")
        self._own = own
        self._open = [client, own]

    def _serve(self) -> None:
        while not self._session.stopping:
            self._session.converse(_TerminalChannel(self._own))

    def _vanish(self) -> None:
        self._session.outlast_absence()
        with contextlib.suppress(BlockingIOError):
            while os.read(self._own, _CHUNK):
                pass  # what was written to a line that led nowhere is lost

    def _close(self) -> None:
        while self._open:  # an emulator that died has closed them already
            os.close(self._open.pop())


def beyond_loopback(address: str) -> bool:
    """Whether other machines can reach ``address``."""
    place = urlsplit(address)
    return place.hostname is not None and not ipaddress.ip_address(place.hostname).is_loopback


def serve_tcp(firmware: Firmware, host: str = "127.0.0.1", port: int = 9000, **options: Any) -> Server:  # noqa: ANN401
    """Listen on a TCP port (0: any free one); InputError. ``options`` as in `WireSession`."""
    return on_port(WireSession(firmware, **options), host, port)


def serve_pty(firmware: Firmware, **options: Any) -> Server:  # noqa: ANN401
    """Open a pseudo-terminal; run the server to serve."""
    return on_terminal(WireSession(firmware, **options))


def on_port(session: Conversation[Any], host: str = "127.0.0.1", port: int = 0) -> Server:
    """Serve a conversation on a TCP port (0: any free one); InputError."""
    return _TcpServer(session, listen_tcp(host, port, BACKLOG))


def on_terminal(session: Conversation[Any]) -> Server:
    """Serve a conversation on a pseudo-terminal.

    The client's end stays open in raw mode: no echo, no failure.
    """
    own, client = pty.openpty()
    tty.setraw(client)
    os.set_blocking(own, False)
    return _TerminalServer(session, own, client)
