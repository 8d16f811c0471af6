"""Arms by name, and in TOML and URDF files; what a file leaves open is completed.

docs/files.md lists the TOML keys. In a URDF, errors of zeros and links go into the joint origins: other programs ignore
``<calibration>`` tags.
"""

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np

from rejoint.arms.arm import MODELS, POINT, UNKNOWN, Arm, Array, Box, Loaded, Mask, described, dh_chain
from rejoint.arms.inertia import inertia_matrix, inertia_values, plausible
from rejoint.arms.kinematics import Displacement, tcp_position
from rejoint.arms.modelfile import Places, cut, read_tree
from rejoint.arms.rotations import pose_of, quaternion_of, roll_pitch_yaw, rotation_of, turned
from rejoint.arms.workspace import derive_targets, derive_workspace, length_size, on_a_surface, reach
from rejoint.system.errors import InputError
from rejoint.system.files import Number, Positive, Table, Text, Triple, as_path, read_toml, toml_of, write_text


class _FrameTable(Table):
    position_m: Triple | None = None
    quaternion: tuple[Number, Number, Number, Number] | None = None

    def __post_init__(self) -> None:
        if self.quaternion is not None and abs((norm := np.linalg.norm(self.quaternion)) - 1) > 1e-3:
            raise ValueError(f"expected a unit quaternion w, x, y, z, found one of length {norm:.4g}")

    @property
    def pose(self) -> Array:
        """(4, 4)."""
        turn = np.eye(3) if self.quaternion is None else rotation_of(np.array(self.quaternion))
        return pose_of(turn, np.array(self.position_m or (0.0, 0.0, 0.0)))


class _Bounds(Table):
    lower_m: Triple
    upper_m: Triple

    def __post_init__(self) -> None:
        self.box()

    def box(self) -> Box:
        return Box(lower=np.array(self.lower_m), upper=np.array(self.upper_m))


class _Dh(Table):
    d_m: Number = 0.0
    a_m: Number = 0.0
    alpha_deg: Number = 0.0
    offset_deg: Number = 0.0


class _JointTable(_FrameTable, kw_only=True):
    name: Text
    axis: Triple | None = None
    dh: _Dh | None = None
    lower_deg: Number = math.nan
    upper_deg: Number = math.nan
    max_speed_deg_s: Positive = math.nan
    servo: str = ""
    mass_kg: Positive = 0.0
    com_m: Triple = (0.0, 0.0, 0.0)
    inertia_kg_m2: tuple[Number, Number, Number, Number, Number, Number] = (math.nan,) * 6

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dh and (self.axis or self.position_m or self.quaternion):
            raise ValueError("a joint with a DH row has no other frame")
        if self.axis and np.linalg.norm(self.axis) < 1e-6:
            raise ValueError("an axis needs a direction, found zero")
        if math.isnan(self.lower_deg) != math.isnan(self.upper_deg) or self.lower_deg >= self.upper_deg:
            raise ValueError("lower_deg and upper_deg go together, the lower one first")
        if self.mass_kg == 0.0 and (any(self.com_m) or not math.isnan(self.inertia_kg_m2[0])):
            raise ValueError("com_m and inertia_kg_m2 need mass_kg beside them")


class _ArmFile(Table):
    name: Text
    joint: Annotated[list[_JointTable], msgspec.Meta(min_length=1)]
    floor_m: Number = math.nan
    encoder_counts_per_turn: Positive = math.nan
    servo_acceleration_rad_s2: Positive = math.inf
    rest_deg: list[Number] | None = None
    targets: _Bounds | None = None
    keep_out: tuple[_Bounds, ...] = ()
    tip: _FrameTable = msgspec.field(default_factory=_FrameTable)

    def __post_init__(self) -> None:
        names = [joint.name for joint in self.joint]
        if len({*names}) < len(names):
            raise ValueError(f"every joint needs a name of its own, found {', '.join(names)}")
        if len({joint.dh is None for joint in self.joint}) > 1:
            raise ValueError("either every joint has a DH row or none")
        if self.rest_deg is not None and len(self.rest_deg) != len(names):
            raise ValueError(f"rest_deg: expected {len(names)} angles, found {len(self.rest_deg)}")


def write_arm_toml(path: Path, arm: Arm) -> None:
    """Write an arm, accurate to 1e-12."""
    write_text(path, toml_of(_table(arm)))


