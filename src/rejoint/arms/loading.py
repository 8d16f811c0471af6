"""Arms by name, and in TOML and URDF files.

docs/files.md lists the TOML keys. `rejoint.arms.draft` completes missing values. In a URDF, errors of zeros and links
go into the joint origins: other programs ignore ``<calibration>`` tags.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from rejoint.arms.arm import Arm, Array, Box, DhRow, dh_chain
from rejoint.arms.catalogue import mycobot280, so101
from rejoint.arms.chain import cut
from rejoint.arms.displacement import Displacement
from rejoint.arms.draft import Draft, Loaded, finish
from rejoint.arms.inertia import NOTHING, SpatialInertia, inertia_matrix, inertia_values
from rejoint.arms.modelfile import read_tree, xacro_error
from rejoint.arms.rotations import quaternion_of, rotation_about, rotation_of
from rejoint.arms.workspace import posture_grid
from rejoint.system.errors import InputError
from rejoint.system.files import write_whole
from rejoint.system.tomltable import TomlTable, read_toml

_ARM_KEYS = (
    "name",
    "floor_m",
    "encoder_counts_per_turn",
    "servo_acceleration_rad_s2",
    "rest_deg",
    "targets",
    "keep_out",
    "tip",
    "joint",
)
_FRAME_KEYS = ("position_m", "quaternion", "axis")
_LINK_KEYS = ("mass_kg", "com_m", "inertia_kg_m2")
_JOINT_KEYS = ("name", *_FRAME_KEYS, "dh", "lower_deg", "upper_deg", "max_speed_deg_s", "servo", *_LINK_KEYS)
_BOX_KEYS = ("lower_m", "upper_m")
_DH_KEYS = ("d_m", "a_m", "alpha_deg", "offset_deg")


def write_arm_toml(path: Path, arm: Arm, notes: Sequence[str] = ()) -> None:
    """Write an arm, accurate to 1e-12; ``notes`` become comments."""
    own = {"rest_deg": np.degrees(arm.rest).tolist(), "targets": _bounds(arm.targets)}
    _write(path, [f"# {note}" for note in notes], _table(arm) | own)


def write_unfinished(path: Path, arm: Arm, notes: Sequence[str] = ()) -> int:
    """Write an arm without rest posture; returns its line (from 1)."""
    zeros = ", ".join(["0"] * arm.joints)
    line = f"# rest_deg = [{zeros}]  # take away the first #: tool in front, elbow up, no joint near a limit"
    lines = [*(f"# {note}" for note in notes), line]
    _write(path, lines, _table(arm))
    return "\n".join(lines).count("\n") + 1


def read_draft(path: Path) -> Draft:
    """Read an arm's TOML file; FileError."""
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
        keep_out=tuple(_box(table) for table in top.tables("keep_out", _BOX_KEYS)) if "keep_out" in top.data else (),
    )


def _write(path: Path, lines: Sequence[str], table: dict[str, Any]) -> None:
    text = "\n".join([*lines, tomlkit.dumps(table)])
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _table(arm: Arm) -> dict[str, Any]:
    known: dict[str, Any] = {"keep_out": [_bounds(box) for box in arm.keep_out]} if arm.keep_out else {}
    if np.isfinite(arm.servo_acceleration):
        known["servo_acceleration_rad_s2"] = float(arm.servo_acceleration)
    return {
        "name": arm.name,
        "floor_m": float(arm.floor),
        "encoder_counts_per_turn": float(2 * np.pi / arm.encoder_step),
        **known,
        "tip": _frame(arm.tip),
        "joint": [
            {
                "name": arm.joint_names[i],
                **_frame(arm.offset[i]),
                "axis": arm.axis[i].tolist(),
                "lower_deg": float(np.degrees(arm.lower[i])),
                "upper_deg": float(np.degrees(arm.upper[i])),
                "max_speed_deg_s": float(np.degrees(arm.max_speed[i])),
                **({"servo": arm.servos[i]} if any(arm.servos[i : i + 1]) else {}),
                "mass_kg": float(arm.mass[i]),
                "com_m": arm.com[i].tolist(),
                "inertia_kg_m2": inertia_values(arm.inertia[i]).tolist(),
            }
            for i in range(arm.joints)
        ],
    }


def _bounds(box: Box) -> dict[str, list[float]]:
    return dict(zip(_BOX_KEYS, (box.lower.tolist(), box.upper.tolist()), strict=True))


def _frame(pose: Array) -> dict[str, list[float]]:
    return {"position_m": pose[:3, 3].tolist(), "quaternion": quaternion_of(pose[:3, :3]).tolist()}


def _chain(joints: list[TomlTable]) -> tuple[Array, Array, Array]:
    """``offset`` (n, 4, 4), ``axis`` (n, 3) and the tip's parent frame (4, 4)."""
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
    return _box(top.table("targets", _BOX_KEYS)) if "targets" in top.data else None


def _box(table: TomlTable) -> Box:
    lower, upper = table.numbers("lower_m", 3), table.numbers("upper_m", 3)
    if lower is None or upper is None:
        raise table.error("lower_m" if lower is None else "upper_m", "expected 3 finite numbers, found nothing")
    try:
        return Box(lower=lower, upper=upper)
    except InputError as error:
        raise table.error("upper_m", str(error)) from error


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


EFFORT = "1000"
"""[N m] required in a URDF (chosen: unknown)"""
BASE, TOOL = "base", "tool"
"""First and last link"""


