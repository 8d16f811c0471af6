"""An arm offered to another program line by line, as JSON on standard input and output: `rejoint serve --stdio`.

Nothing of that program's environment has to fit ours. Every line that comes is one object, and one line answers it.
"""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from rejoint.control.robot import Robot
from rejoint.robots import place_of
from rejoint.robots.feetech.address import FeetechAddress
from rejoint.robots.feetech.gripper import Gripper
from rejoint.runs.given import Period, RunLike
from rejoint.runs.stages.posing import PosedArm
from rejoint.system.errors import InputError
from rejoint.system.stopping import check, noted

LOOK = 0.05
"""[s] between two looks whether the arm is still driven (chosen)"""
LONGEST = 1 << 16
"""[bytes] of a line (chosen: a hundred times what it needs)"""


class Order(msgspec.Struct, forbid_unknown_fields=True):
    """A line from the other program; an empty object asks for the state alone."""

    goal: list[float] | None = None
    """[rad] of every joint"""
    gripper: float | None = None
    """[%] open"""


def serve_lines(robot: str, run: RunLike, *, period: Period | None, say: Callable[[str], object]) -> None:
    """Drive the arm by the lines of standard input until they end; the arm then holds. ``say`` tells a person."""
    if sys.stdin is None:
        raise InputError("--stdio follows standard input, and it is closed; give it a pipe")
    detail = place_of(robot).detail
    grippers: list[Gripper] = []

    def beside(opened: Robot) -> Callable[[], object] | None:
        ask = getattr(opened, "relay", None)
        found = Gripper.find(ask, opened.arm.joints + 1) if ask and isinstance(detail, FeetechAddress) else None
        if found is None:
            return None
        grippers.append(found)
        return found.serve

    with noted(), PosedArm(robot, run, period=period, beside=beside, say=say) as arm:
        gripper = grippers[0] if grippers else None
        given = detail.zero if isinstance(detail, FeetechAddress) else ()
        middle = np.radians(given or (0.0,) * arm.arm.joints)
        _answer({"joints": arm.arm.joint_names, "middle": middle.tolist(), "gripper": gripper is not None})
        came = bytearray()
        while (line := _next(arm, came)) is not None:
            _answer(_obey(arm, gripper, line))


def _obey(arm: PosedArm, gripper: Gripper | None, line: bytes) -> dict[str, Any]:
    """Carry out a line; returns what answers it."""
    try:
        order = msgspec.json.decode(line, type=Order)
        taken = None if order.goal is None else arm.send(order.goal).tolist()
    except (msgspec.MsgspecError, InputError) as error:
        return {"refused": str(error)}
    if gripper is not None and order.gripper is not None:
        gripper.goal = order.gripper
    opened = None if gripper is None else gripper.opened
    return {"position": arm.position.tolist(), "goal": taken, "gripper": opened}


def _next(arm: PosedArm, came: bytearray) -> bytes | None:
    """Wait for a line; None at the end of input. Raises what ended the drive, and `Interrupted`.

    Half a line waits in ``came``: a program that never ends it keeps neither a signal nor an error from being seen.
    """
    while True:
        check()
        arm.check()
        line, end, rest = came.partition(b"\n")
        if end or len(came) > LONGEST:
            came[:] = rest
            return bytes(line)
        if select.select([sys.stdin], [], [], LOOK)[0]:
            more = os.read(sys.stdin.fileno(), LONGEST)
            if not more:
                came.clear()
                return bytes(line) or None
            came += more


def _answer(content: dict[str, Any]) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(content) + b"\n")
    sys.stdout.buffer.flush()
