"""Target sets: drawn in the arm's target region, or read from a file in millimetres."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array, solve_position
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_bounded

_HEADER = ["x", "y", "z"]
_MOST = 250_000
"""[bytes] largest file that is read (chosen: ten thousand targets, half a day of an arm)"""
_REACHED = 1e-3
"""[m] a target that the inverse kinematics misses by more is out of reach (chosen)"""


def draw_targets(arm: Arm, *, sets: int, count: int = 10, seed: int = 0) -> Array:
    """Draw (sets, count, 3) [m] targets uniformly from the arm's target region.

    A set depends on the seed and its own number only: more sets leave the first ones as they were.
    """
    if sets < 1 or count < 1:
        raise InputError(f"targets: sets and count must be at least 1, got {sets} and {count}")
    streams = np.random.SeedSequence(seed).spawn(sets)
    return np.stack([arm.targets.sample(np.random.default_rng(stream), (count,)) for stream in streams])


def read_targets(path: Path, arm: Arm) -> Array:
    """Read a CSV file with the header ``x,y,z`` and one target in millimetres a line; returns (K, 3) [m].

    FileError names the line that cannot be read, or whose target lies outside the target region or
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
    if not lines or [cell.strip().lower() for cell in lines[0][1]] != _HEADER:
        found = ",".join(lines[0][1]) if lines else "nothing"
        raise FileError(path, f"the header is {found!r}, expected 'x,y,z'", "name the columns; values are millimetres")
    if len(lines) == 1:
        raise FileError(path, "no targets below the header", "add one line per target")
    targets = np.array([_parse(path, number, line) for number, line in lines[1:]])
    _check(path, arm, targets, [number for number, _ in lines[1:]])
    return targets


def _parse(path: Path, number: int, line: list[str]) -> list[float]:
    try:
        values = [float(cell) / 1e3 for cell in line]
    except ValueError as error:
        raise FileError(path, f"line {number}: {','.join(line)!r} holds no numbers", "give x,y,z in mm") from error
    if len(values) != len(_HEADER) or not np.isfinite(values).all():
        raise FileError(path, f"line {number}: {','.join(line)!r} is not three finite numbers", "give x,y,z in mm")
    return values


def _check(path: Path, arm: Arm, targets: Array, numbers: list[int]) -> None:
    found = solve_position(arm, targets, np.broadcast_to(arm.rest, (len(targets), arm.joints)))
    box = arm.targets
    region = ", ".join(
        f"{low:.0f} <= {axis} <= {high:.0f}"
        for axis, low, high in zip(_HEADER, box.lower * 1e3, box.upper * 1e3, strict=True)
    )
    for number, target, error, inside in zip(numbers, targets, found.error, box.contains(targets), strict=True):
        point = ", ".join(f"{value * 1e3:g}" for value in target)
        if error > _REACHED:
            problem = f"line {number}: ({point}) mm is out of reach, {error * 1e3:.0f} mm too far"
            raise FileError(path, problem, f"stay inside {region} mm")
        if not inside:
            raise FileError(
                path, f"line {number}: ({point}) mm is outside the target region", f"stay inside {region} mm"
            )
