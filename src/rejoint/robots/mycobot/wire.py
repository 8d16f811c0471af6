"""The myCobot's wire: frames, numbers (big-endian signed 16-bit, truncated), and answers to requests.

A frame is ``FE FE LEN ID payload FA``, LEN = payload bytes + 2. Angles x100 [deg], positions x10 [mm], joint limits x10
[deg]. One byte acknowledges an order; malformed requests get no answer. Source: elephantrobotics/mycobot_docs,
18-communication, and pymycobot 4.0.7.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Array, tcp_pose
from rejoint.arms.rotations import moved, to_coords, to_pose
from rejoint.robots.mycobot.mover import Mover, solve_pose
from rejoint.robots.wireserver import Format

ANGLE_SCALE = 100.0
LENGTH_SCALE = 10.0
LIMIT_SCALE = 10.0

ENCODER_ZERO = 2048
"""at joint angle zero (vendor's calibration examples)"""

_POSE_SCALE = np.array([LENGTH_SCALE * 1e3] * 3 + [np.degrees(1.0) * ANGLE_SCALE] * 3)
_SAME = 6


def pack_int16(values: ArrayLike) -> bytes:
    """Truncate towards zero, clip to 16 bit and pack."""
    whole = np.trunc(np.round(np.asarray(values, dtype=float), _SAME))
    return np.clip(whole, -32768, 32767).astype(">i2").tobytes()


def unpack_int16(payload: bytes) -> Array:
    """Inverse of `pack_int16`; (k,) for 2k bytes."""
    return np.frombuffer(payload, dtype=">i2").astype(float)


def pack_bytes(values: Iterable[float]) -> bytes:
    """Truncate and clip every value to one unsigned byte."""
    return bytes(int(np.clip(value, 0, 255)) for value in values)


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


def pack_encoders(angles: Array, step: float) -> bytes:
    """Joint angles (n,) [rad] as encoder counts of ``step`` [rad]."""
    return pack_int16(ENCODER_ZERO + np.round(angles / step))


def encoder_angle(count: float | Array, step: float) -> Array:
    """Joint angle [rad] of an encoder count."""
    return np.subtract(count, ENCODER_ZERO) * step


HEADER = b"\xfe\xfe"
FOOTER = 0xFA
MAX_PAYLOAD = 28
"""[bytes] that the client's reader accepts"""

_OVERHEAD = 2
"""[bytes] command id and footer in LEN"""


@dataclass(frozen=True)
class Frame:
    """One command or reply of at most `MAX_PAYLOAD` bytes."""

    command: int
    payload: bytes = b""


def encode(frame: Frame) -> bytes:
    """Bytes of a frame."""
    return HEADER + bytes((len(frame.payload) + _OVERHEAD, frame.command)) + frame.payload + bytes((FOOTER,))


def _size(head: bytes) -> int:
    return head[2] + 3 if _OVERHEAD <= head[2] <= MAX_PAYLOAD + _OVERHEAD else 0


def _read(data: bytes) -> Frame | None:
    return Frame(data[3], data[4:-1]) if data[-1] == FOOTER else None


FORMAT = Format(HEADER, 3, _size, _read, encode)


_JOG_LENGTH = 0.6
"""[m] beyond any reach"""
_JOG_TURN = np.radians(175.0)
MODIFY_VERSION = 1
SYSTEM_VERSION = 73
"""Computer 7.3, the first with the present joint limits"""

FIELDS: dict[str, tuple[int, Callable[[Mover, bytes], Any]]] = {
    "b": (1, lambda _, data: data[0]),
    "s": (1, lambda _, data: min(max(data[0], 1), 100) / 100.0),
    "j": (1, lambda computer, data: joint_index(computer, data[0])),
    "w": (2, lambda _, data: unpack_int16(data)[0]),
    "a": (2, lambda _, data: unpack_angles(data)[0]),
    "e": (2, lambda computer, data: encoder_angle(unpack_int16(data)[0], computer.arm.encoder_step)),
    "x": (12, lambda _, data: data),
    "A": (12, lambda _, data: unpack_angles(data)),
    "E": (12, lambda computer, data: encoder_angle(unpack_int16(data), computer.arm.encoder_step)),
    "P": (12, lambda _, data: to_pose(unpack_coords(data))),
}
"""Parts of a payload: length [bytes], and how it is read.
"""


def flag(value: object) -> bytes:
    """One byte."""
    return b"\x01" if value else b"\x00"


def joint_index(computer: Mover, identity: int) -> int | None:
    """Index of joint 1..n on the wire; None: another servo."""
    return identity - 1 if 1 <= identity <= computer.arm.joints else None


def _move_one(computer: Mover, joint: int, angle: float, rate: float, *, relative: bool = False) -> bool:
    angles = computer.destination
    angles[joint] = angle + (angles[joint] if relative else 0.0)
    return computer.move_joints(angles, rate)


def _move_axis(computer: Mover, number: int, value: float, rate: float, *, relative: bool) -> bool:
    axis = number - 1
    if not 0 <= axis < 6:
        return False
    coords = to_coords(tcp_pose(computer.arm, computer.destination))
    coords[axis] = value / _POSE_SCALE[axis] + (coords[axis] if relative else 0.0)
    return computer.move_tool(to_pose(coords), rate, straight=False, turned=axis >= 3)


def _move_tool(computer: Mover, pose: Array, rate: float, mode: int = 0) -> bool:
    return computer.move_tool(pose, rate, straight=mode == 1)


def _jog_axis(computer: Mover, number: int, forwards: int, rate: float, *, first: int) -> bool:
    axis = number - first
    if not 0 <= axis < 6:
        return False
    change = np.zeros(6)
    change[axis] = (1.0 if forwards else -1.0) * (_JOG_LENGTH if axis < 3 else _JOG_TURN)
    return computer.jog_tool(moved(tcp_pose(computer.arm, computer.planned_angles), change), rate)


def _set_limit(computer: Mover, joint: int, word: float, *, upper: bool) -> bool:
    angle, slack = float(np.radians(word / LIMIT_SCALE)), 1e-9
    lower, higher = (computer.lower[joint], angle) if upper else (angle, computer.upper[joint])
    if lower >= higher or lower < computer.arm.lower[joint] - slack or higher > computer.arm.upper[joint] + slack:
        return False
    computer.lower[joint], computer.upper[joint] = lower, higher
    return True


def _switch(computer: Mover, identity: int, _: int = 0, *, on: bool) -> bool:
    joint = joint_index(computer, identity)
    if (joint is None and identity != 0) or (on and not computer.powered):
        return False
    wanted = computer.enabled.copy()
    wanted[slice(None) if joint is None else joint] = on
    computer.enable(wanted)
    return True


def _free(computer: Mover, free: int = 1) -> None:
    computer.enable(np.full(computer.arm.joints, computer.powered and not free))


def _limit(limits: Array, joint: int | None) -> bytes | None:
    if joint is None:
        return None
    return bytes((joint + 1,)) + pack_int16([np.degrees(limits[joint]) * LIMIT_SCALE])


def _encoder(computer: Mover, joint: int | None) -> bytes:
    if joint is None:  # the gripper; none is fitted
        return pack_int16([-1])
    return pack_encoders(computer.angles[joint : joint + 1], computer.arm.encoder_step)


def _inverse_kinematics(computer: Mover, pose: Array, start: Array) -> bytes | None:
    angles = solve_pose(computer.arm, pose, start)
    return None if angles is None else pack_angles(angles)


def _is_there(computer: Mover, place: bytes, is_pose: int) -> bool:
    return computer.at_pose(to_pose(unpack_coords(place))) if is_pose else computer.in_position(unpack_angles(place))


def _coords(computer: Mover, angles: Array) -> bytes:
    return pack_coords(tcp_pose(computer.arm, angles))


Act = Callable[..., Any] | str | bytes
"""On the computer; the name of a method or property; or the answer"""
Table = dict[tuple[int, int], tuple[str, Act]]


def _table(*rows: tuple[int, str, Act]) -> Table:
    return {(command, sum(FIELDS[part][0] for part in layout)): (layout, act) for command, layout, act in rows}


ORDERS = _table(
    (0x05, "", "clear_queue"),
    (0x08, "", lambda computer: setattr(computer, "error", 0)),
    (0x10, "", lambda computer: computer.power(True)),
    (0x11, "", lambda computer: computer.power(False)),
    (0x13, "", _free),
    (0x13, "b", lambda computer, _: _free(computer, 1)),
    (0x16, "b", lambda computer, fresh: setattr(computer, "fresh", fresh == 1)),
    (0x1A, "b", _free),
    (0x21, "jas", _move_one),
    (0x22, "As", "move_joints"),
    (0x24, "bws", partial(_move_axis, relative=False)),
    (0x25, "Ps", _move_tool),
    (0x25, "Psb", _move_tool),
    (0x26, "", "pause"),
    (0x28, "", "resume"),
    (0x29, "", "stop"),
    (0x30, "jbs", "jog_joint"),
    (0x31, "bbs", partial(_jog_axis, first=-2)),
    (0x32, "bbs", partial(_jog_axis, first=1)),
    (0x33, "jas", partial(_move_one, relative=True)),
    (0x34, "bws", partial(_move_axis, relative=True)),
    (0x3A, "jes", _move_one),
    (0x3C, "Es", "move_joints"),
    (0x4C, "jw", partial(_set_limit, upper=False)),
    (0x4D, "jw", partial(_set_limit, upper=True)),
    (0x54, "j", "calibrate"),
    (0x55, "j", "stop"),
    (0x56, "b", partial(_switch, on=False)),
    (0x56, "bb", partial(_switch, on=False)),
    (0x57, "b", partial(_switch, on=True)),
    # frames of tool and base, and which of them counts: the arm's own
    *((command, "x", lambda _, frame: not any(frame)) for command in (0x81, 0x83)),
    *((command, "b", lambda _, frame: not frame) for command in (0x85, 0x87, 0x89)),
    (0x6A, "bbb", lambda *_: True),  # colour of a lamp that is not there
)
"""Actions by command and length [bytes]; False: refused"""
COMMANDS = frozenset(command for command, _ in ORDERS)
"""Those that order something"""

QUESTIONS = _table(
    (0x01, "", bytes((MODIFY_VERSION,))),
    *((command, "", bytes((SYSTEM_VERSION,))) for command in (0x02, 0xC1)),
    (0x07, "", "error"),
    (0x12, "", "powered"),
    *((command, "", b"\x01") for command in (0x06, 0x14)),
    (0x15, "", bytes(7)),
    (0x17, "", "fresh"),
    (0x1B, "", lambda computer: computer.powered and not computer.enabled.any()),
    (0x20, "", lambda computer: pack_angles(computer.angles)),
    (0x23, "", lambda computer: pack_coords(computer.pose)),
    (0x23, "A", _coords),
    (0x27, "", "paused"),
    (0x2A, "xb", _is_there),
    (0x2B, "", "moving"),
    (0x3B, "j", _encoder),
    (0x3D, "", lambda computer: pack_encoders(computer.angles, computer.arm.encoder_step)),
    (0x4A, "j", lambda computer, joint: _limit(computer.lower, joint)),
    (0x4B, "j", lambda computer, joint: _limit(computer.upper, joint)),
    (0x50, "b", lambda arm, servo: bytes((servo,)) + flag(0 < servo <= arm.arm.joints and arm.enabled[servo - 1])),
    (0x51, "", lambda computer: computer.enabled.all()),
    *((command, "", bytes(12)) for command in (0x82, 0x84)),  # frames of tool and base: the arm's own
    *((command, "", b"\x00") for command in (0x86, 0x88, 0x8A)),  # which counts, and lines as a rule
    (0x8D, "PA", _inverse_kinematics),
    (0xD5, "", lambda computer: pack_angles(computer.angles) + _coords(computer, computer.angles)),
    (0xD8, "", b"\x00\x01"),
    (0xE1, "", lambda computer: pack_int16(computer.sensed().speed / computer.arm.encoder_step)),
    (0xE2, "", lambda computer: pack_int16(computer.sensed().current * 1e3)),
    (0xE3, "", lambda computer: pack_bytes(computer.sensed().voltage * 10.0)),
    (0xE4, "", lambda computer: pack_bytes(computer.sensed().alarms)),
    (0xE5, "", lambda computer: pack_bytes(computer.sensed().temperature)),
    (0xF6, "", lambda computer: pack_angles(computer.planned_angles)),
    (0xF7, "", lambda computer: _coords(computer, computer.planned_angles)),
)
"""Answers likewise; None: silence"""


def answer(computer: Mover, request: Frame) -> Frame | None:
    """Execute ``request``; None: silence."""
    kind, given, start = (request.command, len(request.payload)), [], 0
    is_order = kind in ORDERS
    if not is_order and kind not in QUESTIONS:
        return None
    layout, act = (ORDERS if is_order else QUESTIONS)[kind]
    for size, read in (FIELDS[part] for part in layout):
        given.append(read(computer, request.payload[start : start + size]))
        start += size
    if isinstance(act, str):
        found: Any = getattr(computer, act)
    else:
        found = partial(act, computer) if callable(act) else act
    if is_order:
        found = all(part is not None for part in given) and found(*given) is not False
    elif callable(found):
        found = found(*given)
    if isinstance(found, bool | np.bool_ | int):
        found = bytes((int(found),))
    return None if found is None else Frame(request.command, found)
