"""From a client's request to its answer: what an order is made of, and what is refused whatever the client wants.

The vendor's meaning is that of `rejoint.arms.wire`; here stand the exceptions. Orders that would let the arm fall, or
move its zeros, are refused: the acknowledgement is 0, a line says why. So is what is out of reach, with the vendor's
error code. Grippers, lamps and pins are passed on to the robot.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from rejoint.arms.wire.commands import answer
from rejoint.arms.wire.computer import COLLISION, HAS_ARRIVED_LENGTH, NO_LINE, NO_SOLUTION
from rejoint.arms.wire.frames import Frame
from rejoint.arms.wire.orders import ORDERS, SWITCHES
from rejoint.arms.wire.states import flag
from rejoint.robots.serving.orderlog import NAMES, OrderLog
from rejoint.robots.serving.relay import Relay
from rejoint.robots.serving.served import MoveEnd, ServedArm

_FALLS = "the arm would fall; support it and switch it off at its supply"
_STAYS = "it would change what the run knows of the arm; end `rejoint serve` first"
_OWN = "coordinates are those of the arm's own tool in its own base; the tip of a tool is told by --tool"
_OTHER_FRAME = {0x81: _OWN, 0x83: _OWN, 0x85: _OWN, 0x87: "straight lines are asked for with each order", 0x89: _OWN}
REFUSED = {0x11: _FALLS, 0x13: _FALLS, 0x1A: _FALLS, 0x56: _FALLS, 0x52: _STAYS, 0x54: _STAYS}
"""Orders that are never carried out, and why. 0x1A with 0, which ends free mode, is no such order"""
PASSED_ON = frozenset((0x60, 0x61, 0x62, *range(0x64, 0x70), 0xA0, 0xA1))
"""Gripper, lamp and pins (pymycobot 4.0.7, `ProtocolCode`)"""
_ASKS = frozenset((0x62, 0x65, 0x69, 0x6B, 0x6E, 0xA1))
"""Those of them that change nothing"""
CLEAR_ERROR = 0x08
AGAIN = 10.0
"""[s] after which the same refusal is said again (chosen: a program that orders 50 times a second fills no terminal)"""
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
            error, self._served.error = self._served.error, 0
            reply = answer(self._served, request)
            found_error = self._served.error
            if command != CLEAR_ERROR:
                self._served.error = found_error or error
        if reply is None:
            return None  # not well formed
        done = reply.frame.payload == flag(True)
        if not done:
            return self._refuse(request, _OTHER_FRAME.get(command) or _reason(found_error))
        number = self._log.ordered(command, payload, done=True)
        if command in MOVES:
            self._number = number
        return reply.frame

    def arrived(self, arrival: MoveEnd) -> None:
        """Write how a move ended; for the control loop."""
        self._log.write(
            "arrival", number=self._number, error_mm=round(1e3 * arrival.error, 3),
            farthest_joint_rad=round(arrival.angle, 5), after_s=round(arrival.after, 3),
            **({"held_back": arrival.held_back} if arrival.held_back else {}),
        )  # fmt: skip
        if arrival.error > HAS_ARRIVED_LENGTH:
            cause = f"the guard kept it back ({arrival.held_back})" if arrival.held_back else "it came no nearer"
            self._say_again(cause, f"A move ended {1e3 * arrival.error:.0f} mm from where it was sent: {cause}.")

    def hold(self, why: str) -> bool:
        """Let the arm hold, and return whether it was on its way; ``why`` is written.

        It holds where it is, or at the end of a way to which it is only brought nearer: a program that waits a few
        seconds instead of asking has that from a new arm as well.
        """
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
    """Tell in words what an error code of the vendor means."""
    if error == NO_SOLUTION:
        return "no posture of the arm brings the tool there (error 32)"
    if error == COLLISION:
        return f"the guard keeps the arm from there: it would touch the ground or itself (error {COLLISION})"
    if error == NO_LINE:
        return "the arm cannot follow a straight line there (error 33)"
    if 1 <= error <= 6:
        return f"joint {error} would go beyond its limit (error {error})"
    return "the queue is full, or there is no such joint, axis or value"
