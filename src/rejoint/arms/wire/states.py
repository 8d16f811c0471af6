"""What can be asked over the wire: id -> answer payload, from the state of the computer behind it.

Scales and layouts: pymycobot 4.0.7 (how the client reads each answer) and the vendor's
communication protocol page.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rejoint.arms import Array, tcp_pose
from rejoint.arms.wire import values
from rejoint.arms.wire.computer import Computer
from rejoint.arms.wire.paths import solve_pose

MODIFY_VERSION = 1
SYSTEM_VERSION = 73
"""Computer 7.3, the first with the joint limits of the present manual."""
DEFAULT_REGISTERS = {21: 10, 22: 0, 23: 1, 24: 0}
"""Servo registers P, I, D and minimum start force (vendor's manual)."""


def flag(value: bool) -> bytes:
    """One byte 0 or 1; also the acknowledgement: 1 done, 0 refused."""
    return b"\x01" if value else b"\x00"


def joint_index(computer: Computer, identity: int) -> int | None:
    """Index of the joint that is called 1..n on the wire; None for other servos."""
    return identity - 1 if 1 <= identity <= computer.arm.joints else None


def _angles_and_coords(computer: Computer) -> bytes:
    angles = computer.angles
    return values.pack_angles(angles) + values.pack_coords(tcp_pose(computer.arm, angles))


STATES: dict[int, Callable[[Computer], bytes]] = {
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
"""Questions without a payload."""


def _coords_of(computer: Computer, payload: bytes) -> bytes:
    return values.pack_coords(tcp_pose(computer.arm, values.unpack_angles(payload)))


def _is_in_position(computer: Computer, payload: bytes) -> bytes:
    if payload[12]:
        return flag(computer.at_pose(values.to_pose(values.unpack_coords(payload[:12]))))
    return flag(computer.in_position(values.unpack_angles(payload[:12])))


def _encoder(computer: Computer, payload: bytes) -> bytes:
    joint = joint_index(computer, payload[0])
    if joint is None:  # the gripper; none is fitted
        return values.pack_int16([-1])
    return values.pack_encoders(computer.angles[joint : joint + 1], computer.arm.encoder_step)


def _limit(limits: Array, payload: bytes) -> bytes | None:
    if not 1 <= payload[0] <= len(limits):
        return None
    return payload + values.pack_int16([np.degrees(limits[payload[0] - 1]) * values.LIMIT_SCALE])


def _is_servo_enabled(computer: Computer, payload: bytes) -> bytes:
    joint = joint_index(computer, payload[0])
    return payload + flag(joint is not None and bool(computer.enabled[joint]))


def _register(computer: Computer, payload: bytes) -> bytes:
    value = computer.registers.get((payload[0], payload[1]), DEFAULT_REGISTERS.get(payload[1], 0))
    return values.pack_int16([value]) if payload[2:] == b"\x01" else bytes((value & 0xFF,))


def _inverse_kinematics(computer: Computer, payload: bytes) -> bytes | None:
    pose = values.to_pose(values.unpack_coords(payload[:12]))
    angles = solve_pose(computer.arm, pose, values.unpack_angles(payload[12:]))
    return None if angles is None else values.pack_angles(angles)


QUESTIONS: dict[int, tuple[tuple[int, ...], Callable[[Computer, bytes], bytes | None]]] = {
    0x23: ((12,), _coords_of),
    0x2A: ((13,), _is_in_position),
    0x3B: ((1,), _encoder),
    0x4A: ((1,), lambda computer, payload: _limit(computer.lower, payload)),
    0x4B: ((1,), lambda computer, payload: _limit(computer.upper, payload)),
    0x50: ((1,), _is_servo_enabled),
    0x53: ((2, 3), _register),
    0x8D: ((24,), _inverse_kinematics),
}
"""Questions with a payload: its accepted lengths [bytes] and the answer; None is silence."""
