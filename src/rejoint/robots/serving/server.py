"""The server that clients find, what it answers, and its log of orders.

The vendor's meaning is that of `rejoint.arms.wire`. Orders that would let the arm fall or move its zeros are refused;
grippers, lamps and pins are passed on by the control loop. No client can end the server, and the arm holds when one
goes. Orders are written as lines of JSON.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import socket
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from datetime import datetime
from pathlib import Path
from typing import Self

from rejoint.arms.wire.computer import COLLISION, HAS_ARRIVED_LENGTH, NO_LINE, NO_SOLUTION
from rejoint.arms.wire.orders import ORDERS, SWITCHES, answer, flag
from rejoint.arms.wire.values import Decoder, Frame, encode
from rejoint.robots.mycobot import ORDERS as NAMES
from rejoint.robots.serving.served import MoveEnd, ServedArm
from rejoint.system.errors import RobotError
from rejoint.system.files import unwritable


class OrderLog:
    """Writes to ``path``; without one it only counts. FileError where the file cannot be begun."""

    def __init__(self, path: Path | None = None, *, say: Callable[[str], object] = lambda _: None) -> None:
        self.path = path
        self.orders = 0
        """so far"""
        self._say, self._lock = say, threading.Lock()
        self._questions: Counter[str] = Counter()
        self._handle: int | None = None
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            except OSError as error:
                raise unwritable(path, error) from error

    def asked(self, command: int) -> None:
        """Count a question."""
        self._questions[f"0x{command:02x}"] += 1

    def ordered(self, command: int, payload: bytes, *, done: bool, why: str = "") -> int:
        """Write an order: whether it is carried out, and why not; returns its number, from 1."""
        with self._lock:
            self.orders += 1
            number = self.orders
        words = {"why": why} if why else {}
        questions, self._questions = dict(self._questions), Counter()
        self.write(
            "order",
            number=number,
            name=NAMES.get(command, f"0x{command:02x}"),
            payload=payload.hex(),
            done=done,
            **words,
            questions_before=questions,
        )
        return number

    def write(self, what: str, **found: object) -> None:
        """Write one line; it is with the system when this returns, so that a killed process loses nothing."""
        line = json.dumps({"date": datetime.now().isoformat(timespec="milliseconds"), "what": what, **found}) + "\n"
        with self._lock:
            try:
                if self._handle is not None:
                    os.write(self._handle, line.encode())
            except OSError as error:
                self._end()
                self._say(f"{self.path}: cannot be written any more ({error.strerror}); the arm goes on without")

    def close(self) -> None:
        """End the log."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None


PATIENCE = 0.25
"""[s] for which the server waits (chosen: clients over TCP give up after 0.3)"""

Passes = Callable[[int, bytes], bytes | None]
"""Asks the robot: id and payload of a command to the payload of the answer, None without one"""


class Relay:
    """One request at a time on its way from the server to the control loop; ``passes`` None answers nothing."""

    def __init__(self, passes: Passes | None) -> None:
        self._passes = passes
        self._waiting: tuple[int, bytes, Future[bytes | None]] | None = None
        self._silent: set[int] = set()

    def ask(self, command: int, payload: bytes) -> bytes | None:
        """Return the payload of the robot's answer, None where there is none in time. For the server's thread."""
        if self._passes is None or command in self._silent:
            return None
        future: Future[bytes | None] = Future()
        self._waiting = command, payload, future
        with contextlib.suppress(TimeoutError):
            return future.result(PATIENCE)
        return None

    def serve(self) -> None:
        """Pass on what waits. For the control loop."""
        request, self._waiting = self._waiting, None
        if request is None or self._passes is None:
            return
        (command, payload, future), answer = request, None
        with contextlib.suppress(RobotError):
            answer = self._passes(command, payload)
        if answer is None:
            self._silent.add(command)
        future.set_result(answer)


_FALLS = "the arm would fall; support it and switch it off at its supply"
_STAYS = "it would change what the run knows of the arm; end `rejoint serve` first"
_OWN = "coordinates are those of the arm's own tool in its own base; the tip of a tool is told by --tool"
_OTHER_FRAME = {0x81: _OWN, 0x83: _OWN, 0x85: _OWN, 0x87: "straight lines are asked for with each order", 0x89: _OWN}
REFUSED = {0x11: _FALLS, 0x13: _FALLS, 0x1A: _FALLS, 0x56: _FALLS, 0x52: _STAYS, 0x54: _STAYS}
"""Orders that are never carried out, and why. 0x1A with 0, which ends free mode, is no such order"""
PASSED_ON = frozenset((0x60, 0x61, 0x62, *range(0x64, 0x70), 0xA0, 0xA1))
"""Gripper, lamp and pins (pymycobot 4.0.7, `ProtocolCode`)"""
# Those of them that change nothing
_ASKS = frozenset((0x62, 0x65, 0x69, 0x6B, 0x6E, 0xA1))
CLEAR_ERROR = 0x08
AGAIN = 10.0
"""[s] after which the same refusal is said again (chosen)"""
MOVES = frozenset((0x21, 0x22, 0x24, 0x25, *range(0x30, 0x35), 0x3A, 0x3C, 0x3E))


