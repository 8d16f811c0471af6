"""Which column is which joint, and what its numbers mean in radians."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.options import ImportOptions
from rejoint.logs.runlog import Array
from rejoint.system.errors import FileError
from rejoint.system.files import JSON_MOST, read_bounded

_SO101_NAMES = {
    "Rotation": "shoulder_pan", "Pitch": "shoulder_lift", "Elbow": "elbow_flex", "Wrist_Pitch": "wrist_flex",
    "Wrist_Roll": "wrist_roll",
}  # fmt: skip
"""Joint names of the first SO-ARM100 model, which SAGE uses, and those of so101_new_calib.xml.

Source: the URDFs in TheRobotStudio/SO-ARM100, folders ``Simulation/SO100`` and ``Simulation/SO101``.
"""

COUNTS_PER_TURN = 4096
"""Positions of the 12-bit encoder in a turn. Source: Feetech STS3215 datasheet."""

_NORMALISED_LIMIT = 101.0
"""chosen: LeRobot clips what it normalises to -100..100; a little more is left for rounding."""


class Match(NamedTuple):
    """Where a file keeps the joints of the arm."""

    columns: list[int]
    """(n,) column of each joint of the arm"""
    names: tuple[str, ...]
    """(n,) what the file calls them"""
    dropped: tuple[str, ...]
    """columns that are no joints of the arm"""


def match_joints(
    names: Sequence[str], arm: Arm, options: ImportOptions, path: Path, what: str, titles: Sequence[str] | None = None
) -> Match:
    """Find every joint of the arm exactly once among the names in a file.

    A name counts as the joint that ``options.joint_map`` gives it, else as the arm's joint of the same
    name (LeRobot's ending ``.pos`` aside), else, for an SO-101, as the joint that SAGE calls so.
    Names that mean no joint of the arm, such as a gripper, are dropped. ``titles`` are the full column
    names where they say more than the joint. Raises FileError where a joint is missing or found twice.
    """
    titles = names if titles is None else titles
    meanings = [_meaning(name, arm, options.joint_map or {}) for name in names]
    for joint in arm.joint_names:
        found = [title for title, meaning in zip(titles, meanings, strict=True) if meaning == joint]
        if len(found) > 1:
            raise FileError(path, f"{what}: {' and '.join(found)} both mean joint {joint}", "set --joints, or drop one")
    missing = [joint for joint in arm.joint_names if joint not in meanings]
    if missing:
        raise FileError(
            path, f"{what}: no column for joint {', '.join(missing)} of {arm.name}, only {', '.join(titles) or 'none'}",
            "say with --arm which arm it is of, or with --joints which name means which joint",
        )  # fmt: skip
    columns = [meanings.index(joint) for joint in arm.joint_names]
    dropped = tuple(title for title, meaning in zip(titles, meanings, strict=True) if meaning is None)
    return Match(columns, tuple(titles[column] for column in columns), dropped)


def _meaning(name: str, arm: Arm, joint_map: Mapping[str, str]) -> str | None:
    short = name.removesuffix(".pos")
    for candidate in (name, short):
        if candidate in joint_map:
            return joint_map[candidate]
    if short in arm.joint_names:
        return short
    if set(_SO101_NAMES.values()) == set(arm.joint_names):
        return _SO101_NAMES.get(short)
    return None


def means_a_joint(name: str, arm: Arm, options: ImportOptions) -> bool:
    """Tell whether a name in a file stands for a joint of the arm."""
    return _meaning(name, arm, options.joint_map or {}) is not None


def radians(values: Array, unit: str, arm: Arm, options: ImportOptions, path: Path) -> Array:
    """Turn ``(T, n)`` values in the arm's joint order into radians.

    Normalised values are LeRobot's: -100 and 100 stand for the ends of the calibrated range, zero for its
    middle, turned around for a motor whose drive mode is set (``MotorsBus._normalize`` in
    huggingface/lerobot). A turn counts 4096 encoder positions here, not the 4095 of LeRobot's degrees.
    """
    if unit == "rad":
        return values
    if unit == "deg":
        return np.deg2rad(values)
    if (np.abs(values) > _NORMALISED_LIMIT).any():
        worst = float(values.flat[int(np.nanargmax(np.abs(values)))])
        raise FileError(path, f"{worst:g} is no normalised value, which lie in -100..100", "set another --angle-unit")
    if options.calibration is None:
        raise FileError(path, "normalised values need a calibration", "give the calibration file of the arm")
    return values * half_ranges(options.calibration, arm, options) / 100.0


def half_ranges(path: Path, arm: Arm, options: ImportOptions) -> Array:
    """Read (n,) [rad] from the middle of each joint's calibrated range to the end that 100 stands for."""
    try:
        motors = json.loads(read_bounded(path, JSON_MOST, "give the file that lerobot-calibrate wrote"))
        spans = {
            name: (int(motor["range_max"]) - int(motor["range_min"])) * (-1 if motor["drive_mode"] else 1)
            for name, motor in motors.items()
        }
    except (OSError, ArithmeticError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileError(
            path, f"not a calibration of LeRobot ({type(error).__name__}: {error})",
            "give the JSON file that lerobot-calibrate wrote",
        ) from error  # fmt: skip
    names = list(spans)
    counts = [spans[names[column]] for column in match_joints(names, arm, options, path, "calibration").columns]
    return np.array(counts, dtype=float) * np.pi / COUNTS_PER_TURN
