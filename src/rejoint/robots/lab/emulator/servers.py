"""The emulated robot where a client finds it: a TCP port, or a pseudo-terminal in place of a serial port.

Like the vendor's server on the robot, the TCP server speaks to one client at a time; others wait in
the backlog. No client can end a server: garbage is skipped, a broken connection makes room for the
next one. A terminal knows no clients: as with a real serial line, whoever opens it writes on it.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import pty
import socket
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

from rejoint.robots.lab.emulator.conversation import Conversation
from rejoint.robots.lab.emulator.faults import NONE, Faults
from rejoint.robots.lab.emulator.firmware import Firmware
from rejoint.robots.lab.emulator.session import Session, Timing
from rejoint.robots.lab.emulator.truthlog import TruthLog
from rejoint.robots.lab.emulator.wirefaults import DeathError, LinkGoneError
from rejoint.system.listening import listen_tcp

BACKLOG = 1
"""Clients that may wait, as in the vendor's server."""
SEND_TIMEOUT = 1.0
"""[s] before a client that takes no answers counts as gone (chosen)"""
_CHUNK = 1024


class Server(ABC):
    """Serves in the calling thread (`run`) or in one of its own (as a context manager)."""

    def __init__(self, session: Conversation[Any], address: str) -> None:
        self.address = address
        """where a robot driver finds it, such as ``tcp://127.0.0.1:9000``"""
        self._session = session
        self._thread: threading.Thread | None = None
        self.on_death: Callable[[], object] | None = None
        """what becomes of the process when a fault lets the emulator die"""

    def run(self) -> None:
        """Serve until `stop` is called from another thread, a signal ends it, or a fault lets it die."""
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
        """Serve clients; LinkGoneError and DeathError come from the session."""

    @abstractmethod
    def _vanish(self) -> None:
        """Be out of reach as long as there is no link."""

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


class _SocketChannel:
    """One accepted connection."""

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
    """Listens from its construction by `serve_tcp` on."""

    def __init__(self, session: Conversation[Any], listener: socket.socket, scheme: str) -> None:
        host, port = listener.getsockname()[:2]
        super().__init__(session, f"{scheme}://{host}:{port}")
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
    """The robot's end of a pseudo-terminal; it never ends, whoever opens and closes the other end."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def fileno(self) -> int:
        return self._descriptor

    def receive(self) -> bytes:
        return os.read(self._descriptor, _CHUNK)

    def send(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # nobody reads: lost, as on a wire
            os.write(self._descriptor, data)


class _TerminalServer(Server):
    def __init__(self, session: Conversation[Any], own: int, client: int, scheme: str) -> None:
        super().__init__(session, f"{scheme}://{os.ttyname(client)}?baud=1000000")
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
    """Whether the server at ``address`` can be reached from other machines."""
    place = urlsplit(address)
    return place.hostname is not None and not ipaddress.ip_address(place.hostname).is_loopback


def serve_tcp(
    firmware: Firmware,
    host: str = "127.0.0.1",
    port: int = 9000,
    *,
    timing: Timing | None = None,
    seed: int = 0,
    log: TruthLog | None = None,
    faults: Faults = NONE,
) -> Server:
    """Listen on a TCP port (0: any free one); InputError if that is not possible. Run it to serve."""
    session = Session(firmware, timing=timing or Timing(), seed=seed, log=log, faults=faults)
    return on_port(session, host, port, scheme="tcp")


def serve_pty(
    firmware: Firmware,
    *,
    timing: Timing | None = None,
    seed: int = 0,
    log: TruthLog | None = None,
    faults: Faults = NONE,
) -> Server:
    """Open a pseudo-terminal that a driver can open like a serial port. Run the server to serve."""
    session = Session(firmware, timing=timing or Timing(), seed=seed, log=log, faults=faults)
    return on_terminal(session, scheme="serial")


def on_port(session: Conversation[Any], host: str, port: int, *, scheme: str) -> Server:
    """Hold a conversation on a TCP port (0: any free one), at an address of ``scheme``; InputError if it cannot be."""
    return _TcpServer(session, listen_tcp(host, port, BACKLOG), scheme)


def on_terminal(session: Conversation[Any], *, scheme: str) -> Server:
    """Hold a conversation on a pseudo-terminal, at an address of ``scheme``.

    The client's end is put into raw mode and kept open here: otherwise the terminal would echo
    before the first client opens it, and fail when the last one closes it.
    """
    own, client = pty.openpty()
    tty.setraw(client)
    os.set_blocking(own, False)
    return _TerminalServer(session, own, client, scheme)
