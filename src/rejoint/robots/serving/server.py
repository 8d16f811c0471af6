"""Where clients find a served arm: a TCP port or a pseudo-terminal, one client at a time.

The server has a thread of its own and answers from the last state, whatever the control loop does. No client can end
it: garbage is skipped, a half frame is forgotten, a client that breaks off, or takes no answers, is gone, and the arm
then holds. Who comes while another is there is let in and at once closed out: the vendor's server would let it wait.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import socket
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rejoint.arms.wire.frames import Decoder, encode
from rejoint.robots.serving.answering import Answering

HALF_FRAME = 0.05
"""[s] to wait for the rest of a frame (chosen: 50 times the length of the longest at 115200 baud)"""
TICK = 0.05
"""[s] between two looks at whether the end was asked for (chosen)"""
SEND_TIMEOUT = 1.0
"""[s] before a client that takes no answers counts as gone (chosen)"""
QUIET_AFTER = 5
"""[s] without a word after which a client's machine is asked whether it still runs, three times in as many seconds"""
_CHUNK = 1024
_REFUSALS = 10  # of further clients that are told one by one; a program that tries for ever fills no terminal

_UNFINISHED = "Its last move was not at its end: a program waits for it with sync_send_angles or is_moving."

Say = Callable[[str], object]


class WireServer(ABC):
    """Serves in a thread of its own, as a context manager."""

    def __init__(self, answering: Answering, address: str, say: Say) -> None:
        self.address = address
        """where a client finds it, such as ``tcp://127.0.0.1:9000``"""
        self._answering, self._say = answering, say
        self.failure: Exception | None = None
        """a bug that ended it"""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"serve {address}", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()
        self._close()

    @property
    def ended(self) -> bool:
        """Whether it serves no more, by a bug: the arm must not go on without its clients."""
        return self.failure is not None

    def _run(self) -> None:
        try:
            while not self._over.is_set():
                self._serve()
        except Exception as error:  # noqa: BLE001 - raised by who drives the arm, once that holds
            self.failure = error

    @abstractmethod
    def _serve(self) -> None:
        """Wait for a client for a `TICK` and serve it until it is gone."""

    @abstractmethod
    def _close(self) -> None:
        """Release the port."""

    def _converse(self, handle: int, receive: Callable[[], bytes], send: Callable[[bytes], object]) -> None:
        """Answer one client until it is gone or the end was asked for."""
        decoder = Decoder()
        with contextlib.suppress(OSError):
            while not self._over.is_set():
                if self._await(handle, HALF_FRAME if decoder.pending else TICK):
                    data = receive()
                    if not data:
                        return
                    requests = decoder.feed(data)
                else:
                    requests = decoder.expire()
                for request in requests:
                    found = self._answering.answer(request)
                    if found is not None:
                        send(encode(found))

    def _hold(self, why: str) -> None:
        """Let the arm hold, and say so: a program that does not wait for its last move leaves it half done."""
        under_way = self._answering.hold(why)
        unfinished = f" {_UNFINISHED}" if under_way else ""
        self._say(f"{why[0].upper()}{why[1:]}; the arm holds.{unfinished}")

    def _await(self, handle: int, timeout: float) -> bool:
        """Tell whether a client has sent something, or is gone, within ``timeout`` [s]."""
        return bool(select.select([handle], [], [], timeout)[0])


class _TcpWire(WireServer):
    def __init__(self, answering: Answering, listener: socket.socket, say: Say) -> None:
        host, port = listener.getsockname()[:2]
        super().__init__(answering, f"tcp://{host}:{port}", say)
        self._listener, self._refused = listener, 0
        self._present: socket.socket | None = None

    def _serve(self) -> None:
        if not select.select([self._listener], [], [], TICK)[0]:
            return
        try:
            connection, (host, port) = self._listener.accept()
        except OSError:
            return  # the client left before it was its turn
        with connection:
            _prepare(connection)
            self._say(f"A client is there: {host}:{port}")
            self._present = connection
            self._converse(connection.fileno(), lambda: connection.recv(_CHUNK), connection.sendall)
        self._hold(f"the client {host}:{port} is gone")

    def _await(self, handle: int, timeout: float) -> bool:
        ready = select.select([handle, self._listener.fileno()], [], [], timeout)[0]
        if self._listener.fileno() in ready and not (handle in ready and self._is_gone()):
            self._refuse()
        return handle in ready

    def _is_gone(self) -> bool:
        """Whether the client that is served, of whom there is news, has gone: then who comes is the next one."""
        try:
            return self._present is not None and not self._present.recv(1, socket.MSG_PEEK)
        except OSError:
            return True

    def _refuse(self) -> None:
        with contextlib.suppress(OSError):
            connection, (host, port) = self._listener.accept()
            connection.close()
            self._refused += 1
            if self._refused <= _REFUSALS:
                self._say(f"Refused a second client, {host}:{port}: one at a time drives the arm.")

    def _close(self) -> None:
        self._listener.close()


class _TerminalWire(WireServer):
    """A serial line that exists only here. It is served whenever somebody has it open."""

    def __init__(self, answering: Answering, own: int, client: int, say: Say) -> None:
        super().__init__(answering, f"serial://{os.ttyname(client)}?baud=1000000", say)
        self._own = own
        os.close(client)

    def _serve(self) -> None:
        if self._is_closed(0.0):
            self._over.wait(TICK)
            return
        self._say("A client has opened the serial line.")
        self._converse(self._own, self._receive, self._send)
        self._hold("the serial line was closed")
        with contextlib.suppress(OSError):
            tty.setraw(self._own)  # as the next client finds it

    def _is_closed(self, timeout: float) -> bool:
        poll = select.poll()
        poll.register(self._own, select.POLLIN)
        return any(event & select.POLLHUP for _, event in poll.poll(1e3 * timeout))

    def _receive(self) -> bytes:
        return os.read(self._own, _CHUNK)

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # nobody reads: lost, as on a wire
            os.write(self._own, data)

    def _close(self) -> None:
        os.close(self._own)


def _prepare(connection: socket.socket) -> None:
    """Send answers at once, and notice within seconds that a client's machine is gone."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.settimeout(SEND_TIMEOUT)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", QUIET_AFTER), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, name):  # not on every system
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def tcp_wire(answering: Answering, listener: socket.socket, say: Say) -> WireServer:
    """Serve on a listening socket."""
    return _TcpWire(answering, listener, say)


def pty_wire(answering: Answering, say: Say) -> WireServer:
    """Open a pseudo-terminal that a client can open like a serial port, and serve on it."""
    own, client = pty.openpty()
    tty.setraw(client)
    os.set_blocking(own, False)
    return _TerminalWire(answering, own, client, say)