def unit_arm(arm: Arm, displacement: Displacement) -> Arm:
    """Arm with measured links and zeros, without compliance and play."""
    moved = displacement.moved(arm)
    offset = moved.offset.copy()
    for i, (axis, angle) in enumerate(zip(arm.axis, displacement.offset, strict=True)):
        offset[i, :3, :3] = offset[i, :3, :3] @ rotation_about(axis, float(angle))
    return replace(moved, offset=offset)


def at_targets(arm: Arm) -> Array:
    """Postures (27, n) [rad] over the target region."""
    return posture_grid(arm, 3).q


def write_urdf(path: Path, arm: Arm, note: str = "") -> None:
    """Write a URDF with ``note`` as a comment."""
    text = urdf_text(arm, note)
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def urdf_text(arm: Arm, note: str = "") -> str:
    """URDF with links `BASE`, ``link1``, ..., `TOOL`."""
    root = ET.Element("robot", name=arm.name)
    if note:
        root.append(ET.Comment(f" {note.replace('--', '-')} "))
    ET.SubElement(root, "link", name=BASE)
    for i, name in enumerate(arm.joint_names):
        _urdf_link(root, arm, i)
        joint = _urdf_joint(root, name, "revolute", BASE if i == 0 else f"link{i}", f"link{i + 1}", arm.offset[i])
        ET.SubElement(joint, "axis", xyz=_numbers(arm.axis[i]))
        limit = {"lower": arm.lower[i], "upper": arm.upper[i], "velocity": arm.max_speed[i]}
        ET.SubElement(joint, "limit", {key: repr(float(value)) for key, value in limit.items()}, effort=EFFORT)
    ET.SubElement(root, "link", name=TOOL)
    _urdf_joint(root, f"{TOOL}_joint", "fixed", f"link{arm.joints}", TOOL, arm.tip)
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _urdf_link(root: ET.Element, arm: Arm, i: int) -> None:
    link = ET.SubElement(root, "link", name=f"link{i + 1}")
    if not arm.mass[i] > 0.0:
        return
    inertial, inertia = ET.SubElement(link, "inertial"), arm.inertia[i]
    ET.SubElement(inertial, "origin", xyz=_numbers(arm.com[i]), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(float(arm.mass[i])))
    places = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {key: repr(float(inertia[place])) for key, place in places.items()})


def _urdf_joint(root: ET.Element, name: str, kind: str, parent: str, child: str, pose: Array) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_numbers(pose[:3, 3]), rpy=_numbers(roll_pitch_yaw(pose[:3, :3])))
    return joint


def roll_pitch_yaw(rotation: Array) -> Array:
    """Angles (3,) [rad] about fixed x, y, z, as in URDF."""
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    rest = rotation_about(np.array([0.0, 0.0, 1.0]), -yaw) @ rotation
    return np.array([np.arctan2(-rest[1, 2], rest[1, 1]), np.arctan2(-rest[2, 0], rest[0, 0]), yaw])


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)


CATALOGUE: dict[str, Callable[[], Arm]] = {"mycobot280": mycobot280, "so101": so101}

SUFFIXES = (".toml", ".urdf", ".xml", ".mjcf")


def load_arm(
    source: str | Path, *, base: str | None = None, tip: str | None = None, hold: Mapping[str, float] | None = None
) -> Arm:
    """Load an arm by name, or from a TOML, URDF or MJCF file.

    Parameters
    ----------
    source
        ``mycobot280``, ``so101``, or a path that ends in ``.toml``, ``.urdf``, ``.xml`` or ``.mjcf``
    base, tip
        first and last body (or site) in a URDF or MJCF file; by default its root and the end of its only chain
    hold
        its joints that stay where they are, with their positions [rad], of slides [m]

    Returns
    -------
    Arm
        geometry, limits and masses; `read_arm` names what had to be estimated

    Raises
    ------
    InputError, FileError
        for an unknown name, or a file or chain that cannot be used

    Examples
    --------
    >>> arm = rejoint.load_arm("ur5e.urdf", base="base_link", tip="tool0")
    >>> rejoint.repair("emulated:worn", arm=arm)
    """
    return read_arm(source, base=base, tip=tip, hold=hold).arm


def read_arm(
    source: str | Path, *, base: str | None = None, tip: str | None = None, hold: Mapping[str, float] | None = None
) -> Loaded:
    r"""Load an arm as `load_arm` does, with notes on assumptions.

    Parameters
    ----------
    source, base, tip, hold
        as for `load_arm`

    Returns
    -------
    Loaded
        ``arm``, and ``notes``: a sentence for each missing or wrong value

    Raises
    ------
    InputError, FileError
        as `load_arm`

    Examples
    --------
    >>> loaded = rejoint.read_arm("ur5e.urdf")
    >>> print(*loaded.notes, sep="\n")
    """
    path, source = Path(source), str(source)
    is_file = path.suffix.lower() in SUFFIXES
    if (base or tip or hold) and (not is_file or path.suffix.lower() == ".toml"):
        raise InputError(f"base, tip and hold choose a chain of a URDF or MJCF file; {source} is one already")
    if source.lower() in CATALOGUE:
        return Loaded(arm=CATALOGUE[source.lower()]())
    if path.suffix.lower() == ".xacro":
        raise xacro_error(path)
    if not is_file:
        raise InputError(
            f"no arm is called {source!r}; known arms: {', '.join(sorted(CATALOGUE))}, "
            f"or give a file that ends in {', '.join(SUFFIXES)}"
        )
    return finish(read_draft(path) if path.suffix.lower() == ".toml" else cut(read_tree(path, hold), base, tip))
