"""What clients are answered, and the log of orders (JSON lines).

Orders that would let the arm fall or move its zeros are refused; the control loop passes on grippers, lamps and pins.
No client can end the server, and the arm holds when one goes.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Callable
from concurrent.futures import Future
from datetime import datetime
from pathlib import Path

from rejoint.robots.mycobot.bus import ORDERS as NAMES
from rejoint.robots.mycobot.frames import Decoder, Frame, encode
from rejoint.robots.mycobot.mover import ARRIVED_LENGTH, COLLISION, NO_LINE, NO_SOLUTION
from rejoint.robots.mycobot.orders import COMMANDS, answer, flag
from rejoint.robots.serving.served import MoveEnd, ServedArm
from rejoint.robots.wireserver import ByteStream, Conversation, Server, TcpServer, TerminalServer, await_data
from rejoint.system.errors import RobotError
from rejoint.system.files import unwritable


class OrderLog:
    """Writes to ``path``, or only counts; FileError."""

    def __init__(self, path: Path | None = None, *, say: Callable[[str], object] = lambda _: None) -> None:
        self.path, self._say = path, say
        self.orders = 0
        """so far"""
        self._handle: int | None = None
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            except OSError as error:
                raise unwritable(path, error) from error

    def ordered(self, command: int, payload: bytes, *, done: bool, why: str = "") -> int:
        """Write an order, whether it is carried out and why not; returns its number."""
        self.orders += 1
        name, because = NAMES.get(command, f"0x{command:02x}"), {"why": why} if why else {}
        self.write("order", number=self.orders, name=name, payload=payload.hex(), done=done, **because)
        return self.orders

    def write(self, what: str, **found: object) -> None:
        """Write one line at once, safe from a killed process; the loop and the server write."""
        line = json.dumps({"date": datetime.now().isoformat(timespec="milliseconds"), "what": what, **found}) + "\n"
        handle = self._handle
        if handle is None:
            return
        try:
            os.write(handle, line.encode())
        except OSError as error:
            self._handle = None
            self._say(f"{self.path}: cannot be written any more ({error.strerror}); the arm goes on without")

    def close(self) -> None:
        """End the log."""
        handle, self._handle = self._handle, None
        if handle is not None:
            os.close(handle)


PATIENCE = 0.25
"""[s] for which the server waits (chosen: clients over TCP give up after 0.3)"""

Passes = Callable[[int, bytes], bytes | None]
"""Asks the robot by id and payload; None: no answer"""


class Relay:
    """Passes one request at a time from the server to the control loop."""

    def __init__(self, passes: Passes | None) -> None:
        self._passes = passes
        self._waiting: tuple[int, bytes, Future[bytes | None]] | None = None
        self._silent: set[int] = set()

    def ask(self, command: int, payload: bytes) -> bytes | None:
        """Return the robot's answer, or None; for the server's thread."""
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
"""Refused orders, and why; 0x1A with 0 is allowed"""
PASSED_ON = frozenset((0x60, 0x61, 0x62, *range(0x64, 0x70), 0xA0, 0xA1))
"""Gripper, lamp and pins (pymycobot 4.0.7, `ProtocolCode`)"""
# Those of them that change nothing
_ASKS = frozenset((0x62, 0x65, 0x69, 0x6B, 0x6E, 0xA1))
CLEAR_ERROR = 0x08
AGAIN = 10.0
"""[s] after which the same refusal is said again (chosen)"""
MOVES = frozenset((0x21, 0x22, 0x24, 0x25, *range(0x30, 0x35), 0x3A, 0x3C, 0x3E))


class Answering:
    """Answers for ``served``; ``say`` tells the terminal."""

    def __init__(self, served: ServedArm, log: OrderLog, relay: Relay, say: Callable[[str], object]) -> None:
        self._served, self._log, self._relay, self._say = served, log, relay, say
        self._number: int | None = None
        self._said: dict[str, float] = {}  # refusal -> when [s] it was said last

    def answer(self, request: Frame) -> Frame | None:
        """Carry out ``request``; None: silence."""
        command, payload = request.command, request.payload
        if command in PASSED_ON:
            return self._pass_on(request)
        if command not in COMMANDS:
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
            return self._refuse(request, _OTHER_FRAME.get(command) or self._served.note or _REASONS[found_error])
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
        if arrival.error > ARRIVED_LENGTH or arrival.short:
            cause = f"the guard kept it back ({arrival.held_back})" if arrival.held_back else arrival.short
            cause = cause or "it came no nearer"
            self._say_again(cause, f"A move ended {1e3 * arrival.error:.0f} mm from where it was sent: {cause}.")

    def hold(self, why: str) -> bool:
        """Let the arm hold; whether it was on its way."""
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
        """Say a line, unless one ``about`` the same was just said."""
        now = time.monotonic()
        if now - self._said.get(about, -AGAIN) >= AGAIN:
            self._said[about] = now
            self._say(line)

    def _pass_on(self, request: Frame) -> Frame | None:
        found = self._relay.ask(request.command, request.payload)
        if request.command not in _ASKS:
            why = "" if found is not None else "the robot does not answer it, or its driver cannot pass it on"
            self._log.ordered(request.command, request.payload, done=found is not None, why=why)
        return None if found is None else Frame(request.command, found)


_REASONS = {
    0: "the queue is full, or there is no such joint, axis or value",
    NO_SOLUTION: "no posture of the arm brings the tool there (error 32)",
    COLLISION: f"the guard keeps the arm from there: it would touch the ground or itself (error {COLLISION})",
    NO_LINE: "the arm cannot follow a straight line there (error 33)",
    **{joint: f"joint {joint} would go beyond its limit (error {joint})" for joint in range(1, 7)},
}


_REFUSALS = 10  # of further clients that are told one by one; a program that tries for ever fills no terminal

_UNFINISHED = "Its last move was not at its end: a program waits for it with sync_send_angles or is_moving."

Say = Callable[[str], object]
WireServer = Server


class _Clients(Conversation[Frame]):
    """Clients of an arm, one at a time."""

    def __init__(self, answering: Answering, say: Say, listener: socket.socket | None = None) -> None:
        super().__init__()
        self._answering, self._say, self._listener, self._refused = answering, say, listener, 0

    def came(self, client: str) -> None:
        """Say that a client is there."""
        self._say(f"A client is there: {client}" if client else "A client has opened the serial line.")

    def left(self, client: str) -> None:
        """Let the arm hold."""
        unfinished = f" {_UNFINISHED}" if self._answering.hold(client) else ""
        self._say(f"{client[0].upper()}{client[1:]}; the arm holds.{unfinished}")

    def _finder(self) -> Decoder:
        return Decoder()

    def _answer(self, channel: ByteStream, request: Frame) -> None:
        found = self._answering.answer(request)
        if found is not None:
            channel.send(encode(found))

    def _look(self, readable: int | None) -> None:
        """Refuse a further client, unless this one is gone."""
        if self._listener is None or readable is None or readable == self._listener.fileno():
            return
        ready = [handle for handle in (self._listener.fileno(), readable) if await_data(handle, 0.0)]
        if self._listener.fileno() not in ready or (readable in ready and _is_gone(readable)):
            return
        with contextlib.suppress(OSError):
            connection, (host, port) = self._listener.accept()
            connection.close()
            self._refused += 1
            if self._refused <= _REFUSALS:
                self._say(f"Refused a second client, {host}:{port}: one at a time drives the arm.")


def _is_gone(handle: int) -> bool:
    try:
        with socket.socket(fileno=os.dup(handle)) as present:
            return not present.recv(1, socket.MSG_PEEK)
    except OSError:
        return True


def tcp_wire(answering: Answering, listener: socket.socket, say: Say) -> WireServer:
    """Serve on a listening socket."""
    return TcpServer(_Clients(answering, say, listener), listener)


def pty_wire(answering: Answering, say: Say) -> WireServer:
    """Serve on a pseudo-terminal."""
    return TerminalServer(_Clients(answering, say))
