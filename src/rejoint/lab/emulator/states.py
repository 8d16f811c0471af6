"""What can be asked over the wire: id -> answer payload, from the firmware's state.

Scales and layouts: pymycobot 4.0.7 (how the client reads each answer) and the vendor's
communication protocol page.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rejoint.arms import Array, tcp_pose
from rejoint.lab.emulator import values
from rejoint.lab.emulator.ailments import OVER_TEMPERATURE_BIT
from rejoint.lab.emulator.firmware import Firmware
from rejoint.lab.emulator.paths import solve_pose

MODIFY_VERSION = 1
SYSTEM_VERSION = 73
"""Firmware 7.3, the first with the joint limits of the present manual."""
CURRENT_PER_TORQUE = 2.7 / 2.94
"""[A/(N m)] of an STS3215 at 12 V: 2.7 A at its stall torque of 30 kg cm (Feetech data sheet)"""
DEFAULT_REGISTERS = {21: 10, 22: 0, 23: 1, 24: 0}
"""Servo registers P, I, D and minimum start force (vendor's manual)."""


def flag(value: bool) -> bytes:
    """One byte 0 or 1; also the acknowledgement: 1 done, 0 refused."""
    return b"\x01" if value else b"\x00"


def joint_index(firmware: Firmware, identity: int) -> int | None:
    """Index of the joint that is called 1..n on the wire; None for other servos."""
    return identity - 1 if 1 <= identity <= firmware.arm.joints else None


def _angles_and_coords(firmware: Firmware) -> bytes:
    angles = firmware.angles
    return values.pack_angles(angles) + values.pack_coords(tcp_pose(firmware.arm, angles))


def _currents(firmware: Firmware) -> Array:
    """(n,) [A]."""
    return np.maximum(np.abs(firmware.torque) * CURRENT_PER_TORQUE, firmware.ailments.current)


STATES: dict[int, Callable[[Firmware], bytes]] = {
    0x01: lambda _: bytes((MODIFY_VERSION,)),
    0x02: lambda _: bytes((SYSTEM_VERSION,)),
    0x06: lambda _: flag(True),
    0x07: lambda firmware: bytes((firmware.error,)),
    0x12: lambda firmware: flag(firmware.powered),
    0x14: lambda _: flag(True),
    0x15: lambda _: bytes(7),
    0x17: lambda firmware: flag(firmware.fresh),
    0x1B: lambda firmware: flag(firmware.powered and not firmware.enabled.any()),
    0x20: lambda firmware: values.pack_angles(firmware.angles),
    0x23: lambda firmware: values.pack_coords(firmware.pose),
    0x27: lambda firmware: flag(firmware.paused),
    0x2B: lambda firmware: flag(firmware.moving),
    0x3D: lambda firmware: values.pack_encoders(firmware.angles, firmware.arm.encoder_step),
    0x51: lambda firmware: flag(bool(firmware.enabled.all())),
    0xC1: lambda _: bytes((SYSTEM_VERSION,)),
    0xD5: _angles_and_coords,
    0xD8: lambda _: values.pack_int16([1]),
    0xE1: lambda firmware: values.pack_int16(firmware.speed / firmware.arm.encoder_step),
    0xE2: lambda firmware: values.pack_int16(_currents(firmware) * 1e3),
    0xE3: lambda firmware: values.pack_bytes(firmware.ailments.voltage * 10.0),
    0xE4: lambda firmware: values.pack_bytes(
        np.where(firmware.hot, OVER_TEMPERATURE_BIT, 0) | firmware.ailments.alarms
    ),
    0xE5: lambda firmware: values.pack_bytes(firmware.temperature),
    0xF6: lambda firmware: values.pack_angles(firmware.planned_angles),
    0xF7: lambda firmware: values.pack_coords(tcp_pose(firmware.arm, firmware.planned_angles)),
}
"""Questions without a payload."""


def _coords_of(firmware: Firmware, payload: bytes) -> bytes:
    return values.pack_coords(tcp_pose(firmware.arm, values.unpack_angles(payload)))


def _is_in_position(firmware: Firmware, payload: bytes) -> bytes:
    if payload[12]:
        return flag(firmware.at_pose(values.to_pose(values.unpack_coords(payload[:12]))))
    return flag(firmware.in_position(values.unpack_angles(payload[:12])))


def _encoder(firmware: Firmware, payload: bytes) -> bytes:
    joint = joint_index(firmware, payload[0])
    if joint is None:  # the gripper; none is fitted
        return values.pack_int16([-1])
    return values.pack_encoders(firmware.angles[joint : joint + 1], firmware.arm.encoder_step)


def _limit(limits: Array, payload: bytes) -> bytes | None:
    if not 1 <= payload[0] <= len(limits):
        return None
    return payload + values.pack_int16([np.degrees(limits[payload[0] - 1]) * values.LIMIT_SCALE])


def _is_servo_enabled(firmware: Firmware, payload: bytes) -> bytes:
    joint = joint_index(firmware, payload[0])
    return payload + flag(joint is not None and bool(firmware.enabled[joint]))


def _register(firmware: Firmware, payload: bytes) -> bytes:
    value = firmware.registers.get((payload[0], payload[1]), DEFAULT_REGISTERS.get(payload[1], 0))
    return values.pack_int16([value]) if payload[2:] == b"\x01" else bytes((value & 0xFF,))


def _inverse_kinematics(firmware: Firmware, payload: bytes) -> bytes | None:
    pose = values.to_pose(values.unpack_coords(payload[:12]))
    angles = solve_pose(firmware.arm, pose, values.unpack_angles(payload[12:]))
    return None if angles is None else values.pack_angles(angles)


QUESTIONS: dict[int, tuple[tuple[int, ...], Callable[[Firmware, bytes], bytes | None]]] = {
    0x23: ((12,), _coords_of),
    0x2A: ((13,), _is_in_position),
    0x3B: ((1,), _encoder),
    0x4A: ((1,), lambda firmware, payload: _limit(firmware.lower, payload)),
    0x4B: ((1,), lambda firmware, payload: _limit(firmware.upper, payload)),
    0x50: ((1,), _is_servo_enabled),
    0x53: ((2, 3), _register),
    0x8D: ((24,), _inverse_kinematics),
}
"""Questions with a payload: its accepted lengths [bytes] and the answer; None is silence."""
