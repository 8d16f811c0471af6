"""An arm as a TOML file that its owner can read and edit; units are in the key names.

::

    name = "my-arm"
    floor_m = 0.02                          # optional, as are all keys marked so
    encoder_counts_per_turn = 4096          # optional
    servo_acceleration_rad_s2 = 39          # optional: to which the servos are set to limit that of their reference
    rest_deg = [0, -30, 60]                 # optional

    [targets]                               # optional
    lower_m = [0.1, -0.1, 0.1]
    upper_m = [0.2, 0.1, 0.2]

    [tip]                                   # the TCP in the frame of the last joint, or beyond its DH row
    position_m = [0, 0, 0.1]                # optional, zero
    quaternion = [1, 0, 0, 0]               # optional, w x y z

    [[joint]]                               # one for each joint, from the base on
    name = "shoulder"
    position_m = [0, 0, 0.05]               # of the joint frame in the frame before it; optional, zero
    quaternion = [1, 0, 0, 0]               # optional, w x y z
    axis = [0, 0, 1]                        # in the joint frame; optional
    lower_deg = -90                         # optional, as are the rest
    upper_deg = 90
    max_speed_deg_s = 120
    servo = "sts3215, P 32"                 # type and gains; joints with the same text have servos that are alike
    mass_kg = 0.2                           # of the link that moves with the joint, in the joint frame
    com_m = [0, 0, 0.05]
    inertia_kg_m2 = [1e-3, 1e-3, 1e-3, 0, 0, 0]   # about the centre of mass: xx, yy, zz, xy, xz, yz

Instead of ``position_m``, ``quaternion`` and ``axis``, every joint may have one row of a standard
Denavit-Hartenberg table: ``dh = { d_m = 0.13, a_m = 0.0, alpha_deg = 90, offset_deg = 0 }``. Values that are
left out are completed as :mod:`rejoint.arms.draft` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rejoint.arms.arm import Arm, Array, Box, DhRow, dh_chain
from rejoint.arms.draft import Draft
from rejoint.arms.inertia import NOTHING, SpatialInertia, inertia_matrix, inertia_values
from rejoint.arms.rotations import quaternion_of, rotation_of
from rejoint.system.errors import InputError
from rejoint.system.files import write_whole
from rejoint.system.tomltable import TomlTable, read_toml

_ARM_KEYS = ("name", "floor_m", "encoder_counts_per_turn", "servo_acceleration_rad_s2", "rest_deg", "targets", "tip",
             "joint")  # fmt: skip
_FRAME_KEYS = ("position_m", "quaternion", "axis")
_LINK_KEYS = ("mass_kg", "com_m", "inertia_kg_m2")
_JOINT_KEYS = ("name", *_FRAME_KEYS, "dh", "lower_deg", "upper_deg", "max_speed_deg_s", "servo", *_LINK_KEYS)
_DH_KEYS = ("d_m", "a_m", "alpha_deg", "offset_deg")


def write_arm_toml(path: Path, arm: Arm, notes: Sequence[str] = ()) -> None:
    """Write an arm so that reading it gives the same numbers to 1e-12; ``notes`` become comments at the top."""
    text = _text(arm, notes, f"rest_deg = {_listed(np.degrees(arm.rest))}", _targets_block(arm))
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_unfinished(path: Path, arm: Arm, notes: Sequence[str] = ()) -> int:
    """Write an arm whose owner is to give its rest posture; returns the number of the line to do so, from 1."""
    zeros = ", ".join(["0"] * arm.joints)
    line = f"# rest_deg = [{zeros}]  # take away the first #: tool in front, elbow up, no joint near a limit"
    text = _text(arm, notes, line, "")
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return text.split("\n").index(line) + 1


def read_draft(path: Path) -> Draft:
    """Read an arm's TOML file; FileError names the line and the key that cannot be used."""
    top = read_toml(path, _ARM_KEYS, "check the path of the arm")
    name = top.string("name")
    joints = top.tables("joint", _JOINT_KEYS)
    names = tuple(joint.string("name") for joint in joints)
    servos = tuple(joint.string("servo") if "servo" in joint.data else "" for joint in joints)
    for joint, own in zip(joints, names, strict=True):
        if names.count(own) > 1:
            raise joint.error("name", f"two joints are called {own!r}")
    offset, axis, end = _chain(joints)
    tip = end @ _pose(top.table("tip", ("position_m", "quaternion")))
    counts = top.number("encoder_counts_per_turn", above=0.0)
    rest = top.numbers("rest_deg", len(joints))
    return Draft(
        name=name,
        joint_names=names,
        offset=offset,
        axis=axis,
        tip=tip,
        lower=np.radians([_or_nan(joint.number("lower_deg")) for joint in joints]),
        upper=np.radians([_or_nan(joint.number("upper_deg")) for joint in joints]),
        max_speed=np.radians([_or_nan(joint.number("max_speed_deg_s", above=0.0)) for joint in joints]),
        links=tuple(_link(joint) for joint in joints),
        rest=None if rest is None else np.radians(rest),
        targets=_targets(top),
        floor=top.number("floor_m"),
        encoder_step=None if counts is None else 2 * np.pi / counts,
        servo_acceleration=top.number("servo_acceleration_rad_s2", above=0.0) or np.inf,
        servos=servos if any(servos) else (),
    )


