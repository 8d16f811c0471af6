"""What can be ordered over the wire: id -> what the computer does. The acknowledgement says whether it did.

Payload layouts: pymycobot 4.0.7 and the vendor's communication protocol page. Acknowledgements are
one byte; that of 0x22 is known from logs of a real arm, the others are taken to be alike.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rejoint.arms import tcp_pose
from rejoint.arms.wire import values
from rejoint.arms.wire.computer import FULL_SPEED, Computer
from rejoint.arms.wire.states import joint_index

_JOG_LENGTH = 0.6
"""[m] longer than any line inside the arm's reach"""
_JOG_TURN = np.radians(175.0)
_GRIPPER = 7
"""Servo id of a gripper; none is fitted, but it has registers."""


def _all_joints(computer: Computer, on: bool) -> None:
    computer.enable(np.full(computer.arm.joints, on))


def _clear_error(computer: Computer) -> None:
    computer.error = 0


SWITCHES: dict[int, Callable[[Computer], None]] = {
    0x05: lambda computer: computer.clear_queue(),
    0x08: _clear_error,
    0x10: lambda computer: computer.power(True),
    0x11: lambda computer: computer.power(False),
    0x13: lambda computer: _all_joints(computer, False),
    0x26: lambda computer: computer.pause(),
    0x28: lambda computer: computer.resume(),
    0x29: lambda computer: computer.stop(),
}
"""Orders without a payload; they never fail."""


def _rate(speed_percent: int) -> float:
    """Speed byte 1..100 as a fraction; what is outside counts as the nearest end."""
    return min(max(speed_percent, 1), 100) / 100.0


def _set_fresh_mode(computer: Computer, payload: bytes) -> bool:
    computer.fresh = payload[0] == 1
    return True


def _set_free_mode(computer: Computer, payload: bytes) -> bool:
    _all_joints(computer, computer.powered and not payload[0])
    return True


def _move_one(
    computer: Computer, identity: int, speed_percent: int, *, to: float = 0.0, by: float | None = None
) -> bool:
    """Move one joint ``to`` an angle or ``by`` an angle [rad]; the others keep their destination."""
    joint = joint_index(computer, identity)
    if joint is None:
        return False
    angles = computer.destination
    angles[joint] = to if by is None else angles[joint] + by
    return computer.move_joints(angles, _rate(speed_percent))


def _move_axis(computer: Computer, payload: bytes, *, relative: bool) -> bool:
    """Change one of x y z rx ry rz of the destination."""
    axis = payload[0] - 1
    if not 0 <= axis < 6:
        return False
    value = values.scale_axis(axis, values.unpack_word(payload[1:3]))
    coords = values.to_coords(tcp_pose(computer.arm, computer.destination))
    coords[axis] = coords[axis] + value if relative else value
    return computer.move_tool(values.to_pose(coords), _rate(payload[3]), straight=False)


def _send_angle(computer: Computer, payload: bytes) -> bool:
    return _move_one(computer, payload[0], payload[3], to=values.unpack_angles(payload[1:3])[0])


def _send_angles(computer: Computer, payload: bytes) -> bool:
    return computer.move_joints(values.unpack_angles(payload[:12]), _rate(payload[12]))


def _send_coords(computer: Computer, payload: bytes) -> bool:
    pose = values.to_pose(values.unpack_coords(payload[:12]))
    return computer.move_tool(pose, _rate(payload[12]), straight=payload[13:] == b"\x01")


def _jog_angle(computer: Computer, payload: bytes) -> bool:
    joint = joint_index(computer, payload[0])
    return joint is not None and computer.jog_joint(joint, 1 if payload[1] else -1, _rate(payload[2]))


def _jog_increment_angle(computer: Computer, payload: bytes) -> bool:
    return _move_one(computer, payload[0], payload[3], by=values.unpack_angles(payload[1:3])[0])


def _jog_axis(computer: Computer, axis: int, payload: bytes) -> bool:
    """Run the tool along (0-2) or around (3-5) an axis of the base."""
    if not 0 <= axis < 6:
        return False
    sign = 1.0 if payload[1] else -1.0
    pose = tcp_pose(computer.arm, computer.planned_angles)
    if axis < 3:
        pose[axis, 3] += sign * _JOG_LENGTH
    else:
        turn = np.zeros(6)
        turn[axis] = sign * _JOG_TURN
        pose[:3, :3] = values.to_pose(turn)[:3, :3] @ pose[:3, :3]
    return computer.jog_tool(pose, _rate(payload[2]))


def _set_encoder(computer: Computer, payload: bytes) -> bool:
    angle = values.encoder_angle(values.unpack_word(payload[1:3]), computer.arm.encoder_step)
    return _move_one(computer, payload[0], payload[3], to=float(angle))


