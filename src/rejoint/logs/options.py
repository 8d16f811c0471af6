"""What a user declares about foreign logs: units, joints, topics and clocks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from rejoint.arms import Arm
from rejoint.system.errors import FileError, InputError

ANGLE_UNITS = ("rad", "deg", "normalised")
TIME_UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Ticks of each unit in a second."""
STAMPS = ("header", "log")

OPTIONS = {
    "angle_unit": "--angle-unit", "time_unit": "--time-unit", "joint_map": "--joints", "joint_order": "--order",
    "state_topic": "--state-topic", "command_topic": "--command-topic", "stamp": "--stamp",
    "calibration": "--calibration", "columns": "--map",
}  # fmt: skip
"""What errors call a declaration: the option of `rejoint import` that makes it."""


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Declarations about the files to import; None leaves it to the file, which then has to say it."""

    angle_unit: str | None = None
    """``rad``, ``deg``, or ``normalised`` for LeRobot's -100..100 (needs ``calibration``)"""
    time_unit: str | None = None
    """``s``, ``ms``, ``us`` or ``ns``"""
    joint_map: Mapping[str, str] | None = None
    """name in the file -> joint of the arm"""
    joint_order: tuple[str, ...] | None = None
    """names of the columns where the file holds none; names that are no joints of the arm are dropped"""
    state_topic: str | None = None
    """MCAP: topic of the measured joint states; default ``/joint_states``"""
    command_topic: str | None = None
    """MCAP: topic of the commanded joint states; default ``/joint_commands``"""
    stamp: str | None = None
    """MCAP: ``header`` takes the stamps in the messages, ``log`` the times at which they were recorded"""
    calibration: Path | None = None
    """LeRobot: the JSON file of the motors' calibration, which normalised values refer to; with degrees it only tells
    these from normalised values"""
    columns: Mapping[str, str] | None = None
    """CSV: what the log calls it -> column of the file, such as ``{"time": "t", "elbow": "q3"}``"""
    force: bool = False
    """go on where a log is doubted, and keep the reasons in it (`Doubts`)"""

    def __post_init__(self) -> None:
        for name, known in (("angle_unit", ANGLE_UNITS), ("time_unit", tuple(TIME_UNITS)), ("stamp", STAMPS)):
            value = getattr(self, name)
            if value is not None and value not in known:
                raise InputError(f"{OPTIONS[name]} {value!r} is unknown; choose from {', '.join(known)}")
        if self.angle_unit == "normalised" and self.calibration is None:
            raise InputError("--angle-unit normalised and --calibration belong together; give the calibration as well")
        if self.calibration is not None and self.angle_unit not in ("normalised", "deg"):
            raise InputError("--calibration belongs together with --angle-unit normalised or deg; give one of these")
        if self.joint_order is not None and len(set(self.joint_order)) != len(self.joint_order):
            raise InputError(f"--order names a joint twice: {', '.join(self.joint_order)}")

    def check_joints(self, arm: Arm) -> None:
        """Raise InputError where the joint map leads to a joint that the arm does not have."""
        for source, joint in (self.joint_map or {}).items():
            if joint not in arm.joint_names:
                raise InputError(
                    f"--joints sends {source} to {joint!r}, which {arm.name} does not have; "
                    f"its joints are {', '.join(arm.joint_names)}"
                )

    def refuse_others(self, path: Path, format_name: str, *allowed: str) -> None:
        """Raise FileError for a declaration that says nothing about this format."""
        for field in fields(self):
            if field.name != "force" and getattr(self, field.name) is not None and field.name not in allowed:
                raise FileError(
                    path, f"{OPTIONS[field.name]} does not apply to a file of format {format_name}", "leave it out"
                )
