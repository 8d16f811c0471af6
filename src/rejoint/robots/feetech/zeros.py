"""What counts of an STS3215 mean in radians: from LeRobot's calibration, or from the limits that the servos hold.

A joint stands at zero in the middle of its calibrated range, as in LeRobot's degrees and in ``so101_new_calib``. Where
the description of the arm has another zero, ``zero`` of the address says how many degrees the middle is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.logs.homing import read_homing
from rejoint.logs.joints import COUNTS_PER_TURN, match_joints
from rejoint.logs.options import ImportOptions
from rejoint.system.errors import InputError, RobotError

Counts = NDArray[np.int64]

_STEP = 2 * np.pi / COUNTS_PER_TURN
TURNING = np.radians(300.0)
"""[rad] range from which on a joint may be calibrated to a whole turn (chosen: LeRobot does so with a wrist, which
rolls by 320 degrees; all other joints of an SO-101 have at most 220)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotorRanges:
    """What a calibration of LeRobot says of the motors (n,) of an arm's joints."""

    ids: tuple[int, ...]
    homing: Counts
    low: Counts
    high: Counts


@dataclass(frozen=True, kw_only=True)
class Zeros:
    """Counts and radians of n joints, as plain numbers: a control cycle turns a handful of them into each other."""

    middle: tuple[float, ...]
    """(n,) [counts] where the joints are at ``zero``"""
    zero: tuple[float, ...]
    """(n,) [rad]"""
    low: tuple[int, ...]
    """(n,) [counts] lowest goals that the servos take"""
    high: tuple[int, ...]
    """(n,) [counts]"""

    def radians(self, counts: Sequence[int]) -> list[float]:
        """Joint positions (n,) [rad] of what the servos tell."""
        return [
            (count - middle) * _STEP + zero for count, middle, zero in zip(counts, self.middle, self.zero, strict=True)
        ]

    def counts(self, position: Array) -> list[int]:
        """Goals (n,) of joint positions [rad], within the servos' limits."""
        return [
            min(max(round((angle - zero) / _STEP + middle), low), high)
            for angle, middle, zero, low, high in zip(
                position.tolist(), self.middle, self.zero, self.low, self.high, strict=True
            )
        ]


def read_calibration(path: Path, arm: Arm) -> MotorRanges:
    """Read LeRobot's calibration of ``arm``; FileError where it is none, InputError where its numbers cannot be."""
    motors = read_homing(path)
    columns = match_joints(list(motors), arm, ImportOptions(), path, "calibration").columns
    joints = [list(motors.values())[column] for column in columns]
    try:
        numbers = {
            name: [int(joint[name]) for joint in joints] for name in ("id", "homing_offset", "range_min", "range_max")
        }
    except (KeyError, TypeError, ValueError) as error:
        wanted = "id, homing_offset, range_min and range_max of every motor"
        raise InputError(f"{path}: expected {wanted} ({error!r})") from error
    low, high = np.array(numbers["range_min"]), np.array(numbers["range_max"])
    if not ((low >= 0) & (low < high) & (high < COUNTS_PER_TURN)).all():
        raise InputError(f"{path}: ranges must rise within 0 and {COUNTS_PER_TURN - 1}; run lerobot-calibrate again")
    return MotorRanges(ids=tuple(numbers["id"]), homing=np.array(numbers["homing_offset"]), low=low, high=high)


def zeros_of(
    arm: Arm, file: MotorRanges | None, homing: Counts, low: Counts, high: Counts, degrees: tuple[float, ...]
) -> Zeros:
    """Zeros of an arm whose servos hold these offsets and limits (n,).

    RobotError where the file is not theirs, or where a servo was never told where its joint is.
    """
    if degrees and len(degrees) != arm.joints:
        raise InputError(f"zero= of the address needs {arm.joints} angles, one per joint, got {len(degrees)}")
    if file is not None and (file.homing != homing).any():
        j = int(np.argmax(file.homing != homing))
        raise RobotError(
            f"the calibration file is not that of this arm: {arm.joint_names[j]} has a homing offset of {homing[j]} "
            f"counts in its servo and {file.homing[j]} in the file; give the arm's own file, or run lerobot-calibrate"
        )
    limited = low < high
    low, high = np.where(limited, low, 0), np.where(limited, high, COUNTS_PER_TURN - 1)
    ranges = (low, high) if file is None else (file.low, file.high)
    if not degrees:
        _require_swept(arm, *ranges)
    turned = np.radians(degrees) if degrees else np.zeros(arm.joints)
    return Zeros(
        middle=tuple(((ranges[0] + ranges[1]) / 2).tolist()), zero=tuple(turned.tolist()), low=tuple(low.tolist()),
        high=tuple(high.tolist()),
    )  # fmt: skip


def _require_swept(arm: Arm, low: Counts, high: Counts) -> None:
    """Raise RobotError where joints have no range of their own: its middle would be anywhere on the turn."""
    whole = (high - low >= COUNTS_PER_TURN - 1) & (arm.upper - arm.lower < TURNING)
    if whole.any():
        names = ", ".join(name for name, bare in zip(arm.joint_names, whole, strict=True) if bare)
        raise RobotError(
            f"{names} may turn by a whole turn, as servos do that were never calibrated: nobody knows where zero is; "
            "run lerobot-calibrate, or say by zero=DEG,DEG,... what angle each joint has in the middle of its range"
        )
