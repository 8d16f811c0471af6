"""Servers of a robot's wire: TCP port or pseudo-terminal, one client at a time."""

import contextlib
import os
import pty
import select
import socket
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

from rejoint.system.shell import listen_tcp

R = TypeVar("R")

HALF_FRAME = 0.05
"""[s] for the rest of a frame: 50 longest frames at 115200 baud (chosen)"""
TICK = 0.05
"""[s] of one wait (chosen)"""
SEND_TIMEOUT = 1.0
"""[s] before a client that takes nothing counts as gone (chosen)"""
QUIET_AFTER = 5
"""[s] of silence after which a client's machine is asked whether it runs"""
_CHUNK = 1024


class Format(NamedTuple, Generic[R]):
    """How frames lie in a stream of bytes."""

    header: bytes
    head: int
    """[bytes] that say the size of a frame"""
    size: Callable[[bytes], int]
    """of a frame by its head; 0: none begins there"""
    read: Callable[[bytes], R | None]
    """a frame of that size; None: spoilt"""
    write: Callable[[R], bytes]


class Finder(Generic[R]):
    """Finds frames in a stream."""

    def __init__(self, wire_format: Format[R]) -> None:
        self._format = wire_format
        self.rest = b""
        """what may begin a frame"""

    def feed(self, data: bytes) -> list[R]:
        """Take bytes; return completed frames."""
        self.rest += data
        header, frames = self._format.header, list[R]()
        while (start := self.rest.find(header)) >= 0:
            self.rest = self.rest[start:]
            if len(self.rest) < self._format.head or len(self.rest) < (size := self._format.size(self.rest)):
                return frames
            frame = self._format.read(self.rest[:size]) if size else None
            if frame is not None:
                frames.append(frame)
            self.rest = self.rest[1 if frame is None else size :]
        self.rest = self.rest[1 - len(header) :]
        return frames

    def expire(self) -> list[R]:
        """Drop a half frame; return the frames behind its header."""
        frames = []
        while self.rest:
            held, self.rest = self.rest, b""
            frames += self.feed(held[1:])
        return frames


class LinkGoneError(Exception):
    """The port is to be gone until `Conversation.outlast_absence` returns."""


class DeathError(Exception):
    """The server must end silently."""


class ByteStream(Protocol):
    """A byte stream to one client."""

    def fileno(self) -> int:
        """Descriptor."""

    def receive(self) -> bytes:
        """Return arrived bytes; empty: the client is gone."""

    def send(self, data: bytes) -> None:
        """Send all bytes; OSError."""


def await_data(readable: int | None, pause: float) -> bool:
    """Wait for ``pause`` [s] or data; whether there is data."""
    return bool(select.select([] if readable is None else [readable], [], [], pause)[0])


class Conversation(ABC, Generic[R]):
    """The robot's side of all conversations, in one thread."""

    scheme = "tcp"
    """of TCP addresses"""
    wire_format: Format[R]
    tick = TICK
    clock = staticmethod(time.monotonic)
    await_data = staticmethod(await_data)
    stopping = False
    """asks for the end, within a tick; any thread may set it"""

    def wait(self, readable: int | None, until: float) -> bool:
        """Wait until ``until`` [s] or data on ``readable``; LinkGoneError or DeathError."""
        while not self.stopping:
            self._look(readable)
            if self.await_data(readable, max(0.0, min(until - self.clock(), self.tick))):
                return True
            if self.clock() >= until:
                break
        return False

    def converse(self, channel: ByteStream) -> None:
        """Serve one client until it is gone or the end."""
        finder = Finder(self.wire_format)
        with contextlib.suppress(OSError):  # a client that breaks the connection is gone, like one that closes it
            while not self.stopping:
                data = self._hear(channel, HALF_FRAME if finder.rest else self.tick)
                if data == b"":
                    return
                for request in finder.expire() if data is None else finder.feed(data):
                    self._answer(channel, request)

    def came(self, client: str) -> None:
        """Note a client."""

    def left(self, client: str) -> None:
        """Note that a client is gone."""

    def outlast_absence(self) -> None:
        """Wait until the port may come back; DeathError."""

    @abstractmethod
    def _answer(self, channel: ByteStream, request: R) -> None:
        """Answer a request."""

    def _look(self, readable: int | None) -> None:
        """Do what is due during a wait."""

    def _hear(self, channel: ByteStream, timeout: float) -> bytes | None:
        """Return bytes within ``timeout`` [s], empty: gone; None: silence."""
        return channel.receive() if self.wait(channel.fileno(), self.clock() + timeout) else None