def read_draft(path: Path) -> Loaded:
    """Read an arm's TOML file, unfinished; FileError."""
    found = read_toml(path, _ArmFile, "check the path of the arm")
    joints, servos = found.joint, tuple(joint.servo for joint in found.joint)
    offset, axis, end = _chain(joints)
    low, high = np.radians([(joint.lower_deg, joint.upper_deg) for joint in joints]).T
    arm = Arm(
        name=found.name,
        joint_names=tuple(joint.name for joint in joints),
        offset=offset,
        axis=axis,
        tip=end @ found.tip.pose,
        lower=low,
        upper=high,
        max_speed=np.radians([joint.max_speed_deg_s for joint in joints]),
        mass=np.array([joint.mass_kg for joint in joints]),
        com=np.array([joint.com_m for joint in joints]),
        inertia=np.array([inertia_matrix(joint.inertia_kg_m2) for joint in joints]),
        rest=np.radians([math.nan] * len(joints) if found.rest_deg is None else found.rest_deg),
        targets=UNKNOWN if found.targets is None else found.targets.box(),
        floor=found.floor_m,
        encoder_step=2 * np.pi / found.encoder_counts_per_turn,
        servo_acceleration=found.servo_acceleration_rad_s2,
        servos=servos if any(servos) else (),
        keep_out=tuple(bounds.box() for bounds in found.keep_out),
    )
    return Loaded(arm=arm)


def _table(arm: Arm) -> dict[str, Any]:
    return {
        "name": arm.name,
        "floor_m": arm.floor,
        "encoder_counts_per_turn": 2 * np.pi / arm.encoder_step,
        "servo_acceleration_rad_s2": arm.servo_acceleration if np.isfinite(arm.servo_acceleration) else None,
        "rest_deg": np.degrees(arm.rest),
        "targets": None if arm.targets.is_point else _bounds(arm.targets),
        "keep_out": [_bounds(box) for box in arm.keep_out] or None,
        "tip": _frame(arm.tip),
        "joint": [
            {
                "name": arm.joint_names[i],
                **_frame(arm.offset[i]),
                "axis": arm.axis[i],
                "lower_deg": np.degrees(arm.lower[i]),
                "upper_deg": np.degrees(arm.upper[i]),
                "max_speed_deg_s": np.degrees(arm.max_speed[i]),
                "servo": arm.servos[i] if arm.servos else None,
                "mass_kg": arm.mass[i],
                "com_m": arm.com[i],
                "inertia_kg_m2": inertia_values(arm.inertia[i]),
            }
            for i in range(arm.joints)
        ],
    }


def _bounds(box: Box) -> dict[str, Array]:
    return {"lower_m": box.lower, "upper_m": box.upper}


def _frame(pose: Array) -> dict[str, Array]:
    return {"position_m": pose[:3, 3], "quaternion": quaternion_of(pose[:3, :3])}


def _chain(joints: list[_JointTable]) -> tuple[Array, Array, Array]:
    """``offset`` (n, 4, 4), ``axis`` (n, 3) and the tip's parent frame (4, 4)."""
    if rows := [(dh.d_m, dh.a_m, dh.alpha_deg, dh.offset_deg) for joint in joints if (dh := joint.dh)]:
        table = np.array(rows)
        return dh_chain(np.hstack([table[:, :2], np.radians(table[:, 2:])]))
    axes = np.array([joint.axis or (0.0, 0.0, 1.0) for joint in joints])
    return np.array([joint.pose for joint in joints]), axes / np.linalg.norm(axes, axis=1)[:, None], np.eye(4)


EFFORT = "1000"
"""[N m] required in a URDF (chosen: unknown)"""
BASE, TOOL = "base", "tool"
"""First and last link"""


def unit_arm(arm: Arm, displacement: Displacement) -> Arm:
    """Arm with measured links and zeros, without compliance and play."""
    moved = displacement.moved(arm)
    offset = moved.offset.copy()
    offset[:, :3, :3] @= turned(arm.axis * displacement.offset[:, None])
    return replace(moved, offset=offset)


