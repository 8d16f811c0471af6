"""Zero errors as homing offsets in LeRobot's calibration file.

Feetech servos report the raw position minus ``homing_offset`` [counts]; Dynamixel servos have the other sign. Ranges
and degrees move with it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.joints import COUNTS_PER_TURN, match_joints
from rejoint.logs.options import ImportOptions
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import JSON_MOST, read_bounded, write_whole

LARGEST = 2047
"""[counts] eleven bits and a sign"""

_NUMBERS = ("homing_offset", "range_min", "range_max")
_REMEDY = "give the JSON file that lerobot-calibrate wrote"


def corrected_homing(source: Path, arm: Arm, offset: Array) -> tuple[dict[str, Any], dict[str, int]]:
    """LeRobot's calibration with ``offset`` (n,) [rad] added, and changes in counts.

    FileError: ``source`` is no calibration; InputError: offset out of range.
    """
    motors = read_homing(source)
    columns = match_joints(list(motors), arm, source, "calibration").columns
    names, changes = list(motors), {}
    for joint, column, angle in zip(arm.joint_names, columns, offset, strict=True):
        motor, change = motors[names[column]], -round(float(angle) * COUNTS_PER_TURN / (2 * np.pi))
        if abs(motor["homing_offset"] + change) > LARGEST:
            raise InputError(
                f"{joint}: a homing offset of {motor['homing_offset'] + change} counts, expected at most {LARGEST}; "
                "run lerobot-calibrate with the arm nearer to the middle of its range"
            )
        motor["homing_offset"] += change
        changes[names[column]] = change
    return motors, changes


def write_homing(path: Path, motors: dict[str, Any]) -> None:
    """Write a calibration as LeRobot does."""
    text = json.dumps(motors, indent=4)
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def half_ranges(source: Path, arm: Arm, options: ImportOptions) -> Array:
    """Half ranges (n,) [rad] of a calibration; negative: turned motor."""
    motors = list(read_homing(source, turned=True).items())
    match = match_joints([name for name, _ in motors], arm, source, "calibration", options)
    chosen = [motors[column][1] for column in match.columns]
    counts = [(one["range_max"] - one["range_min"]) * (-1 if one.get("drive_mode") else 1) for one in chosen]
    return np.array(counts) * np.pi / COUNTS_PER_TURN


def read_homing(source: Path, *, turned: bool = False) -> dict[str, Any]:
    """Read the motors of LeRobot's calibration, perhaps ``turned`` ones; FileError."""
    try:
        motors = json.loads(read_bounded(source, JSON_MOST, _REMEDY))
        for name, motor in motors.items():
            if not all(isinstance(motor[key], int) for key in _NUMBERS):
                raise TypeError(f"{', '.join(_NUMBERS)} of {name} are not all whole numbers")
            if motor.get("drive_mode") and not turned:
                raise ValueError("a drive_mode other than 0, which turns a joint in some units and not in others")
    except FileNotFoundError as error:
        raise FileError(source, "no such file", _REMEDY) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileError(source, f"not a calibration of LeRobot ({type(error).__name__}: {error})", _REMEDY) from error
    return dict(motors)
