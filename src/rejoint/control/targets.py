"""Targets and poses: as objects, drawn, or in text files with columns.

Columns: ``x,y,z`` [mm]; perhaps ``dx,dy,dz`` (direction), ``rx,ry,rz`` [deg] (about fixed x, y, z) or ``qw,qx,qy,qz``;
perhaps ``weight`` [mm] per degree. A line with an empty orientation is a point.
Another unit stands in a title: ``x_m``, ``rx [rad]``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array, Box, Motors, choose_postures
from rejoint.arms.collision import collides
from rejoint.arms.postures import find_postures
from rejoint.arms.rotations import (
    WEIGHT,
    Orientation,
    between_directions,
    quaternion_of,
    roll_pitch_yaw,
    rotation_of,
    same_side,
    to_pose,
    tool_axis,
    turned,
)
from rejoint.arms.workspace import in_metres
from rejoint.logs.runlog import TWO_TURNS
from rejoint.system.errors import FileError, InputError
from rejoint.system.numbers import as_floats
from rejoint.system.textfile import ANGLES, COUNT, LENGTHS, read_columns

PLACE = ("x", "y", "z")
KINDS = {"direction": ("dx", "dy", "dz"), "angles_rad": ("rx", "ry", "rz"), "quaternion": ("qw", "qx", "qy", "qz")}
ORIENTED = "dx,dy,dz or rx,ry,rz or qw,qx,qy,qz, and perhaps weight"
_MEANINGS = {
    "time": {"s": 1.0, "ms": 1e-3},
    **dict.fromkeys(PLACE, LENGTHS),
    **{name: ANGLES if kind == "angles_rad" else COUNT for kind, names in KINDS.items() for name in names},
    "weight": COUNT,
}
_DEGREE = 1e3 * np.radians(1.0)  # a weight in m/rad, in mm/deg

Poses: TypeAlias = "tuple[Array, Orientation | None]"
"""Places (..., 3) [m] and orientations (...); None: any"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """A place of the tool, with at most one of three orientations.

    Examples
    --------
    >>> pose = rejoint.Pose(place_m=[0.18, 0.0, 0.2], direction=[0, 0, -1])  # the tool points down
    """

    place_m: ArrayLike
    """(3,) in the base frame"""
    direction: ArrayLike | None = None
    """(3,) tool axis in the base frame"""
    angles_rad: ArrayLike | None = None
    """(3,) [rad] about fixed x, then y, then z"""
    quaternion: ArrayLike | None = None
    """(4,) w, x, y, z"""
    weight_m: float = WEIGHT
    """[m/rad] of the orientation"""

    def __post_init__(self) -> None:
        kinds = self._kinds
        if len(kinds) > 1:
            raise InputError(f"pose: {kinds[0]} and {kinds[1]} are given, expected one of them")
        for name in ("place_m", *kinds):
            value, size = getattr(self, name), len(KINDS.get(name, PLACE))
            found = as_floats("pose", value, f"{size} finite numbers as {name}")
            if found.shape != (size,) or not np.isfinite(found).all():
                raise InputError(f"pose: {name} {value!r} is not {size} finite numbers")
            if name in ("direction", "quaternion") and not np.linalg.norm(found) > 0.0:
                raise InputError(f"pose: {name} is zero; give one of any other length")
            farthest = np.abs(found).max()
            if name == "angles_rad" and farthest > TWO_TURNS:
                said = f"{farthest:.4g} rad ({np.degrees(farthest):.5g} deg)"
                raise InputError(f"pose: an angle of {said}, beyond two turns; angles_rad is in radians")
        if not (np.isfinite(self.weight_m) and self.weight_m >= 0.0):
            raise InputError(f"pose: a weight is a number of metres from 0 on, got {self.weight_m}")

    @property
    def _kinds(self) -> list[str]:
        return [name for name in KINDS if getattr(self, name) is not None]

    @property
    def turned(self) -> bool:
        """Whether an orientation is wanted."""
        return self.weight_m > 0.0 and bool(self._kinds)

    def rotation(self, axis: Array) -> Array:
        """Wanted frame (3, 3) of a tool along ``axis`` (3,)."""
        if self.direction is not None:
            return pointing(axis, np.asarray(self.direction, dtype=float))
        if self.angles_rad is not None:
            return to_pose(np.append(np.zeros(3), self.angles_rad))[:3, :3]
        return np.eye(3) if self.quaternion is None else rotation_of(np.asarray(self.quaternion, dtype=float))


def placed(arm: Arm, poses: Sequence[Pose]) -> Poses:
    """Places (K, 3) [m] and orientations (K,); None for points alone."""
    return np.array([pose.place_m for pose in poses], dtype=float).reshape(-1, 3), oriented(tool_axis(arm), poses)


def oriented(axis: Array, poses: Sequence[Pose]) -> Orientation | None:
    """Orientations (K,) of a tool along ``axis`` (3,), or None."""
    if not any(pose.turned for pose in poses):
        return None
    return Orientation(
        rotation=np.stack([pose.rotation(axis) for pose in poses]),
        axis=axis,
        whole=np.array([pose.direction is None for pose in poses]),
        weight=np.array([pose.weight_m if pose.turned else 0.0 for pose in poses]),
    )


def in_mm(place: Array) -> str:
    """Describe a place (3,) [m]."""
    return f"({', '.join(f'{value:g}' for value in np.round(1e3 * place, 1) + 0.0)}) mm"


def in_words(turn: Orientation) -> str:
    """Describe an orientation (); empty: any."""
    if not turn.counts:
        return ""
    if not turn.whole:
        return "direction {:.2f} {:.2f} {:.2f}".format(*(np.round(turn.rotation @ turn.axis, 2) + 0.0))
    return "rx ry rz {:.1f} {:.1f} {:.1f} deg".format(*(np.round(np.degrees(roll_pitch_yaw(turn.rotation)), 1) + 0.0))


def read_poses(path: Path, most: int, first: Sequence[str] = PLACE) -> tuple[list[int], Array, list[Pose]]:
    """Read a file with columns ``first``, and perhaps orientations: lines, first column [s, m] and poses; FileError."""
    found, lines = read_columns(path, _MEANINGS, first, most=most, exact=False)
    kind, own = next(((kind, own) for kind, own in KINDS.items() if found.keys() >= {*own}), ("", ()))
    at = len(first)
    end = at + len(own)
    names = [*first, *own, *["weight"] * (bool(own) and "weight" in found)]
    if found.keys() != {*names}:
        raise FileError(
            path,
            f"the columns are {', '.join(found)}, expected {','.join(first)}",
            f"name them so, and perhaps {ORIENTED}; in {'s, ' * (first != PLACE)}mm and deg where no title names a "
            "unit, such as x_m",
        )
    values = np.column_stack([found[name] for name in names])
    poses = []
    for line, row in zip(lines.tolist(), values, strict=True):
        needed, given = row[:at], {}
        if own and not np.isnan(row[at:]).all():
            needed, given[kind] = row, row[at:end]
            if end < len(row):
                given["weight_m"] = float(row[end]) / _DEGREE
        try:
            if not np.isfinite(needed).all():
                raise InputError(f"expected {len(needed)} finite numbers")
            poses.append(Pose(place_m=row[at - len(PLACE) : at], **given))
        except InputError as error:
            raise FileError(path, f"line {line}: {error}", "give what the header says") from error
    return lines.tolist(), values[:, 0], poses


def knots_of(turn: Orientation) -> Array:
    """Directions (K, 3), or quaternions (K, 4) without jumps of sign, of orientations (K,) of one kind."""
    return same_side(quaternion_of(turn.rotation)) if turn.whole.all() else turn.rotation @ turn.axis


def turned_as(knots: Array, axis: Array, weight: float) -> Orientation:
    """Orientations (...) of directions (..., 3) or quaternions (..., 4)."""
    *shape, size = knots.shape
    return Orientation(
        rotation=rotation_of(knots) if size == 4 else pointing(axis, knots),
        axis=axis,
        whole=np.full(shape, size == 4),
        weight=np.full(shape, weight),
    )


def pointing(axis: Array, direction: Array) -> Array:
    """Smallest turns (..., 3, 3) of the unit ``axis`` into ``direction`` (..., 3)."""
    wanted = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    return turned(between_directions(np.broadcast_to(axis, wanted.shape), wanted))


_MOST = 250_000
"""[bytes] (chosen: ten thousand targets)"""
_WHOLE = 6
"""Joints that turn a tool freely"""
_NAMED = 5
"""Targets in an error (chosen)"""


def draw_targets(arm: Arm, *, sets: int, count: int = 10, seed: int = 0) -> Array:
    """Draw (sets, count, 3) [m] targets in the arm's region; more sets keep the first ones."""
    if sets < 1 or count < 1:
        raise InputError(f"targets: expected at least 1 set of at least 1, got {sets} of {count}")
    seeds = np.random.SeedSequence(seed)
    return np.stack([draw_set(arm, np.random.default_rng(stream), count) for stream in seeds.spawn(sets)])


