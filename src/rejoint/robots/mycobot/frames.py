"""Frames and numbers of the myCobot wire: big-endian signed 16-bit, truncated.

A frame is ``FE FE LEN ID payload FA``, LEN = payload bytes + 2. Angles x100 [deg], positions x10 [mm], joint limits x10
[deg]. Source: elephantrobotics/mycobot_docs, 18-communication, and pymycobot 4.0.7.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.arms.rotations import to_coords
from rejoint.robots.wireserver import Finder

ANGLE_SCALE = 100.0
LENGTH_SCALE = 10.0
LIMIT_SCALE = 10.0

ENCODER_ZERO = 2048
"""at joint angle zero (vendor's calibration examples)"""

_POSE_SCALE = np.array([LENGTH_SCALE * 1e3] * 3 + [np.degrees(1.0) * ANGLE_SCALE] * 3)
_SAME = 6


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
    """TCP pose (4, 4) as position and orientation."""
    return pack_int16(to_coords(pose) * _POSE_SCALE)


def unpack_coords(payload: bytes) -> Array:
    """Position [m] and zyx Euler angles [rad], (6,)."""
    return unpack_int16(payload) / _POSE_SCALE


def scale_axis(axis: int, value: float) -> float:
    """Return a coordinate in SI: axes 0-2 [m], 3-5 [rad]."""
    return float(value / _POSE_SCALE[axis])


def pack_encoders(angles: Array, step: float) -> bytes:
    """Joint angles (n,) [rad] as encoder counts of ``step`` [rad]."""
    return pack_int16(ENCODER_ZERO + np.round(angles / step))


def encoder_angle(count: float | Array, step: float) -> Array:
    """Joint angle [rad] of an encoder count."""
    return (np.asarray(count, dtype=float) - ENCODER_ZERO) * step


HEADER = b"\xfe\xfe"
FOOTER = 0xFA
MAX_PAYLOAD = 28
"""[bytes] that the client's reader accepts"""

_OVERHEAD = 2
"""[bytes] command id and footer in LEN"""


@dataclass(frozen=True)
class Frame:
    """One command or reply."""

    command: int
    payload: bytes = b""

    def __post_init__(self) -> None:
        if not 0 <= self.command <= 0xFF or len(self.payload) > MAX_PAYLOAD:
            raise ValueError(
                f"a frame holds an id of one byte and at most {MAX_PAYLOAD} payload bytes, "
                f"got id {self.command} and {len(self.payload)} bytes"
            )


def encode(frame: Frame) -> bytes:
    """Bytes of a frame."""
    return HEADER + bytes((len(frame.payload) + _OVERHEAD, frame.command)) + frame.payload + bytes((FOOTER,))


def size_of(data: bytes) -> int | None:
    """Size of the frame at the beginning; 0: none, None: incomplete."""
    if len(data) < 3:
        return None
    size = data[2] + 3
    if not _OVERHEAD <= data[2] <= MAX_PAYLOAD + _OVERHEAD:
        return 0
    return None if len(data) < size else size * (data[size - 1] == FOOTER)


class Decoder(Finder[Frame]):
    """Finds a myCobot's frames."""

    def __init__(self) -> None:
        super().__init__(HEADER, size_of, lambda data: Frame(data[3], data[4:-1]))
