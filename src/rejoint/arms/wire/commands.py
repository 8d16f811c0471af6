"""From a request frame to its answer. A request that is not known, or not well formed, gets none."""

from __future__ import annotations

from dataclasses import dataclass

from rejoint.arms.wire.computer import Computer
from rejoint.arms.wire.frames import Frame
from rejoint.arms.wire.orders import ORDERS, SWITCHES
from rejoint.arms.wire.states import QUESTIONS, STATES, flag


@dataclass(frozen=True, kw_only=True)
class Reply:
    """An answer, and whether it reports a state (slower) or acknowledges an order."""

    frame: Frame
    is_state: bool


def answer(computer: Computer, request: Frame) -> Reply | None:
    """Carry out ``request``; None if the robot stays silent."""
    command, payload = request.command, request.payload
    answered: bytes | None = None
    is_state = command in STATES or command in QUESTIONS
    if not payload and command in STATES:
        answered = STATES[command](computer)
    elif payload and command in QUESTIONS and len(payload) in QUESTIONS[command][0]:
        answered = QUESTIONS[command][1](computer, payload)
    elif not payload and command in SWITCHES:
        SWITCHES[command](computer)
        answered = flag(True)
    elif payload and command in ORDERS and len(payload) in ORDERS[command][0]:
        answered = flag(ORDERS[command][1](computer, payload))
    return None if answered is None else Reply(frame=Frame(command, answered), is_state=is_state)
