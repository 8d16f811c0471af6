"""Numbers as they travel: scaled, truncated, big-endian signed 16-bit; poses as x y z rx ry rz.

Scales: angles x100 [deg], positions x10 [mm], orientations x100 [deg], joint limits x10 [deg]
(vendor's communication protocol page). The firmware truncates: logs of a real arm show one encoder
step (0.0879 deg) as 0.08 and two as 0.17.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

import numpy as np

from rejoint.arms import Array

ANGLE_SCALE = 100.0
LENGTH_SCALE = 10.0
LIMIT_SCALE = 10.0

ENCODER_ZERO = 2048
"""Encoder count at joint angle zero (vendor's calibration examples)."""

_POSE_SCALE = np.array([LENGTH_SCALE * 1e3] * 3 + [np.degrees(1.0) * ANGLE_SCALE] * 3)
_SAME = 6
"""Decimals kept before truncation, so that 45 deg computed in radians stays 45.00."""


def pack_int16(values: Iterable[float]) -> bytes:
    """Truncate towards zero, clip to 16 bit and pack."""
    whole = np.trunc(np.round(np.asarray(list(values), dtype=float), _SAME))
    return np.clip(whole, -32768, 32767).astype(">i2").tobytes()


def unpack_int16(payload: bytes) -> Array:
    """Inverse of `pack_int16`; (k,) for 2k bytes."""
    return np.frombuffer(payload, dtype=">i2").astype(float)


def pack_bytes(values: Iterable[float]) -> bytes:
    """Truncate and clip every value to one unsigned byte."""
    return bytes(int(np.clip(value, 0, 255)) for value in values)


def unpack_word(payload: bytes) -> int:
    """One signed 16-bit number."""
    return int(struct.unpack(">h", payload)[0])


def pack_angles(angles: Array) -> bytes:
    """Joint angles (n,) [rad]."""
    return pack_int16(np.degrees(angles) * ANGLE_SCALE)


def unpack_angles(payload: bytes) -> Array:
    """Joint angles (n,) [rad]."""
    return np.radians(unpack_int16(payload) / ANGLE_SCALE)


def pack_coords(pose: Array) -> bytes:
    """TCP pose (4, 4) as three positions and three orientations."""
    return pack_int16(to_coords(pose) * _POSE_SCALE)


def unpack_coords(payload: bytes) -> Array:
    """Position [m] and zyx Euler angles [rad], (6,)."""
    return unpack_int16(payload) / _POSE_SCALE


def scale_axis(axis: int, value: float) -> float:
    """One coordinate as it travels to SI: axes 0-2 are lengths [m], 3-5 angles [rad]."""
    return float(value / _POSE_SCALE[axis])


def to_coords(pose: Array) -> Array:
    """Pose (4, 4) to position [m] and Euler angles rx, ry, rz [rad] with R = Rz Ry Rx, (6,).

    At the singularity (ry = +-90 deg) rx is chosen zero.
    """
    r = pose[:3, :3]
    cosine = np.hypot(r[0, 0], r[1, 0])
    ry = np.arctan2(-r[2, 0], cosine)
    if cosine > 1e-9:
        rx, rz = np.arctan2(r[2, 1], r[2, 2]), np.arctan2(r[1, 0], r[0, 0])
    else:
        rx, rz = 0.0, np.arctan2(-r[0, 1], r[1, 1])
    return np.array([*pose[:3, 3], rx, ry, rz])


def to_pose(coords: Array) -> Array:
    """Inverse of `to_coords`."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(coords[3:]), np.cos(coords[3:])
    pose = np.eye(4)
    pose[:3, :3] = [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]
    pose[:3, 3] = coords[:3]
    return pose


def pack_encoders(angles: Array, step: float) -> bytes:
    """Joint angles (n,) [rad] as encoder counts, ``step`` [rad] a count."""
    return pack_int16(ENCODER_ZERO + np.round(angles / step))


def encoder_angle(count: float | Array, step: float) -> Array:
    """Joint angle [rad] at an encoder count."""
    return (np.asarray(count, dtype=float) - ENCODER_ZERO) * step