def _text(arm: Arm, notes: Sequence[str], rest: str, targets: str) -> str:
    known = np.isfinite(arm.servo_acceleration)
    limit = f"servo_acceleration_rad_s2 = {float(arm.servo_acceleration)!r}\n" if known else ""
    head = (
        f"name = {_quoted(arm.name)}\n"
        f"floor_m = {arm.floor!r}\n"
        f"encoder_counts_per_turn = {float(2 * np.pi / arm.encoder_step)!r}\n{limit}"
        f"{rest}\n"
    )
    tip = f"[tip]\nposition_m = {_listed(arm.tip[:3, 3])}\nquaternion = {_listed(quaternion_of(arm.tip[:3, :3]))}\n"
    blocks = ["".join(f"# {note}\n" for note in notes) + head, targets, tip]
    blocks += [_joint_block(arm, i) for i in range(arm.joints)]
    return "\n".join(block for block in blocks if block)


def _targets_block(arm: Arm) -> str:
    return f"[targets]\nlower_m = {_listed(arm.targets.lower)}\nupper_m = {_listed(arm.targets.upper)}\n"


def _joint_block(arm: Arm, i: int) -> str:
    lines = {
        "name": _quoted(arm.joint_names[i]),
        "position_m": _listed(arm.offset[i, :3, 3]),
        "quaternion": _listed(quaternion_of(arm.offset[i, :3, :3])),
        "axis": _listed(arm.axis[i]),
        "lower_deg": repr(float(np.degrees(arm.lower[i]))),
        "upper_deg": repr(float(np.degrees(arm.upper[i]))),
        "max_speed_deg_s": repr(float(np.degrees(arm.max_speed[i]))),
        **({"servo": _quoted(arm.servos[i])} if any(arm.servos[i : i + 1]) else {}),
        "mass_kg": repr(float(arm.mass[i])),
        "com_m": _listed(arm.com[i]),
        "inertia_kg_m2": _listed(inertia_values(arm.inertia[i]))
        + "  # xx, yy, zz, xy, xz, yz about the centre of mass",
    }
    return "[[joint]]\n" + "".join(f"{key} = {value}\n" for key, value in lines.items())


def _chain(joints: list[TomlTable]) -> tuple[Array, Array, Array]:
    """``offset`` (n, 4, 4), ``axis`` (n, 3) and the pose (4, 4) that the tip is given in."""
    with_row = [joint for joint in joints if "dh" in joint.data]
    if not with_row:
        return np.array([_pose(joint) for joint in joints]), np.array([_axis(joint) for joint in joints]), np.eye(4)
    for joint in joints:
        if joint not in with_row:
            raise joint.error("dh", "either every joint has a DH row or none")
        for key in _FRAME_KEYS:
            if key in joint.data:
                raise joint.error(key, "a joint with a DH row has no other frame")
    return dh_chain([_dh_row(joint.table("dh", _DH_KEYS)) for joint in joints])


def _dh_row(row: TomlTable) -> DhRow:
    d, a, alpha, offset = (row.number(key) or 0.0 for key in _DH_KEYS)
    return DhRow(d=d, a=a, alpha=float(np.radians(alpha)), offset=float(np.radians(offset)))


def _pose(table: TomlTable) -> Array:
    pose = np.eye(4)
    position, quaternion = table.numbers("position_m", 3), table.numbers("quaternion", 4)
    if position is not None:
        pose[:3, 3] = position
    if quaternion is not None:
        norm = float(np.linalg.norm(quaternion))
        if abs(norm - 1) > 1e-3:
            raise table.error("quaternion", f"expected a unit quaternion w, x, y, z, found one of length {norm:.4g}")
        pose[:3, :3] = rotation_of(quaternion)
    return pose


def _axis(joint: TomlTable) -> Array:
    axis = joint.numbers("axis", 3)
    if axis is None:
        return np.array([0.0, 0.0, 1.0])
    norm = float(np.linalg.norm(axis))
    if norm < 1e-6:
        raise joint.error("axis", "an axis needs a direction, found zero")
    return axis / norm


def _link(joint: TomlTable) -> SpatialInertia:
    mass = joint.number("mass_kg", above=0.0)
    com, moments = joint.numbers("com_m", 3), joint.numbers("inertia_kg_m2", 6)
    if mass is None:
        for key in _LINK_KEYS[1:]:
            if key in joint.data:
                raise joint.error(key, "needs mass_kg beside it")
        return NOTHING
    centre = np.zeros(3) if com is None else com
    if moments is None:
        return SpatialInertia(mass=mass, com=centre, inertia=np.zeros((3, 3)), doubtful=True)
    return SpatialInertia(mass=mass, com=centre, inertia=inertia_matrix(moments))


def _targets(top: TomlTable) -> Box | None:
    if "targets" not in top.data:
        return None
    table = top.table("targets", ("lower_m", "upper_m"))
    lower, upper = table.numbers("lower_m", 3), table.numbers("upper_m", 3)
    if lower is None or upper is None:
        raise table.error("lower_m" if lower is None else "upper_m", "expected 3 finite numbers, found nothing")
    try:
        return Box(lower=lower, upper=upper)
    except InputError as error:
        raise table.error("upper_m", str(error)) from error


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def _quoted(text: str) -> str:
    escaped = "".join(f"\\u{ord(c):04x}" if c in '"\\' or ord(c) < 32 or ord(c) == 127 else c for c in text)
    return f'"{escaped}"'


def _listed(values: Array) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"
