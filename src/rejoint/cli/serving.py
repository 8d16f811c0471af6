"""Commands that serve arms: an emulated one, and a real one with a controller, on the vendor's wire or line by line."""

from __future__ import annotations

import os
import select
import sys
from pathlib import Path
from typing import Any

import msgspec

import rejoint
from rejoint.cli.options import Call, ConsoleObserver, takes
from rejoint.control.recording import Observer
from rejoint.control.robot import Relaying, part_of
from rejoint.robots import place_of
from rejoint.robots.knobs import ServoAddress
from rejoint.robots.servobus import Gripper
from rejoint.session.inputs import RunLike, Settings
from rejoint.session.session import ArmSession
from rejoint.system.errors import InputError
from rejoint.system.stopping import check, noted


@takes("live", "controller", "calibration", "payload", "tool", "period", "dry_run")
def serve(
    call: Call,
    robot: str,
    run: Path,
    listen: str = "127.0.0.1:9000",
    pty: bool = False,
    stdio: bool = False,
) -> object:
    """Let programs written for the vendor's client drive a worn arm as if it were a new one, until Ctrl-C."""
    if stdio:
        if pty or call.json or call.settings.controller or call.live:
            raise InputError("--stdio does not go with --pty, --json, --live or --controller")
        serve_lines(robot, run, call.settings, ConsoleObserver(call))
        return None
    with call.watched("serve", bar=False) as observer:
        done = rejoint.serve(robot, run, listen=listen, pty=pty, settings=call.settings, observer=observer)
    call.say(f"Serving ended after {done.orders} orders; they are in {done.log}")
    return done


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


def serve_lines(robot: str, run: RunLike, settings: Settings, observer: Observer) -> None:
    """Drive the arm by the lines of standard input until they end; the arm then holds."""
    if sys.stdin is None:
        raise InputError("--stdio follows standard input, and it is closed; give it a pipe")
    detail = place_of(robot).detail
    with noted(), ArmSession(robot, run=run, settings=settings, observer=observer) as arm:
        wire, on_bus = part_of(arm.robot, Relaying), isinstance(detail, ServoAddress)
        gripper = Gripper.find(wire.relay, detail.table) if wire and on_bus else None
        arm.beside += [] if gripper is None else [gripper.serve]
        arm.hold()
        middle = detail.middle(arm.arm).tolist() if on_bus else [0.0] * arm.arm.joints
        _answer({"joints": arm.arm.joint_names, "middle": middle, "gripper": gripper is not None})
        came = bytearray()
        while (line := _next(arm, came)) is not None:
            _answer(_obey(arm, gripper, line))


def _obey(arm: ArmSession, gripper: Gripper | None, line: bytes) -> dict[str, Any]:
    try:
        order = msgspec.json.decode(line, type=Order)
        taken = None if order.goal is None else arm.send_joints(order.goal).tolist()
    except (msgspec.MsgspecError, InputError) as error:
        return {"refused": str(error)}
    if gripper is not None and order.gripper is not None:
        gripper.goal = order.gripper
    opened = None if gripper is None else gripper.opened
    return {"position": arm.shown_joints().tolist(), "goal": taken, "gripper": opened}


def _next(arm: ArmSession, came: bytearray) -> bytes | None:
    """Wait for a line; None at the end of input.

    Half a line waits in ``came``, and blocks neither signals nor errors.
    """
    while True:
        check()
        arm.hold()
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