def _set_encoders(computer: Computer, payload: bytes) -> bool:
    angles = values.encoder_angle(values.unpack_int16(payload[:12]), computer.arm.encoder_step)
    return computer.move_joints(angles, _rate(payload[12]))


def _set_encoders_drag(computer: Computer, payload: bytes) -> bool:
    """Positions and speeds of all joints; all joints get the highest of the speeds."""
    step = computer.arm.encoder_step
    speed = float(values.unpack_int16(payload[12:]).max()) * step
    angles = values.encoder_angle(values.unpack_int16(payload[:12]), step)
    return computer.move_joints(angles, float(np.clip(speed / FULL_SPEED, 0.01, 1.0)))


def _set_limit(computer: Computer, payload: bytes, *, upper: bool) -> bool:
    """Narrow a joint's range; it never becomes wider than the arm's own."""
    joint = joint_index(computer, payload[0])
    if joint is None:
        return False
    angle = float(np.radians(values.unpack_word(payload[1:3]) / values.LIMIT_SCALE))
    lower, higher = (computer.lower[joint], angle) if upper else (angle, computer.upper[joint])
    slack = 1e-9
    if lower >= higher or lower < computer.arm.lower[joint] - slack or higher > computer.arm.upper[joint] + slack:
        return False
    computer.lower[joint], computer.upper[joint] = lower, higher
    return True


def _set_register(computer: Computer, payload: bytes) -> bool:
    servo, address = payload[:2]
    if not 1 <= servo <= _GRIPPER:
        return False
    computer.registers[servo, address] = payload[2] if len(payload) == 3 else values.unpack_word(payload[2:4])
    return True


def _calibrate(computer: Computer, payload: bytes) -> bool:
    joint = joint_index(computer, payload[0])
    if joint is not None:
        computer.calibrate(joint)
    return joint is not None


def _brake(computer: Computer, payload: bytes) -> bool:
    joint = joint_index(computer, payload[0])
    if joint is not None:
        computer.stop(joint)
    return joint is not None


def _switch_servo(computer: Computer, identity: int, *, on: bool) -> bool:
    """Switch one servo, or all with id 0."""
    joint = joint_index(computer, identity)
    if (joint is None and identity != 0) or (on and not computer.powered):
        return False
    wanted = computer.enabled.copy()
    wanted[slice(None) if joint is None else joint] = on
    computer.enable(wanted)
    return True


_FRAMES = {0x81: 12, 0x83: 12, 0x85: 1, 0x87: 1, 0x89: 1}
"""Orders that change what coordinates mean (frames of tool and base, lines as a rule), and their lengths [bytes]. Only
zeros, the arm's own frames, are carried out: to take coordinates in another frame for these would go elsewhere"""


def _own_frame(_: Computer, payload: bytes) -> bool:
    return not any(payload)


ORDERS: dict[int, tuple[tuple[int, ...], Callable[[Computer, bytes], bool]]] = {
    0x13: ((1,), lambda computer, _: _switch_servo(computer, 0, on=False)),
    0x16: ((1,), _set_fresh_mode),
    0x1A: ((1,), _set_free_mode),
    0x21: ((4,), _send_angle),
    0x22: ((13,), _send_angles),
    0x24: ((4,), lambda computer, payload: _move_axis(computer, payload, relative=False)),
    0x25: ((13, 14), _send_coords),
    0x30: ((3,), _jog_angle),
    0x31: ((3,), lambda computer, payload: _jog_axis(computer, payload[0] + 2, payload)),
    0x32: ((3,), lambda computer, payload: _jog_axis(computer, payload[0] - 1, payload)),
    0x33: ((4,), _jog_increment_angle),
    0x34: ((4,), lambda computer, payload: _move_axis(computer, payload, relative=True)),
    0x3A: ((4,), _set_encoder),
    0x3C: ((13,), _set_encoders),
    0x3E: ((24,), _set_encoders_drag),
    0x4C: ((3,), lambda computer, payload: _set_limit(computer, payload, upper=False)),
    0x4D: ((3,), lambda computer, payload: _set_limit(computer, payload, upper=True)),
    0x52: ((3, 5), _set_register),
    0x54: ((1,), _calibrate),
    0x55: ((1,), _brake),
    0x56: ((1, 2), lambda computer, payload: _switch_servo(computer, payload[0], on=False)),
    0x57: ((1,), lambda computer, payload: _switch_servo(computer, payload[0], on=True)),
    **{identity: ((length,), _own_frame) for identity, length in _FRAMES.items()},
    0x6A: ((3,), lambda _computer, _payload: True),  # colour of a lamp that is not there
}
"""Orders with a payload: its accepted lengths [bytes] and what is done; False is a refusal."""
