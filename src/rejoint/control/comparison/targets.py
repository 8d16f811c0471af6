"""Target sets: drawn in the arm's target region, or read from a file in millimetres."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, solve_position, tcp_position
from rejoint.arms.orientation import Orientation
from rejoint.arms.posing import NEAR, TURNED, find_postures, missed_pose
from rejoint.arms.size import in_metres
from rejoint.control.poses import columns, in_words, placed, unknown_header
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_bounded

T = TypeVar("T")

_HEADER = ["x", "y", "z"]
_MOST = 250_000
"""[bytes] largest file that is read (chosen: ten thousand targets, half a day of an arm)"""
_MOST_SETS = 10_000
"""Sets that are drawn at most (chosen: more than any comparison drives; ever more take all memory)"""
_REACHED = 1e-3
"""[m] a target that the inverse kinematics misses by more is out of reach (chosen)"""
_POSTURES, _STARTS = 5000, 4
"""Postures to look among where a target is missed from rest, and the nearest of them from which to go on (measured: so
each of a thousand places that an arm shows is found, for both arms of the catalogue)"""
_WHOLE = 6
"""Joints that an arm needs to turn its tool freely"""
_NAMED = 5
"""Targets that an error names (chosen: one line)"""


def draw_targets(arm: Arm, *, sets: int, count: int = 10, seed: int = 0) -> Array:
    """Draw (sets, count, 3) [m] targets uniformly from the arm's target region.

    A set depends on the seed and its own number only: more sets leave the first ones as they were.
    """
    if not 1 <= sets <= _MOST_SETS or count < 1:
        raise InputError(f"targets: expected 1 to {_MOST_SETS} sets of at least 1, got {sets} of {count}")
    streams = np.random.SeedSequence(seed).spawn(sets)
    return np.stack([arm.targets.sample(np.random.default_rng(stream), (count,)) for stream in streams])


def read_targets(path: Path, arm: Arm) -> tuple[Array, Orientation | None]:
    """Read a CSV file with the header ``x,y,z`` and one target in millimetres a line; returns (K, 3) [m].

    With columns of an orientation (`rejoint.control.poses`) also how the tools are to be turned there, (K,); else None.
    FileError names the line that cannot be read, or the lines whose targets lie outside the target region or
    out of the arm's reach.
    """
    try:
        text = read_bounded(path, _MOST, "give fewer targets").decode("utf-8-sig")
        rows = enumerate(csv.reader(io.StringIO(text, newline="")), start=1)
        lines = [(number, line) for number, line in rows if any(map(str.strip, line))]
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "check the path") from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(path, f"cannot be read as text ({error})", "give a CSV file") from error
    make = columns(lines[0][1]) if lines else None
    if make is None:
        raise FileError(path, *unknown_header(lines[0][1] if lines else ()))
    if len(lines) == 1:
        raise FileError(path, "no targets below the header", "add one line per target")
    targets, turns = placed(arm, [parsed(path, number, line, make) for number, line in lines[1:]])
    _check(path, arm, targets, turns, [number for number, _ in lines[1:]])
    return targets, turns


def parsed(path: Path, number: int, line: list[str], make: Callable[[list[str]], T]) -> T:
    """Return what ``make`` makes of a line; FileError with its number where that is none."""
    try:
        return make(line)
    except InputError as error:
        raise FileError(path, f"line {number}: {','.join(line)!r} {error}", "give what the header says") from error


def require_reachable(arm: Arm, targets: Array, turns: Orientation | None = None) -> None:
    """Raise InputError for targets (S, K, 3) [m] that are no numbers, out of the arm's reach or too low, and name them.

    So are those where the tool cannot be turned as in ``turns`` (S, K).
    """
    sets, count, _ = targets.shape
    if not np.isfinite(targets).all():
        raise InputError("targets: some are no finite numbers; give x, y, z in metres")
    names = [f"number {k + 1}{f' of set {s + 1}' * (sets > 1)}" for s in range(sets) for k in range(count)]
    points = targets.reshape(-1, 3)
    far = _out_of_reach(names, points, beyond_reach(arm, points))
    if far:
        raise InputError(f"targets: {far}; give places, in metres, that the tool can reach")
    low = np.flatnonzero(too_low(arm, points))
    if len(low):
        raise InputError(f"targets: {names[low[0]]}: {_point(points[low[0]])} {lowest(arm)}; give higher places")
    askew = "" if turns is None else _not_turned(arm, names, points, turns.flat)
    if askew:
        raise InputError(f"targets: {askew}")


def beyond_reach(arm: Arm, targets: Array) -> Array:
    """Distance (K,) [m] of targets (K, 3) [m] from the nearest place that the tool is found to reach; 0 where it does.

    Every target is looked for from the rest posture, one that is missed also from postures near it.
    """
    beyond: Array = solve_position(arm, targets, np.broadcast_to(arm.rest, (len(targets), arm.joints))).error
    missed = np.flatnonzero(beyond > _REACHED)
    if len(missed):
        postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_POSTURES, arm.joints))
        apart = np.linalg.norm(tcp_position(arm, postures) - targets[missed, None], axis=-1)
        starts = postures[np.argsort(apart, axis=1)[:, :_STARTS]]
        again = solve_position(arm, targets[missed, None], starts, rest_gain=0.0).error.min(axis=1)
        beyond[missed] = np.minimum.reduce([beyond[missed], apart.min(axis=1), again])
    return np.where(beyond > _REACHED, beyond, 0.0)


def too_low(arm: Arm, places: Array) -> NDArray[np.bool_]:
    """Whether places (...) of (..., 3) [m] are below the lowest height to which the guard lets the tool come."""
    low: NDArray[np.bool_] = places[..., 2] < arm.floor
    return low


def lowest(arm: Arm) -> str:
    """Return what to say of a place that is too low."""
    return f"is lower than {1e3 * arm.floor:g} mm, where the guard keeps the tool from the ground"


def unit_hint(places: Array) -> str:
    """Return what to say of places (..., 3) [m], read in millimetres, that look like metres; else nothing."""
    return " they look like metres, and millimetres are expected;" if in_metres(places) else ""


def _out_of_reach(names: list[str], targets: Array, beyond: Array) -> str:
    """Name the targets (K, 3) [m] that are out of reach, and by how much; empty where none is."""
    far = [f"{names[k]}: {_point(targets[k])} is out of reach, {beyond[k] * 1e3:.0f} mm too far"
           for k in np.flatnonzero(beyond)]  # fmt: skip
    more = f"; and {len(far) - _NAMED} more" if len(far) > _NAMED else ""
    return "; ".join(far[:_NAMED]) + more


def _point(target: Array) -> str:
    return f"({', '.join(f'{value * 1e3:g}' for value in target)}) mm"


def _not_turned(arm: Arm, names: list[str], targets: Array, turns: Orientation) -> str:
    """Name the targets (K, 3) [m] where no posture turns the tool as in ``turns`` (K,); empty where there is none."""
    postures = find_postures(arm, targets, np.broadcast_to(arm.rest, (len(targets), arm.joints)), turns)
    off, angle = missed_pose(arm, postures, targets, turns)
    which = np.flatnonzero((off > NEAR) | (angle > TURNED))
    if not len(which):
        return ""
    far = [f"{names[k]}: at {_point(targets[k])} the tool cannot have {in_words(turns[k])}: at best "
           f"{1e3 * off[k]:.0f} mm and {np.degrees(angle[k]):.0f} deg off" for k in which[:_NAMED]]  # fmt: skip
    more = f"; and {len(which) - _NAMED} more" if len(which) > _NAMED else ""
    few = arm.joints < _WHOLE and bool(turns.whole[which].any())
    hint = f"an arm of {arm.joints} joints has a direction dx,dy,dz at most" if few else "give another orientation"
    return f"{'; '.join(far)}{more}; {hint}"


def _check(path: Path, arm: Arm, targets: Array, turns: Orientation | None, numbers: list[int]) -> None:
    box = arm.targets
    region = ", ".join(
        f"{low:.0f} <= {axis} <= {high:.0f}"
        for axis, low, high in zip(_HEADER, box.lower * 1e3, box.upper * 1e3, strict=True)
    )
    names = [f"line {number}" for number in numbers]
    outside = [f"{names[k]}: {_point(targets[k])} is outside the target region"
               for k in np.flatnonzero(~box.contains(targets))[:1]]  # fmt: skip
    for problem in filter(None, (_out_of_reach(names, targets, beyond_reach(arm, targets)), *outside)):
        raise FileError(path, problem, f"{unit_hint(targets).lstrip()} stay inside {region} mm".lstrip())
    askew = "" if turns is None else _not_turned(arm, names, targets, turns)
    if askew:
        raise FileError(path, *askew.rsplit("; ", 1))
