"""What can be ordered over the wire: id -> what the firmware does. The acknowledgement says whether it did.

Payload layouts: pymycobot 4.0.7 and the vendor's communication protocol page. Acknowledgements are
one byte; that of 0x22 is known from logs of a real arm, the others are taken to be alike.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rejoint.arms import tcp_pose
from rejoint.lab.emulator import values
from rejoint.lab.emulator.firmware import FULL_SPEED, Firmware
from rejoint.lab.emulator.states import joint_index

_JOG_LENGTH = 0.6
"""[m] longer than any line inside the arm's reach"""
_JOG_TURN = np.radians(175.0)
_GRIPPER = 7
"""Servo id of a gripper; none is fitted, but it has registers."""


def _all_joints(firmware: Firmware, on: bool) -> None:
    firmware.enable(np.full(firmware.arm.joints, on))


def _clear_error(firmware: Firmware) -> None:
    firmware.error = 0


SWITCHES: dict[int, Callable[[Firmware], None]] = {
    0x05: Firmware.clear_queue,
    0x08: _clear_error,
    0x10: lambda firmware: firmware.power(True),
    0x11: lambda firmware: firmware.power(False),
    0x13: lambda firmware: _all_joints(firmware, False),
    0x26: Firmware.pause,
    0x28: Firmware.resume,
    0x29: Firmware.stop,
}
"""Orders without a payload; they never fail."""


def _rate(speed_percent: int) -> float:
    """Speed byte 1..100 as a fraction; what is outside counts as the nearest end."""
    return min(max(speed_percent, 1), 100) / 100.0


def _set_fresh_mode(firmware: Firmware, payload: bytes) -> bool:
    firmware.fresh = payload[0] == 1
    return True


def _set_free_mode(firmware: Firmware, payload: bytes) -> bool:
    _all_joints(firmware, firmware.powered and not payload[0])
    return True


def _move_one(
    firmware: Firmware, identity: int, speed_percent: int, *, to: float = 0.0, by: float | None = None
) -> bool:
    """Move one joint ``to`` an angle or ``by`` an angle [rad]; the others keep their destination."""
    joint = joint_index(firmware, identity)
    if joint is None:
        return False
    angles = firmware.destination
    angles[joint] = to if by is None else angles[joint] + by
    return firmware.move_joints(angles, _rate(speed_percent))


def _move_axis(firmware: Firmware, payload: bytes, *, relative: bool) -> bool:
    """Change one of x y z rx ry rz of the destination."""
    axis = payload[0] - 1
    if not 0 <= axis < 6:
        return False
    value = values.scale_axis(axis, values.unpack_word(payload[1:3]))
    coords = values.to_coords(tcp_pose(firmware.arm, firmware.destination))
    coords[axis] = coords[axis] + value if relative else value
    return firmware.move_tool(values.to_pose(coords), _rate(payload[3]), straight=False)


def _send_angle(firmware: Firmware, payload: bytes) -> bool:
    return _move_one(firmware, payload[0], payload[3], to=values.unpack_angles(payload[1:3])[0])


def _send_angles(firmware: Firmware, payload: bytes) -> bool:
    return firmware.move_joints(values.unpack_angles(payload[:12]), _rate(payload[12]))


def _send_coords(firmware: Firmware, payload: bytes) -> bool:
    pose = values.to_pose(values.unpack_coords(payload[:12]))
    return firmware.move_tool(pose, _rate(payload[12]), straight=payload[13:] == b"\x01")


def _jog_angle(firmware: Firmware, payload: bytes) -> bool:
    joint = joint_index(firmware, payload[0])
    return joint is not None and firmware.jog_joint(joint, 1 if payload[1] else -1, _rate(payload[2]))


def _jog_increment_angle(firmware: Firmware, payload: bytes) -> bool:
    return _move_one(firmware, payload[0], payload[3], by=values.unpack_angles(payload[1:3])[0])


def _jog_axis(firmware: Firmware, axis: int, payload: bytes) -> bool:
    """Run the tool along (0-2) or around (3-5) an axis of the base."""
    if not 0 <= axis < 6:
        return False
    sign = 1.0 if payload[1] else -1.0
    pose = tcp_pose(firmware.arm, firmware.planned_angles)
    if axis < 3:
        pose[axis, 3] += sign * _JOG_LENGTH
    else:
        turn = np.zeros(6)
        turn[axis] = sign * _JOG_TURN
        pose[:3, :3] = values.to_pose(turn)[:3, :3] @ pose[:3, :3]
    return firmware.jog_tool(pose, _rate(payload[2]))