class Answering:
    """Answers for ``served``; ``say`` is told what a person at the terminal should know."""

    def __init__(self, served: ServedArm, log: OrderLog, relay: Relay, say: Callable[[str], object]) -> None:
        self._served, self._log, self._relay, self._say = served, log, relay, say
        self._number: int | None = None
        self._said: dict[str, float] = {}  # refusal -> when [s] it was said last

    def answer(self, request: Frame) -> Frame | None:
        """Carry out ``request``; None where the arm stays silent, as for what it does not know."""
        command, payload = request.command, request.payload
        if command in PASSED_ON:
            return self._pass_on(request)
        if command not in ORDERS and command not in SWITCHES:
            self._log.asked(command)
            found = None if self._served.is_lost else answer(self._served, request)
            return None if found is None else found.frame
        why = "" if command == 0x1A and payload[:1] == b"\x00" else REFUSED.get(command, "")
        if why:
            return self._refuse(request, why)
        with self._served.carrying_out():
            error, self._served.error, self._served.note = self._served.error, 0, ""
            reply = answer(self._served, request)
            found_error = self._served.error
            if command != CLEAR_ERROR:
                self._served.error = found_error or error
        if reply is None:
            return None  # not well formed
        done = reply.frame.payload == flag(True)
        if not done:
            return self._refuse(request, _OTHER_FRAME.get(command) or self._served.note or _reason(found_error))
        note = self._served.note
        if note:
            self._say_again(note, f"{NAMES[command]}: {note}.")
        number = self._log.ordered(command, payload, done=True, why=note)
        if command in MOVES:
            self._number = number
        return reply.frame

    def arrived(self, arrival: MoveEnd) -> None:
        """Write how a move ended; for the control loop."""
        self._log.write(
            "arrival",
            number=self._number,
            error_mm=round(1e3 * arrival.error, 3),
            farthest_joint_rad=round(arrival.angle, 5),
            after_s=round(arrival.after, 3),
            **{name: told for name in ("held_back", "short") if (told := getattr(arrival, name))},
        )
        if arrival.error > HAS_ARRIVED_LENGTH or arrival.short:
            cause = f"the guard kept it back ({arrival.held_back})" if arrival.held_back else arrival.short
            cause = cause or "it came no nearer"
            self._say_again(cause, f"A move ended {1e3 * arrival.error:.0f} mm from where it was sent: {cause}.")

    def hold(self, why: str) -> bool:
        """Let the arm hold, and return whether it was on its way; ``why`` is written."""
        with self._served.carrying_out():
            under_way = self._served.moving
            if self._served.on_its_way:
                self._served.stop()
        self._log.write("hold", why=why, on_its_way=under_way)
        return under_way

    def _refuse(self, request: Frame, why: str) -> Frame:
        self._log.ordered(request.command, request.payload, done=False, why=why)
        line = f"Refused {NAMES.get(request.command, hex(request.command))}: {why}"
        self._say_again(line, line)
        return Frame(request.command, flag(False))

    def _say_again(self, about: str, line: str) -> None:
        """Say a line, unless one ``about`` the same was said just now."""
        now = time.monotonic()
        if now - self._said.get(about, -AGAIN) >= AGAIN:
            self._said[about] = now
            self._say(line)

    def _pass_on(self, request: Frame) -> Frame | None:
        found = self._relay.ask(request.command, request.payload)
        if request.command in _ASKS:
            self._log.asked(request.command)
        else:
            why = "" if found is not None else "the robot does not answer it, or its driver cannot pass it on"
            self._log.ordered(request.command, request.payload, done=found is not None, why=why)
        return None if found is None else Frame(request.command, found)


def _reason(error: int) -> str:
    if error == NO_SOLUTION:
        return "no posture of the arm brings the tool there (error 32)"
    if error == COLLISION:
        return f"the guard keeps the arm from there: it would touch the ground or itself (error {COLLISION})"
    if error == NO_LINE:
        return "the arm cannot follow a straight line there (error 33)"
    if 1 <= error <= 6:
        return f"joint {error} would go beyond its limit (error {error})"
    return "the queue is full, or there is no such joint, axis or value"


HALF_FRAME = 0.05
"""[s] to wait for the rest of a frame (chosen)"""
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

    def __exit__(self, *_: object) -> None:
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
        with contextlib.suppress(BlockingIOError):  # no reader: lost, as on a wire
            os.write(self._own, data)

    def _close(self) -> None:
        os.close(self._own)


def _prepare(connection: socket.socket) -> None:
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