_DRAWS, _AWAY = 100, 0.01
"""Most draws of a target beside boxes, and [m] of its straight way from them: the guard's margin and more (chosen)"""


def draw_set(arm: Arm, rng: np.random.Generator, count: int) -> Array:
    """Draw (count, 3) [m] targets; beside boxes, those with straight ways from the one before and from rest.

    InputError without a region, or where the boxes leave too few.
    """
    if arm.targets.is_point:
        raise InputError(
            f"targets: {arm.name} has no region to draw them from; give `targets` or another `rest_deg` in its file"
        )
    if not arm.keep_out:
        return arm.targets.sample(rng, (count,))
    crowded = replace(
        arm, keep_out=tuple(Box(lower=box.lower - _AWAY, upper=box.upper + _AWAY) for box in arm.keep_out)
    )
    found, begin, share = list[Array](), arm.rest[None], np.linspace(0.0, 1.0, 20)[:, None, None]
    for _ in range(_DRAWS * count):
        place = arm.targets.sample(rng, (1,))
        goal = find_postures(arm, place, begin[:1], None)
        if not collides(crowded, begin + share * (goal - begin)).any():
            found, begin = [*found, place[0]], np.vstack([goal, arm.rest])
        if len(found) == count:
            return np.array(found)
    raise InputError("keep_out: too few targets beside the boxes have straight ways; give targets, or other boxes")