def _set_encoder(firmware: Firmware, payload: bytes) -> bool:
    angle = values.encoder_angle(values.unpack_word(payload[1:3]), firmware.arm.encoder_step)
    return _move_one(firmware, payload[0], payload[3], to=float(angle))


def _set_encoders(firmware: Firmware, payload: bytes) -> bool:
    angles = values.encoder_angle(values.unpack_int16(payload[:12]), firmware.arm.encoder_step)
    return firmware.move_joints(angles, _rate(payload[12]))


def _set_encoders_drag(firmware: Firmware, payload: bytes) -> bool:
    """Positions and speeds of all joints; all joints get the highest of the speeds."""
    step = firmware.arm.encoder_step
    speed = float(values.unpack_int16(payload[12:]).max()) * step
    angles = values.encoder_angle(values.unpack_int16(payload[:12]), step)
    return firmware.move_joints(angles, float(np.clip(speed / FULL_SPEED, 0.01, 1.0)))


def _set_limit(firmware: Firmware, payload: bytes, *, upper: bool) -> bool:
    """Narrow a joint's range; it never becomes wider than the arm's own."""
    joint = joint_index(firmware, payload[0])
    if joint is None:
        return False
    angle = float(np.radians(values.unpack_word(payload[1:3]) / values.LIMIT_SCALE))
    lower, higher = (firmware.lower[joint], angle) if upper else (angle, firmware.upper[joint])
    slack = 1e-9
    if lower >= higher or lower < firmware.arm.lower[joint] - slack or higher > firmware.arm.upper[joint] + slack:
        return False
    firmware.lower[joint], firmware.upper[joint] = lower, higher
    return True


def _set_register(firmware: Firmware, payload: bytes) -> bool:
    servo, address = payload[:2]
    if not 1 <= servo <= _GRIPPER:
        return False
    firmware.registers[servo, address] = payload[2] if len(payload) == 3 else values.unpack_word(payload[2:4])
    return True


def _calibrate(firmware: Firmware, payload: bytes) -> bool:
    joint = joint_index(firmware, payload[0])
    if joint is not None:
        firmware.calibrate(joint)
    return joint is not None


def _brake(firmware: Firmware, payload: bytes) -> bool:
    joint = joint_index(firmware, payload[0])
    if joint is not None:
        firmware.stop(joint)
    return joint is not None


def _switch_servo(firmware: Firmware, identity: int, *, on: bool) -> bool:
    """Switch one servo, or all with id 0."""
    joint = joint_index(firmware, identity)
    if (joint is None and identity != 0) or (on and not firmware.powered):
        return False
    wanted = firmware.enabled.copy()
    wanted[slice(None) if joint is None else joint] = on
    firmware.enable(wanted)
    return True


ORDERS: dict[int, tuple[tuple[int, ...], Callable[[Firmware, bytes], bool]]] = {
    0x13: ((1,), lambda firmware, _: _switch_servo(firmware, 0, on=False)),
    0x16: ((1,), _set_fresh_mode),
    0x1A: ((1,), _set_free_mode),
    0x21: ((4,), _send_angle),
    0x22: ((13,), _send_angles),
    0x24: ((4,), lambda firmware, payload: _move_axis(firmware, payload, relative=False)),
    0x25: ((13, 14), _send_coords),
    0x30: ((3,), _jog_angle),
    0x31: ((3,), lambda firmware, payload: _jog_axis(firmware, payload[0] + 2, payload)),
    0x32: ((3,), lambda firmware, payload: _jog_axis(firmware, payload[0] - 1, payload)),
    0x33: ((4,), _jog_increment_angle),
    0x34: ((4,), lambda firmware, payload: _move_axis(firmware, payload, relative=True)),
    0x3A: ((4,), _set_encoder),
    0x3C: ((13,), _set_encoders),
    0x3E: ((24,), _set_encoders_drag),
    0x4C: ((3,), lambda firmware, payload: _set_limit(firmware, payload, upper=False)),
    0x4D: ((3,), lambda firmware, payload: _set_limit(firmware, payload, upper=True)),
    0x52: ((3, 5), _set_register),
    0x54: ((1,), _calibrate),
    0x55: ((1,), _brake),
    0x56: ((1, 2), lambda firmware, payload: _switch_servo(firmware, payload[0], on=False)),
    0x57: ((1,), lambda firmware, payload: _switch_servo(firmware, payload[0], on=True)),
    0x6A: ((3,), lambda _firmware, _payload: True),  # colour of a lamp that is not there
}
"""Orders with a payload: its accepted lengths [bytes] and what is done; False is a refusal."""
