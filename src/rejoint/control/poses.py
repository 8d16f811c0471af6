"""Poses as users give them: places with a direction of the tool or its whole orientation, as objects and in columns.

Columns of a file, in any case of letters: ``x,y,z`` [mm], then nothing, or ``dx,dy,dz`` (where the tool points, any
length), or ``rx,ry,rz`` [deg] (as in the vendor's coordinates: turned about the fixed x, then y, then z), or
``qw,qx,qy,qz`` (any length), and then perhaps ``weight`` [mm] that a degree counts. A line whose orientation is left
empty is a point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array
from rejoint.arms.orientation import WEIGHT, Orientation, tool_axis
from rejoint.arms.rotations import quaternion_of, rotation_about, rotation_of
from rejoint.arms.wire.values import to_coords, to_pose
from rejoint.logs.runlog import TWO_TURNS
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_floats

PLACE = ("x", "y", "z")
KINDS = {"direction": ("dx", "dy", "dz"), "angles": ("rx", "ry", "rz"), "quaternion": ("qw", "qx", "qy", "qz")}
"""Columns of each way to give an orientation"""
ORIENTED = "dx,dy,dz or rx,ry,rz or qw,qx,qy,qz, and perhaps weight"
"""What a header may have after the place, in words"""
_SHOWN = 80  # letters of a header that an error shows
_NUMBERS = dict(enumerate(("three", "four", "five", "six", "seven", "eight", "nine"), start=3))
_DEGREE = 1e3 * np.radians(1.0)  # a weight in m/rad, in mm/deg


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """A place for the tool, and how the tool is to be turned there: in at most one of three ways.

    Examples
    --------
    >>> pose = rejoint.Pose(place_m=[0.18, 0.0, 0.2], direction=[0, 0, -1])  # the tool points down
    """

    place_m: ArrayLike
    """(3,) in the base frame"""
    direction: ArrayLike | None = None
    """(3,) in the base frame, where the tool points; it may turn about itself"""
    angles_rad: ArrayLike | None = None
    """(3,) rx, ry, rz as in the vendor's coordinates, but in rad: turned about the fixed x, then y, then z"""
    quaternion: ArrayLike | None = None
    """(4,) w, x, y, z"""
    weight_m: float = WEIGHT
    """metres that a radian of orientation counts against the place, where both cannot be had"""

    def __post_init__(self) -> None:
        given = [(name, value) for name, value in self._ways() if value is not None]
        if len(given) > 1:
            raise InputError(f"pose: {given[0][0]} and {given[1][0]} are given, expected one of them")
        for name, value, size in [("place_m", self.place_m, 3), *((n, v, len(KINDS[n])) for n, v in given)]:
            found = as_floats("pose", value, f"{size} finite numbers as {name}")
            if found.shape != (size,) or not np.isfinite(found).all():
                raise InputError(f"pose: {name} {value!r} is not {size} finite numbers")
            if name in ("direction", "quaternion") and not np.linalg.norm(found) > 0.0:
                raise InputError(f"pose: {name} is zero; give one of any other length")
            farthest = np.abs(found).max() if name == "angles" else 0.0
            if farthest > TWO_TURNS:
                said = f"{farthest:.4g} rad ({np.degrees(farthest):.5g} deg)"
                raise InputError(f"pose: an angle of {said}, beyond two turns; angles_rad is in radians")
        if not (np.isfinite(self.weight_m) and self.weight_m >= 0.0):
            raise InputError(f"pose: a weight is a number of metres from 0 on, got {self.weight_m}")

    def _ways(self) -> tuple[tuple[str, ArrayLike | None], ...]:
        return ("direction", self.direction), ("angles", self.angles_rad), ("quaternion", self.quaternion)

    @property
    def turned(self) -> bool:
        """Whether an orientation is asked for."""
        return self.weight_m > 0.0 and any(value is not None for _, value in self._ways())

    def rotation(self, axis: Array) -> Array:
        """Return the wanted frame (3, 3) of a tool that points along ``axis`` (3,) of it; any one for a direction."""
        if self.direction is not None:
            return pointing(axis, np.asarray(self.direction, dtype=float))
        if self.angles_rad is not None:
            return to_pose(np.concatenate([np.zeros(3), np.asarray(self.angles_rad, dtype=float)]))[:3, :3]
        return np.eye(3) if self.quaternion is None else rotation_of(np.asarray(self.quaternion, dtype=float))


def placed(arm: Arm, poses: Sequence[Pose]) -> tuple[Array, Orientation | None]:
    """Return the places (K, 3) [m] of poses, and how the tools are to be turned there (K,); None for points alone."""
    axis = tool_axis(arm)
    places = np.array([np.asarray(pose.place_m, dtype=float) for pose in poses]).reshape(-1, 3)
    if not any(pose.turned for pose in poses):
        return places, None
    return places, Orientation(
        rotation=np.stack([pose.rotation(axis) for pose in poses]), axis=axis,
        whole=np.array([pose.direction is None for pose in poses]),
        weight=np.array([pose.weight_m if pose.turned else 0.0 for pose in poses]),
    )  # fmt: skip


