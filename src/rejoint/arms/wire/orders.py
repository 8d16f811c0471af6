"""From a request frame to its answer; unknown or malformed requests get none.

Sources: pymycobot 4.0.7 and the vendor's protocol page. One byte acknowledges an order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from rejoint.arms import Array, tcp_pose
from rejoint.arms.rotations import to_coords, to_pose
from rejoint.arms.wire import values
from rejoint.arms.wire.computer import FULL_SPEED
from rejoint.arms.wire.mover import Mover, solve_pose
from rejoint.arms.wire.values import Frame

_JOG_LENGTH = 0.6
"""[m] beyond any reach"""
_JOG_TURN = np.radians(175.0)
_GRIPPER = 7
"""Servo id of a gripper"""


def _all_joints(computer: Mover, on: bool) -> None:
    computer.enable(np.full(computer.arm.joints, on))


def _clear_error(computer: Mover) -> None:
    computer.error = 0


SWITCHES: dict[int, Callable[[Mover], None]] = {
    0x05: lambda computer: computer.clear_queue(),
    0x08: _clear_error,
    0x10: lambda computer: computer.power(True),
    0x11: lambda computer: computer.power(False),
    0x13: lambda computer: _all_joints(computer, False),
    0x26: lambda computer: computer.pause(),
    0x28: lambda computer: computer.resume(),
    0x29: lambda computer: computer.stop(),
}
"""Orders without a payload"""


def _rate(speed_percent: int) -> float:
    return min(max(speed_percent, 1), 100) / 100.0


def _set_fresh_mode(computer: Mover, payload: bytes) -> bool:
    computer.fresh = payload[0] == 1
    return True


def _set_free_mode(computer: Mover, payload: bytes) -> bool:
    _all_joints(computer, computer.powered and not payload[0])
    return True


def _move_one(computer: Mover, identity: int, speed_percent: int, *, to: float = 0.0, by: float | None = None) -> bool:
    """Move one joint ``to`` or ``by`` an angle [rad]."""
    joint = joint_index(computer, identity)
    if joint is None:
        return False
    angles = computer.destination
    angles[joint] = to if by is None else angles[joint] + by
    return computer.move_joints(angles, _rate(speed_percent))


def _move_axis(computer: Mover, payload: bytes, *, relative: bool) -> bool:
    axis = payload[0] - 1
    if not 0 <= axis < 6:
        return False
    value = values.scale_axis(axis, values.unpack_word(payload[1:3]))
    coords = to_coords(tcp_pose(computer.arm, computer.destination))
    coords[axis] = coords[axis] + value if relative else value
    return computer.move_tool(to_pose(coords), _rate(payload[3]), straight=False, turned=axis >= 3)


def _send_angle(computer: Mover, payload: bytes) -> bool:
    return _move_one(computer, payload[0], payload[3], to=values.unpack_angles(payload[1:3])[0])


def _send_angles(computer: Mover, payload: bytes) -> bool:
    return computer.move_joints(values.unpack_angles(payload[:12]), _rate(payload[12]))


def _send_coords(computer: Mover, payload: bytes) -> bool:
    pose = to_pose(values.unpack_coords(payload[:12]))
    return computer.move_tool(pose, _rate(payload[12]), straight=payload[13:] == b"\x01")


def _of_joint(action: Callable[[Mover, int, bytes], bool | None]) -> Callable[[Mover, bytes], bool]:
    def order(computer: Mover, payload: bytes) -> bool:
        joint = joint_index(computer, payload[0])
        return joint is not None and action(computer, joint, payload) is not False

    return order


def _jog_increment_angle(computer: Mover, payload: bytes) -> bool:
    return _move_one(computer, payload[0], payload[3], by=values.unpack_angles(payload[1:3])[0])


def _jog_axis(computer: Mover, axis: int, payload: bytes) -> bool:
    if not 0 <= axis < 6:
        return False
    sign = 1.0 if payload[1] else -1.0
    pose = tcp_pose(computer.arm, computer.planned_angles)
    if axis < 3:
        pose[axis, 3] += sign * _JOG_LENGTH
    else:
        turn = np.zeros(6)
        turn[axis] = sign * _JOG_TURN
        pose[:3, :3] = to_pose(turn)[:3, :3] @ pose[:3, :3]
    return computer.jog_tool(pose, _rate(payload[2]))


def _set_encoder(computer: Mover, payload: bytes) -> bool:
    angle = values.encoder_angle(values.unpack_word(payload[1:3]), computer.arm.encoder_step)
    return _move_one(computer, payload[0], payload[3], to=float(angle))


def _set_encoders(computer: Mover, payload: bytes) -> bool:
    angles = values.encoder_angle(values.unpack_int16(payload[:12]), computer.arm.encoder_step)
    return computer.move_joints(angles, _rate(payload[12]))


def _set_encoders_drag(computer: Mover, payload: bytes) -> bool:
    step = computer.arm.encoder_step
    speed = float(values.unpack_int16(payload[12:]).max()) * step
    angles = values.encoder_angle(values.unpack_int16(payload[:12]), step)
    return computer.move_joints(angles, float(np.clip(speed / FULL_SPEED, 0.01, 1.0)))


def _set_limit(computer: Mover, joint: int, payload: bytes, *, upper: bool) -> bool:
    angle = float(np.radians(values.unpack_word(payload[1:3]) / values.LIMIT_SCALE))
    lower, higher = (computer.lower[joint], angle) if upper else (angle, computer.upper[joint])
    slack = 1e-9
    if lower >= higher or lower < computer.arm.lower[joint] - slack or higher > computer.arm.upper[joint] + slack:
        return False
    computer.lower[joint], computer.upper[joint] = lower, higher
    return True


def _set_register(computer: Mover, payload: bytes) -> bool:
    servo, address = payload[:2]
    if not 1 <= servo <= _GRIPPER:
        return False
    computer.registers[servo, address] = payload[2] if len(payload) == 3 else values.unpack_word(payload[2:4])
    return True


def _switch_servo(computer: Mover, identity: int, *, on: bool) -> bool:
    joint = joint_index(computer, identity)
    if (joint is None and identity != 0) or (on and not computer.powered):
        return False
    wanted = computer.enabled.copy()
    wanted[slice(None) if joint is None else joint] = on
    computer.enable(wanted)
    return True


_FRAMES = {0x81: 12, 0x83: 12, 0x85: 1, 0x87: 1, 0x89: 1}
"""Orders for coordinate frames, and lengths [bytes]; only zeros are accepted"""


def _own_frame(_: Mover, payload: bytes) -> bool:
    return not any(payload)


ORDERS: dict[int, tuple[tuple[int, ...], Callable[[Mover, bytes], bool]]] = {
    0x13: ((1,), lambda computer, _: _switch_servo(computer, 0, on=False)),
    0x16: ((1,), _set_fresh_mode),
    0x1A: ((1,), _set_free_mode),
    0x21: ((4,), _send_angle),
    0x22: ((13,), _send_angles),
    0x24: ((4,), partial(_move_axis, relative=False)),
    0x25: ((13, 14), _send_coords),
    0x30: ((3,), _of_joint(lambda arm, joint, data: arm.jog_joint(joint, 1 if data[1] else -1, _rate(data[2])))),
    0x31: ((3,), lambda computer, payload: _jog_axis(computer, payload[0] + 2, payload)),
    0x32: ((3,), lambda computer, payload: _jog_axis(computer, payload[0] - 1, payload)),
    0x33: ((4,), _jog_increment_angle),
    0x34: ((4,), partial(_move_axis, relative=True)),
    0x3A: ((4,), _set_encoder),
    0x3C: ((13,), _set_encoders),
    0x3E: ((24,), _set_encoders_drag),
    0x4C: ((3,), _of_joint(partial(_set_limit, upper=False))),
    0x4D: ((3,), _of_joint(partial(_set_limit, upper=True))),
    0x52: ((3, 5), _set_register),
    0x54: ((1,), _of_joint(lambda arm, joint, _: arm.calibrate(joint))),
    0x55: ((1,), _of_joint(lambda arm, joint, _: arm.stop(joint))),
    0x56: ((1, 2), lambda computer, payload: _switch_servo(computer, payload[0], on=False)),
    0x57: ((1,), lambda computer, payload: _switch_servo(computer, payload[0], on=True)),
    **{identity: ((length,), _own_frame) for identity, length in _FRAMES.items()},
    0x6A: ((3,), lambda _computer, _payload: True),  # colour of a lamp that is not there
}
"""Lengths [bytes] and actions; False: refused"""


MODIFY_VERSION = 1
SYSTEM_VERSION = 73
"""Computer 7.3, the first with the present joint limits"""
DEFAULT_REGISTERS = {21: 10, 22: 0, 23: 1, 24: 0}
"""P, I, D and minimum start force (vendor's manual)"""


def flag(value: bool) -> bytes:
    """One byte."""
    return b"\x01" if value else b"\x00"


def joint_index(computer: Mover, identity: int) -> int | None:
    """Index of joint 1..n on the wire; None: another servo."""
    return identity - 1 if 1 <= identity <= computer.arm.joints else None


def _angles_and_coords(computer: Mover) -> bytes:
    angles = computer.angles
    return values.pack_angles(angles) + values.pack_coords(tcp_pose(computer.arm, angles))


STATES: dict[int, Callable[[Mover], bytes]] = {
    0x01: lambda _: bytes((MODIFY_VERSION,)),
    0x02: lambda _: bytes((SYSTEM_VERSION,)),
    0x06: lambda _: flag(True),
    0x07: lambda computer: bytes((computer.error,)),
    0x12: lambda computer: flag(computer.powered),
    0x14: lambda _: flag(True),
    0x15: lambda _: bytes(7),
    0x17: lambda computer: flag(computer.fresh),
    0x1B: lambda computer: flag(computer.powered and not computer.enabled.any()),
    0x20: lambda computer: values.pack_angles(computer.angles),
    0x23: lambda computer: values.pack_coords(computer.pose),
    0x27: lambda computer: flag(computer.paused),
    0x2B: lambda computer: flag(computer.moving),
    0x3D: lambda computer: values.pack_encoders(computer.angles, computer.arm.encoder_step),
    0x51: lambda computer: flag(bool(computer.enabled.all())),
    **{identity: lambda _: bytes(12) for identity in (0x82, 0x84)},  # frames of tool and base: the arm's own
    **{identity: lambda _: flag(False) for identity in (0x86, 0x88, 0x8A)},  # which of them counts, and lines as a rule
    0xC1: lambda _: bytes((SYSTEM_VERSION,)),
    0xD5: _angles_and_coords,
    0xD8: lambda _: values.pack_int16([1]),
    0xE1: lambda computer: values.pack_int16(computer.speed / computer.arm.encoder_step),
    0xE2: lambda computer: values.pack_int16(computer.current * 1e3),
    0xE3: lambda computer: values.pack_bytes(computer.voltage * 10.0),
    0xE4: lambda computer: values.pack_bytes(computer.alarms),
    0xE5: lambda computer: values.pack_bytes(computer.temperature),
    0xF6: lambda computer: values.pack_angles(computer.planned_angles),
    0xF7: lambda computer: values.pack_coords(tcp_pose(computer.arm, computer.planned_angles)),
}
"""Questions without a payload"""


def _coords_of(computer: Mover, payload: bytes) -> bytes:
    return values.pack_coords(tcp_pose(computer.arm, values.unpack_angles(payload)))


def _is_in_position(computer: Mover, payload: bytes) -> bytes:
    if payload[12]:
        return flag(computer.at_pose(to_pose(values.unpack_coords(payload[:12]))))
    return flag(computer.in_position(values.unpack_angles(payload[:12])))


def _encoder(computer: Mover, payload: bytes) -> bytes:
    joint = joint_index(computer, payload[0])
    if joint is None:  # the gripper; none is fitted
        return values.pack_int16([-1])
    return values.pack_encoders(computer.angles[joint : joint + 1], computer.arm.encoder_step)


def _limit(limits: Array, payload: bytes) -> bytes | None:
    if not 1 <= payload[0] <= len(limits):
        return None
    return payload + values.pack_int16([np.degrees(limits[payload[0] - 1]) * values.LIMIT_SCALE])


def _is_servo_enabled(computer: Mover, payload: bytes) -> bytes:
    joint = joint_index(computer, payload[0])
    return payload + flag(joint is not None and bool(computer.enabled[joint]))


def _register(computer: Mover, payload: bytes) -> bytes:
    value = computer.registers.get((payload[0], payload[1]), DEFAULT_REGISTERS.get(payload[1], 0))
    return values.pack_int16([value]) if payload[2:] == b"\x01" else bytes((value & 0xFF,))


def _inverse_kinematics(computer: Mover, payload: bytes) -> bytes | None:
    pose = to_pose(values.unpack_coords(payload[:12]))
    angles = solve_pose(computer.arm, pose, values.unpack_angles(payload[12:]))
    return None if angles is None else values.pack_angles(angles)


QUESTIONS: dict[int, tuple[tuple[int, ...], Callable[[Mover, bytes], bytes | None]]] = {
    0x23: ((12,), _coords_of),
    0x2A: ((13,), _is_in_position),
    0x3B: ((1,), _encoder),
    0x4A: ((1,), lambda computer, payload: _limit(computer.lower, payload)),
    0x4B: ((1,), lambda computer, payload: _limit(computer.upper, payload)),
    0x50: ((1,), _is_servo_enabled),
    0x53: ((2, 3), _register),
    0x8D: ((24,), _inverse_kinematics),
}
"""Lengths [bytes] and answers; None: silence"""


@dataclass(frozen=True, kw_only=True)
class Reply:
    """An answer; reports of states are slower."""

    frame: Frame
    is_state: bool


def answer(computer: Mover, request: Frame) -> Reply | None:
    """Execute ``request``; None: silence."""
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