def write_urdf(path: Path, arm: Arm, note: str) -> None:
    """Write a URDF with links `BASE`, ``link1``, ..., `TOOL`, and ``note`` as a comment."""
    root = ET.Element("robot", name=arm.name)
    root.append(ET.Comment(f" {re.sub('-+', '-', note)} "))
    links = [BASE, *(f"link{i + 1}" for i in range(arm.joints)), TOOL]
    _add(root, "link", name=BASE)
    for i, pose in enumerate([*arm.offset, arm.tip]):
        turns = i < arm.joints
        link = _add(root, "link", name=links[i + 1])
        if turns and arm.mass[i] > 0.0:
            inertial = _add(link, "inertial")
            _add(inertial, "origin", xyz=arm.com[i], rpy=np.zeros(3))
            _add(inertial, "mass", value=arm.mass[i])
            moments = dict(zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), inertia_values(arm.inertia[i]), strict=True))
            _add(inertial, "inertia", **moments)
        name, kind = (arm.joint_names[i], "revolute") if turns else (f"{TOOL}_joint", "fixed")
        joint = _add(root, "joint", name=name, type=kind)
        _add(joint, "parent", link=links[i])
        _add(joint, "child", link=links[i + 1])
        _add(joint, "origin", xyz=pose[:3, 3], rpy=roll_pitch_yaw(pose[:3, :3]))
        if turns:
            _add(joint, "axis", xyz=arm.axis[i])
            _add(joint, "limit", lower=arm.lower[i], upper=arm.upper[i], velocity=arm.max_speed[i], effort=EFFORT)
    ET.indent(root)
    write_text(path, f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n')


def _add(parent: ET.Element, tag: str, **attributes: str | Array) -> ET.Element:
    texts = {
        name: value if isinstance(value, str) else " ".join(repr(float(one)) for one in np.atleast_1d(value))
        for name, value in attributes.items()
    }
    return ET.SubElement(parent, tag, texts)


DEFAULT_SPEED = np.radians(90.0)
"""[rad/s] of a joint without one (chosen)"""

DEFAULT_COUNTS = 4096
"""Encoder steps a turn of hobby servos; doubled until a step moves no tool farther than a myCobot's (chosen)"""

MOST_TURN = 4 * 2 * np.pi
"""[rad] larger limits are ignored (chosen)"""

FASTEST = 10 * 2 * np.pi
"""[rad/s] larger speeds are ignored (chosen)"""

LONGEST = 30.0
"""[m] larger reaches are refused (chosen)"""

FLOOR_RATIO = 0.04
"""over the reach (chosen)"""


def finish(draft: Loaded) -> Loaded:
    """Complete an arm in which NaN is unknown, as are masses of zero."""
    given, notes = draft.arm, list(draft.notes)
    if np.isnan(given.rest).any() and not np.isnan(given.targets.lower).any():
        raise InputError(f"arm {given.name}: targets are given without a rest posture; give rest_deg too, or neither")
    lower, upper = _limits(given, notes)
    rest = np.where(np.isnan(given.rest), (lower + upper) / 2, given.rest)
    arm = plausible(replace(given, lower=lower, upper=upper, rest=rest), notes)
    arm = replace(arm, max_speed=_speeds(given, notes))
    if reach(arm) > LONGEST:
        raise InputError(
            f"arm {arm.name}: its links add up to {reach(arm):.0f} m, at most {LONGEST:.0f} m were expected; "
            "are they in millimetres? give lengths in metres"
        )
    if np.isnan(arm.encoder_step):
        counts = DEFAULT_COUNTS * 2 ** max(0, int(np.ceil(np.log2(length_size(arm)))))
        arm = replace(arm, encoder_step=2 * np.pi / counts)
        notes.append(f"encoders: no resolution given; {counts} steps a turn assumed")
    if np.isnan(arm.floor):
        arm = replace(arm, floor=round(FLOOR_RATIO * reach(arm), 3))
        notes.append(f"floor: none given; {1e3 * arm.floor:.0f} mm above the base's origin assumed")
    if np.isnan(arm.targets.lower).any():
        arm = _with_workspace(arm, bool(np.isnan(given.rest).any()), notes)
    return Loaded(arm=arm, notes=tuple(notes))


def _with_workspace(arm: Arm, derives: bool, notes: list[str]) -> Arm:
    """Derive targets, and the rest posture too where it ``derives`` one; where there are none, the resting TCP."""
    try:
        rest, targets = (derive_workspace if derives and not on_a_surface(arm) else derive_targets)(arm)
    except InputError as error:
        tcp = tcp_position(arm, arm.rest)
        notes.append(f"targets: {error}; its logs can be used as those of any arm")
        return replace(arm, targets=Box(lower=tcp - POINT, upper=tcp + POINT))
    if rest is not arm.rest:
        notes.append(f"rest posture: none given; {_listed(np.degrees(rest))} deg derived by sampling")
    arm = replace(arm, rest=rest, targets=targets)
    low, high = _listed(1e3 * arm.targets.lower), _listed(1e3 * arm.targets.upper)
    notes.append(f"targets: none given; the box from {low} to {high} mm derived by sampling")
    return arm


def _limits(draft: Arm, notes: list[str]) -> tuple[Array, Array]:
    size = np.abs([draft.lower, draft.upper]).max(axis=0)
    given = _believed(draft, "limits", size, MOST_TURN, "turns", "+-180 deg", notes)
    return np.where(given, draft.lower, -np.pi), np.where(given, draft.upper, np.pi)


def _speeds(draft: Arm, notes: list[str]) -> Array:
    size = np.where(draft.max_speed > 0, draft.max_speed, np.nan)
    given = _believed(draft, "speed", size, FASTEST, "turns a second", f"{np.degrees(DEFAULT_SPEED):.0f} deg/s", notes)
    return np.where(given, draft.max_speed, DEFAULT_SPEED)


def _believed(draft: Arm, what: str, size: Array, most: float, unit: str, assumed: str, notes: list[str]) -> Mask:
    """Joints (n,) whose values are of a ``size`` (n,) up to ``most`` [rad], NaN: unknown; a note names the others."""
    wide = np.isfinite(size) & (size > most)
    if wide.any():
        notes.append(
            f"{what}: those of {', '.join(compress(draft.joint_names, wide))} are beyond "
            f"{most / (2 * np.pi):.0f} {unit}, and not believed; are they in degrees, where radians were expected?"
        )
    given: Mask = size <= most
    if not given.all():
        notes.append(f"{what}: none usable for {', '.join(compress(draft.joint_names, ~given))}; {assumed} assumed")
    return given


def _listed(values: Array) -> str:
    return f"({', '.join(f'{value:.0f}' for value in values)})"


CATALOGUE = tuple(path.stem for path in sorted(MODELS.glob("*.toml")))
"""Names of described arms"""

SUFFIXES = (".toml", ".urdf", ".xml", ".mjcf", ".xacro")
"""The last one gets the advice to make a URDF"""


ArmLike: TypeAlias = Arm | Loaded | str | Path
"""An arm, also as `read_arm` returns it, its catalogue name or its file"""


def load_arm(source: ArmLike, *, base: str | None = None, tip: str | None = None, hold: Places | None = None) -> Arm:
    """Load an arm by name, or from a TOML, URDF or MJCF file.

    Parameters
    ----------
    source
        a name of `CATALOGUE`, or a ``.toml``, ``.urdf``, ``.xml`` or ``.mjcf`` file; an arm stays as it is
    base, tip
        first and last body or site of a URDF or MJCF file; default: its root, the end of its only chain
    hold
        joints that stay, with their positions [rad], of slides [m], or as text: ``200mm``, ``30deg``

    Returns
    -------
    Arm
        `read_arm` names what was estimated

    Raises
    ------
    InputError, FileError
        for an unknown name, or an unusable file or chain

    Examples
    --------
    >>> arm = rejoint.load_arm("ur5e.urdf", base="base_link", tip="tool0")
    >>> rejoint.repair("emulated:worn", arm=arm)
    """
    return read_arm(source, base=base, tip=tip, hold=hold).arm


def read_arm(source: ArmLike, *, base: str | None = None, tip: str | None = None, hold: Places | None = None) -> Loaded:
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
    if isinstance(source, Arm | Loaded):
        return Loaded(arm=source) if isinstance(source, Arm) else source
    path, source = as_path("an arm, its name or its file", source), str(source)
    suffix = path.suffix.lower()
    if (base or tip or hold) and suffix not in SUFFIXES[1:]:
        raise InputError(
            f"base, tip and hold choose a chain of a URDF or MJCF file, and the arm is {source}; give the file"
        )
    if source.lower() in CATALOGUE:
        return Loaded(arm=described(source.lower()))
    if suffix not in SUFFIXES:
        raise InputError(
            f"no arm is called {source!r}; known arms: {', '.join(CATALOGUE)}, "
            f"or give a file that ends in {', '.join(SUFFIXES[:-1])}"
        )
    found = finish(read_draft(path) if suffix == ".toml" else cut(read_tree(path, hold), base, tip))
    name = found.arm.name
    if name not in CATALOGUE or found.arm.joint_names == described(name).joint_names:
        return found
    note = f"name: the {name} of the catalogue has other joints; own-{name} taken"
    return Loaded(arm=replace(found.arm, name=f"own-{name}"), notes=(*found.notes, note))