def in_words(turn: Orientation) -> str:
    """Say of a single orientation () what is asked for, in base frame and degrees; empty for nothing."""
    if not turn.counts:
        return ""
    if not turn.whole:
        return "direction {:.2f} {:.2f} {:.2f}".format(*(np.round(turn.rotation @ turn.axis, 2) + 0.0))
    frame = np.eye(4)
    frame[:3, :3] = turn.rotation
    return "rx ry rz {:.1f} {:.1f} {:.1f} deg".format(*(np.round(np.degrees(to_coords(frame)[3:]), 1) + 0.0))


def columns(header: Sequence[str], first: Sequence[str] = PLACE) -> Callable[[Sequence[str]], Pose] | None:
    """Return what makes a pose of the cells of a line below ``header``, which begins with ``first``; None: no such.

    What is made raises InputError, which says what is wrong, for a line that is none.
    """
    names = [cell.strip().lower() for cell in header]
    rest = names[len(first) :]
    weighed = rest[-1:] == ["weight"]
    kind = next((kind for kind, own in KINDS.items() if rest[: len(rest) - weighed] == list(own)), None)
    if names[: len(first)] != list(first) or (kind is None and rest):
        return None

    def pose(line: Sequence[str]) -> Pose:
        empty = not any(map(str.strip, line[len(first) :]))
        try:
            values = np.array([float(cell) for cell in (line[: len(first)] if empty else line)])
        except ValueError as error:
            raise InputError("holds no numbers") from error
        if len(line) != len(names) or not np.isfinite(values).all():
            raise InputError(f"is not {_NUMBERS[len(names)]} finite numbers")
        place = values[len(first) - len(PLACE) : len(first)] / 1e3
        if kind is None or empty:
            return Pose(place_m=place)
        own = values[len(first) : len(names) - weighed]
        weight = values[-1] / _DEGREE if weighed else WEIGHT
        given = {"angles_rad": np.radians(own)} if kind == "angles" else {kind: own}
        return Pose(place_m=place, weight_m=float(weight), **given)

    return pose


def unknown_header(header: Sequence[str], first: Sequence[str] = PLACE) -> tuple[str, str]:
    """Return what is wrong with a ``header`` that `columns` does not know, and what to do."""
    found, expected = ",".join(header), ",".join(first)
    problem = f"it holds nothing, expected the header '{expected}'"
    if found:
        shown = found if len(found) <= _SHOWN else f"{found[:_SHOWN]}..."
        problem = f"the header is {shown!r}, expected '{expected}'"
    if len(header) == 1 and any(sign in found for sign in ";\t |"):
        return problem, "separate columns by commas, and write numbers with points"
    units = "s, mm and deg" if "time" in first else "mm and deg"
    return problem, f"name the columns so, and after z perhaps {ORIENTED}; in {units}"


def turn_knot(pose: Pose) -> Array:
    """Return the orientation of a turned pose as a unit vector: a direction (3,), or a quaternion (4,)."""
    if pose.direction is not None:
        knot = np.asarray(pose.direction, dtype=float)
    elif pose.quaternion is not None:
        knot = np.asarray(pose.quaternion, dtype=float)
    else:
        knot = quaternion_of(pose.rotation(np.zeros(3)))  # angles need no axis
    return knot / np.linalg.norm(knot)


def turned_as(knots: Array, axis: Array, weight: float) -> Orientation:
    """Return the orientations (...) of directions (..., 3) or quaternions (..., 4), of any length but zero."""
    shape, whole = knots.shape[:-1], knots.shape[-1] == 4
    make = rotation_of if whole else partial(pointing, axis)
    return Orientation(
        rotation=np.stack([make(one) for one in knots.reshape(-1, knots.shape[-1])]).reshape(*shape, 3, 3), axis=axis,
        whole=np.full(shape, whole), weight=np.full(shape, weight),
    )  # fmt: skip


def pointing(axis: Array, direction: Array) -> Array:
    """Return the smallest turn (3, 3) that brings the unit vector ``axis`` into ``direction`` (3,)."""
    wanted = direction / np.linalg.norm(direction)
    cross = np.cross(axis, wanted)
    if np.linalg.norm(cross) > 1e-12:
        return rotation_about(cross / np.linalg.norm(cross), float(np.arctan2(np.linalg.norm(cross), axis @ wanted)))
    side = np.roll(axis, 1)  # at right angles, for an axis of the frame
    return np.eye(3) if axis @ wanted > 0.0 else rotation_about(np.abs(side), np.pi)