class Server(ABC):
    """Serves in this thread (`run`) or its own."""

    def __init__(self, session: Conversation[Any], address: str) -> None:
        self.address = address
        """where a client finds it, such as ``tcp://127.0.0.1:9000``"""
        self._session = session
        self._thread = threading.Thread(target=self._run, name=f"serve {address}", daemon=True)
        self.failure: Exception | None = None
        """a bug that ended the thread"""
        self.died = False
        """a fault ended the server"""

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
            self.died = True

    def _run(self) -> None:
        try:
            self.run()
        except Exception as error:  # noqa: BLE001 - raised by who stops it
            self.failure = error

    @abstractmethod
    def _serve(self) -> None:
        """Wait for a client and serve it."""

    @abstractmethod
    def _vanish(self) -> None:
        """Be unreachable without a link."""

    @abstractmethod
    def _close(self) -> None:
        """Release the port."""

    def stop(self) -> None:
        """End serving and release the port."""
        self._session.stopping = True
        if self._thread.ident is not None:
            self._thread.join()
        self._close()

    def __enter__(self) -> Self:
        """Serve in a thread."""
        self._thread.start()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self.stop()
        if self.failure is not None and kind is None:
            raise self.failure


class _SocketChannel:
    def __init__(self, connection: socket.socket) -> None:
        self.fileno, self.send = connection.fileno, connection.sendall
        self.receive = lambda: connection.recv(_CHUNK)
        connection.settimeout(SEND_TIMEOUT)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        options = {"NODELAY": 1, "KEEPIDLE": QUIET_AFTER, "KEEPINTVL": 1, "KEEPCNT": 3}
        for name, value in options.items():
            if hasattr(socket, f"TCP_{name}"):  # not on every system
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, f"TCP_{name}"), value)


class TcpServer(Server):
    """Serves on a listening socket."""

    def __init__(self, session: Conversation[Any], listener: socket.socket) -> None:
        self._host, self._port = listener.getsockname()[:2]
        super().__init__(session, f"{session.scheme}://{self._host}:{self._port}")
        self._listener = listener

    def _serve(self) -> None:
        if not self._session.wait(self._listener.fileno(), float("inf")):
            return
        try:
            connection, (host, port) = self._listener.accept()
        except OSError:
            return  # the client left before it was its turn
        with connection:
            self._session.came(f"{host}:{port}")
            self._session.converse(_SocketChannel(connection))
        self._session.left(f"the client {host}:{port} is gone")

    def _vanish(self) -> None:
        self._listener.close()  # refuses clients, those in the backlog too
        self._session.outlast_absence()
        if not self._session.stopping:
            self._listener = listen_tcp(self._host, self._port)

    def _close(self) -> None:
        self._listener.close()


class TerminalServer(Server):
    """Serves on a pseudo-terminal."""

    def __init__(self, session: Conversation[Any]) -> None:
        self._own, client = pty.openpty()
        super().__init__(session, f"{session.scheme.replace('tcp', 'serial')}://{os.ttyname(client)}?baud=1000000")
        os.set_blocking(self._own, False)
        tty.setraw(client)
        os.close(client)
        self._is_open = True

    def fileno(self) -> int:
        """Descriptor."""
        return self._own

    def receive(self) -> bytes:
        """Return arrived bytes; OSError: closed."""
        return os.read(self._own, _CHUNK)

    def send(self, data: bytes) -> None:
        """Send bytes."""
        with contextlib.suppress(BlockingIOError):  # no reader: lost, as on a wire
            os.write(self._own, data)

    def _serve(self) -> None:
        poll = select.poll()
        poll.register(self._own, select.POLLIN)
        if [event for _, event in poll.poll(0)] == [select.POLLHUP]:
            self._session.wait(None, time.monotonic() + self._session.tick)
            return
        self._session.came("on the serial line")
        self._session.converse(self)
        self._session.left("the serial line was closed")
        with contextlib.suppress(OSError):
            tty.setraw(self._own)  # as the next client finds it

    def _vanish(self) -> None:
        self._session.outlast_absence()
        with contextlib.suppress(OSError):
            while self.receive():
                pass  # what was written to a line that led nowhere is lost

    def _close(self) -> None:
        if self._is_open:  # a server that died has closed it already
            self._is_open = False
            os.close(self._own)