def read_targets(path: Path, arm: Arm, motors: Motors | None = None) -> Poses:
    """Read targets (K, 3) [m] from a CSV file ``x,y,z`` in mm, and orientations (K,) or None; FileError."""
    lines, _, poses = read_poses(path, _MOST)
    if not lines:
        raise FileError(path, "no targets below the header", "add one line per target")
    targets, turns = placed(arm, poses)
    if problem := refused(arm, [f"line {number}" for number in lines], targets, turns, motors):
        raise FileError(path, problem, f"give places that the arm reaches{unit_hint(targets)}")
    return targets, turns


def refused(
    arm: Arm, names: list[str], points: Array, turns: Orientation | None = None, motors: Motors | None = None
) -> str:
    """Why ``points`` (K, 3) [m] are impossible, or empty; without ``motors`` none is too heavy."""
    why = choose_postures(arm, points, arm.rest, turn=turns, motors=motors).refusals
    bad = np.flatnonzero(why)
    told = [
        f"{names[k]}: {in_mm(points[k])} {'' if turns is None else f'with {in_words(turns[k])}: '}{why[k]}"
        for k in bad[:_NAMED]
    ]
    if turns is not None and arm.joints < _WHOLE and bool(turns.whole[bad].any()):
        told.append(f"an arm of {arm.joints} joints has a direction dx,dy,dz at most")
    return "; ".join(told) + (f"; and {len(bad) - _NAMED} more" if len(bad) > _NAMED else "")


def unit_hint(places: Array) -> str:
    """Hint for places (..., 3) [m] that look like metres."""
    return "; they look like metres, and millimetres are expected" if in_metres(places) else ""
