"""Which joint a name means."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rejoint.arms import Arm
from rejoint.logs.options import ImportOptions, Linear
from rejoint.system.errors import FileError
from rejoint.system.textfile import ANGLES, split_unit

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

_NUMBERED = re.compile(r"(.*?)(\d+)")


class Match(NamedTuple):
    """Joints of the arm in a file."""

    columns: list[int]
    """(n,) columns in the arm's order"""
    linear: list[Linear]
    """(n,) of `ImportOptions.columns`"""
    dropped: tuple[str, ...]
    """other columns"""
    numbered: bool
    """names are only numbers"""


def joint_of(name: str, arm: Arm) -> str | None:
    """Joint with this name (or LeRobot's, with ``.pos``, or SAGE's for an SO-101), perhaps with a unit."""
    short = split_unit(name.removesuffix(".pos"), ANGLES)[0]
    if {*_SO101_NAMES.values()} == {*arm.joint_names}:
        short = _SO101_NAMES.get(short, short)
    return short if short in arm.joint_names else None


def meanings(names: Sequence[str], arm: Arm, options: ImportOptions | None = None) -> list[tuple[str, Linear] | None]:
    """Joint and scale of each name, by ``options.columns`` or its own."""
    mapped = {}
    for ours, theirs in ((options and options.columns) or {}).items():
        joint, linear = joint_of(ours, arm), Linear.of(theirs, names)
        if joint is not None:
            mapped[linear.column] = joint, linear
    own = [joint_of(name, arm) for name in names]
    return [
        mapped.get(name, None if joint is None else (joint, Linear(column=name)))
        for name, joint in zip(names, own, strict=True)
    ]


def match_joints(
    names: Sequence[str],
    arm: Arm,
    path: Path,
    what: str,
    options: ImportOptions | None = None,
    titles: Sequence[str] | None = None,
) -> Match:
    """Find every joint of the arm exactly once in a file: by `meanings`, else by numbers from 0 or 1.

    ``titles`` are full column names. FileError.
    """
    titles = names if titles is None else titles
    found = meanings(names, arm, options)
    numbered = not any(found)
    if numbered:
        found = _numbers(names, arm)
    joints = [one and one[0] for one in found]
    for joint in arm.joint_names:
        twice = [title for title, meaning in zip(titles, joints, strict=True) if meaning == joint]
        if len(twice) > 1:
            raise FileError(path, f"{what}: {' and '.join(twice)} both mean joint {joint}", "set --map, or drop one")
    if missing := [joint for joint in arm.joint_names if joint not in joints]:
        raise FileError(
            path,
            f"{what}: no column for joint {', '.join(missing)} of {arm.name}, only {', '.join(titles) or 'none'}",
            "say with --arm which arm it is of, or with --map which name means which joint: --map JOINT=NAME",
        )
    columns = [joints.index(joint) for joint in arm.joint_names]
    dropped = tuple(title for title, joint in zip(titles, joints, strict=True) if joint is None)
    return Match(columns, [one[1] for i in columns if (one := found[i])], dropped, numbered)


def _numbers(names: Sequence[str], arm: Arm) -> list[tuple[str, Linear] | None]:
    """Joints of plain numbers; m1 only if the arm's names end in numbers."""
    parts = [_NUMBERED.fullmatch(name) for name in names]
    counted = all(name[-1:].isdigit() for name in arm.joint_names)
    for stem in {"": 0, **{part[1]: 0 for part in parts if part is not None and counted}}:
        own = {i: int(part[2]) for i, part in enumerate(parts) if part is not None and part[1] == stem}
        first = min(own.values(), default=-1)
        if first in (0, 1) and sorted(own.values()) == [*range(first, first + arm.joints)]:
            joints = {i: arm.joint_names[number - first] for i, number in own.items()}
            return [(joints[i], Linear(column=name)) if i in joints else None for i, name in enumerate(names)]
    return [None] * len(names)
