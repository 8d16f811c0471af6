"""Columns of joints, and their numbers in radians."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.options import ImportOptions, Linear
from rejoint.logs.runlog import Array
from rejoint.system.errors import FileError
from rejoint.system.files import JSON_MOST, read_bounded
from rejoint.system.textfile import split_unit

_SO101_NAMES = {
    "Rotation": "shoulder_pan",
    "Pitch": "shoulder_lift",
    "Elbow": "elbow_flex",
    "Wrist_Pitch": "wrist_flex",
    "Wrist_Roll": "wrist_roll",
}
"""Joint names of the first SO-ARM100 model, as in SAGE, and of so101_new_calib.xml.

Source: TheRobotStudio/SO-ARM100, folders ``Simulation/SO100`` and ``Simulation/SO101``."""

COUNTS_PER_TURN = 4096
"""12-bit encoder; Feetech STS3215 datasheet"""

ANGLES = {"rad": 1.0, "deg": np.pi / 180.0}
"""[rad]"""
_NUMBERED = re.compile(r"(.*?)(\d+)")
_NORMALISED_LIMIT = 101.0
"""LeRobot clips to -100..100 (chosen: with rounding)"""


class Match(NamedTuple):
    """Joints of the arm in a file."""

    columns: list[int]
    """(n,) columns in the arm's order"""
    names: tuple[str, ...]
    """(n,) in the file"""
    dropped: tuple[str, ...]
    """other columns"""
    linear: list[Linear]
    """(n,) of `ImportOptions.columns`"""
    numbered: bool
    """names are only numbers"""


def match_joints(
    names: Sequence[str], arm: Arm, options: ImportOptions, path: Path, what: str, titles: Sequence[str] | None = None
) -> Match:
    """Find every joint of the arm exactly once in a file.

    By ``options.columns``, its name (without LeRobot's ``.pos``), SAGE's name for an SO-101, or numbers from 0 or 1.
    ``titles`` are full column names. FileError.
    """
    titles = names if titles is None else titles
    renamed = _renamed(arm, options, {*names, *titles})
    found = [_meaning(name, title, arm, renamed) for name, title in zip(names, titles, strict=True)]
    numbered = not any(found)
    if numbered:
        found = _numbers(names, arm)
    meanings = [None if one is None else one[0] for one in found]
    for joint in arm.joint_names:
        twice = [title for title, meaning in zip(titles, meanings, strict=True) if meaning == joint]
        if len(twice) > 1:
            raise FileError(path, f"{what}: {' and '.join(twice)} both mean joint {joint}", "set --map, or drop one")
    missing = [joint for joint in arm.joint_names if joint not in meanings]
    if missing:
        raise FileError(
            path,
            f"{what}: no column for joint {', '.join(missing)} of {arm.name}, only {', '.join(titles) or 'none'}",
            "say with --arm which arm it is of, or with --map which name means which joint: --map JOINT=NAME",
        )
    columns = [meanings.index(joint) for joint in arm.joint_names]
    dropped = tuple(title for title, meaning in zip(titles, meanings, strict=True) if meaning is None)
    linear = [one[1] for column in columns if (one := found[column]) is not None]
    return Match(columns, tuple(titles[column] for column in columns), dropped, linear, numbered)


def means_a_joint(name: str, arm: Arm, options: ImportOptions) -> bool:
    """Whether a name is a joint of the arm."""
    return _meaning(name, name, arm, _renamed(arm, options, {name})) is not None


Meaning = tuple[str, Linear] | None


def _renamed(arm: Arm, options: ImportOptions, known: set[str]) -> dict[str, tuple[str, Linear]]:
    found = {}
    for ours, theirs in (options.columns or {}).items():
        joint = _meaning(split_unit(ours, ANGLES)[0], "", arm, {})
        if joint is not None:
            linear = Linear.of(theirs, known)
            found[linear.column] = (joint[0], linear)
    return found


def _meaning(name: str, title: str, arm: Arm, renamed: dict[str, tuple[str, Linear]]) -> Meaning:
    short = name.removesuffix(".pos")
    for candidate in (title, name, short):
        if candidate in renamed:
            return renamed[candidate]
    if set(_SO101_NAMES.values()) == set(arm.joint_names):
        short = _SO101_NAMES.get(short, short)
    return (short, Linear(column=name)) if short in arm.joint_names else None


def _numbers(names: Sequence[str], arm: Arm) -> list[Meaning]:
    """Joints of plain numbers; m1 only if the arm's names end in numbers."""
    parts = [_NUMBERED.fullmatch(name) for name in names]
    counted = all(name[-1:].isdigit() for name in arm.joint_names)
    for stem in {"", *(part[1] for part in parts if part is not None and counted)}:
        own = {int(part[2]): i for i, part in enumerate(parts) if part is not None and part[1] == stem}
        if len(own) == arm.joints and min(own) in (0, 1) and max(own) - min(own) == arm.joints - 1:
            found: list[Meaning] = [None] * len(names)
            for number, i in own.items():
                found[i] = (arm.joint_names[number - min(own)], Linear(column=names[i]))
            return found
    return [None] * len(names)


def radians(values: Array, unit: str, half: Array | None, path: Path) -> Array:
    """Values ``(T, n)`` in radians.

    LeRobot's normalised -100 and 100 are ``half`` (n,) [rad] from the middle of the calibrated range
    (``MotorsBus._normalize`` in huggingface/lerobot).
    """
    if unit in ANGLES:
        return values * ANGLES[unit] if unit == "rad" else np.deg2rad(values)
    if (np.abs(values) > _NORMALISED_LIMIT).any():
        worst = float(values.flat[int(np.nanargmax(np.abs(values)))])
        raise FileError(path, f"{worst:g} is no normalised value, which lie in -100..100", "set another --angle-unit")
    if half is None:
        raise FileError(path, "normalised values need a calibration", "give the calibration file of the arm")
    return values * half / 100.0


def half_ranges(path: Path, arm: Arm, options: ImportOptions) -> Array:
    """Half ranges (n,) [rad]; negative: turned motor."""
    try:
        motors = json.loads(read_bounded(path, JSON_MOST, "give the file that lerobot-calibrate wrote"))
        spans = {
            name: (int(motor["range_max"]) - int(motor["range_min"])) * (-1 if motor["drive_mode"] else 1)
            for name, motor in motors.items()
        }
    except (OSError, ArithmeticError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileError(
            path,
            f"not a calibration of LeRobot ({type(error).__name__}: {error})",
            "give the JSON file that lerobot-calibrate wrote",
        ) from error
    names = list(spans)
    counts = [spans[names[column]] for column in match_joints(names, arm, options, path, "calibration").columns]
    return np.array(counts, dtype=float) * np.pi / COUNTS_PER_TURN
