"""Which joint a foreign name means, by the user's declarations and LeRobot's calibration.

Feetech servos report the raw position minus ``homing_offset`` [counts]; Dynamixel servos have the other sign.
"""

import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_bounded, read_shipped, read_toml, reading, write_text

AngleUnit = Literal["rad", "deg", "rev", "normalised"]
TimeUnit = Literal["s", "ms", "us", "ns"]
Stamp = Literal["header", "log"]
TIME_UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Ticks per second"""

_N = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_LINEAR = re.compile(
    rf"\s*(?P<sign>[+-]?)\s*(?:(?P<scale>{_N})\s*\*\s*)?(?P<column>.+?)\s*"
    rf"(?:(?P<op>[*/])\s*(?P<factor>[+-]?{_N}))?\s*(?P<offset>[+-]\s*{_N})?\s*"
)
"""``6.33*m0-0.646``, ``-m0/6.33 + 0.1`` or ``m0``"""


def read_linear(text: str, known: Collection[str]) -> tuple[str, float, float]:
    """Column of ``6.33*m0-0.646``, its scale, and the offset in its unit; ``known`` names stay names.

    InputError for a scale of 0.
    """
    found = _LINEAR.fullmatch(text)
    if text in known or found is None:
        return text, 1.0, 0.0
    scale = float(found["sign"] + (found["scale"] or "1"))
    factor = float(found["factor"] or 1.0)
    if not scale or not factor:
        raise InputError(f"--map: {text!r} has a scale of 0")
    scale = scale / factor if found["op"] == "/" else scale * factor
    return found["column"], scale, float((found["offset"] or "0").replace(" ", ""))


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Declarations about imported files; None: as in the file."""

    angle_unit: AngleUnit | None = None
    """``rad``, ``deg``, ``rev``, or ``normalised`` for LeRobot's -100..100"""
    time_unit: TimeUnit | None = None
    """``s``, ``ms``, ``us`` or ``ns``"""
    rate: float | None = None
    """[Hz] of rows without a time"""
    columns: Mapping[str, str] = field(default_factory=dict)
    """name in the log -> column: ``{"time": "t", "elbow": "-q3"}``; see `rejoint.logs.columns`"""
    names: tuple[str, ...] = ()
    """of columns without names"""
    state_topic: str | None = None
    """bags: measured joint states; default ``/joint_states``"""
    command_topic: str | None = None
    """bags: commanded joint states; default ``/joint_commands``"""
    stamp: Stamp | None = None
    """bags: ``header`` (messages) or ``log`` (recording times)"""
    calibration: Path | None = None
    """LeRobot: of normalised values; default: by encoder steps"""
    torque_off: tuple[str, ...] = ()
    """joints without torque"""
    force: bool = False
    """import despite failed consistency checks, and store the reasons"""

    def __post_init__(self) -> None:
        for name, kind in (("angle_unit", AngleUnit), ("time_unit", TimeUnit), ("stamp", Stamp)):
            if (given := getattr(self, name)) not in (None, *get_args(kind)):
                flag = name.replace("_", "-")
                raise InputError(f"--{flag} {given!r}: expected {', '.join(get_args(kind))}")
        if self.calibration is not None and self.angle_unit not in ("normalised", "deg"):
            raise InputError("--calibration belongs together with --angle-unit normalised or deg; give one of these")
        if self.rate is not None and not 0.0 < self.rate < float("inf"):
            raise InputError(f"--rate {self.rate} is no rate; give rows in a second")


class Watched:
    """Options, and which of them were read."""

    def __init__(self, options: ImportOptions) -> None:
        self._options, self._read = options, {"force"}

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        self._read.add(name)
        return getattr(self._options, name)

    def unread(self) -> list[str]:
        """Return flags given in vain."""
        names = (name for name, value in vars(self._options).items() if value and name not in self._read)
        return [f"--{name.replace('names', 'order').replace('_', '-')}" for name in names]


def ordered(numbers: Sequence[str], options: ImportOptions) -> list[str]:
    """Names of numbered columns by the options."""
    if not all(map(str.isdecimal, numbers)):
        return list(numbers)
    names = dict(zip(sorted(numbers, key=int), options.names, strict=False))
    return [names.get(number, number) for number in numbers]


def read_map(texts: Iterable[str]) -> dict[str, str]:
    """Read ``ours=theirs`` pairs or a TOML file; InputError, FileError."""
    pairs: list[tuple[str, str]] = []
    for text in texts:
        if text.endswith(".toml"):
            remedy = 'write lines such as joint1 = "6.33*m0-0.646"'
            pairs += read_toml(Path(text), dict[str, str], remedy).items()
            continue
        for part in text.split(","):
            ours, _, theirs = (one.strip() for one in part.partition("="))
            if not (ours and theirs) or "=" in theirs:
                said = "expected OURS=THEIRS, OURS=SCALE*THEIRS+OFFSET or a TOML file of them"
                raise InputError(f"--map {text!r}: {said}")
            pairs.append((ours, theirs))
    if len(dict(pairs)) != len(pairs):
        raise InputError(f"--map: the same name twice among {', '.join(ours for ours, _ in pairs)}")
    return dict(pairs)


NAMES = read_shipped(__file__, "columns.toml", dict[str, dict[str, Any]])
"""Names that other programs give, by table"""

COUNTS_PER_TURN = 4096
"""12-bit encoder; Feetech STS3215 datasheet"""

_NUMBERED = re.compile(r"(.*?)(\d+)")


class Match(NamedTuple):
    """Joints of the arm in a file."""

    columns: list[int]
    """(n,) columns in the arm's order"""
    dropped: tuple[str, ...]
    """other columns"""
    numbered: bool
    """names are only numbers"""


def joint_in(title: str, arm: Arm) -> tuple[str, int, int]:
    """Return the joint that a title names, and where; an empty one if none."""
    names = {joint: joint for joint in arm.joint_names}
    if {*NAMES["so101"].values()} == {*names}:
        names |= NAMES["so101"]
    for name in sorted(names, key=len, reverse=True):
        flag = re.IGNORECASE if name in arm.joint_names else re.NOFLAG
        if found := re.search(rf"(?<![^\W_]){re.escape(name)}(?![^\W_])", title, flag):
            return names[name], *found.span()
    return "", 0, 0


def match_joints(names: Sequence[str], arm: Arm, path: Path, what: str, titles: Sequence[str] | None = None) -> Match:
    """Find every joint once in a file: by its name, or by numbers from 0 or 1.

    ``titles`` are full column names. FileError.
    """
    titles = titles or names
    joints = [joint_in(name, arm)[0] for name in names]
    if numbered := not any(joints):
        joints = _numbers(names, arm)
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
    dropped = tuple(title for title, joint in zip(titles, joints, strict=True) if not joint)
    return Match([joints.index(joint) for joint in arm.joint_names], dropped, numbered)


def _numbers(names: Sequence[str], arm: Arm) -> list[str]:
    """Joints of plain numbers; m1 only if the arm's names end in numbers."""
    parts = [_NUMBERED.fullmatch(name) for name in names]
    counted = all(name[-1:].isdigit() for name in arm.joint_names)
    for stem in dict.fromkeys(["", *(part[1] for part in parts if part and counted)]):
        own = {i: int(part[2]) for i, part in enumerate(parts) if part and part[1] == stem}
        first = min(own.values(), default=-1)
        if first in (0, 1) and sorted(own.values()) == [*range(first, first + arm.joints)]:
            return [arm.joint_names[own[i] - first] if i in own else "" for i in range(len(names))]
    return [""] * len(names)


LARGEST = 2047
"""[counts] of a homing offset: eleven bits and a sign"""

_NUMBERS = ("id", "homing_offset", "range_min", "range_max")


def corrected_homing(source: Path, arm: Arm, offset: Array) -> tuple[dict[str, Any], dict[str, int]]:
    """LeRobot's calibration with ``offset`` (n,) [rad] added, and changes in counts.

    FileError: ``source`` is no calibration; InputError: offset out of range.
    """
    motors, names = read_homing(source, arm)
    changes = {
        name: -round(float(angle) * COUNTS_PER_TURN / (2 * np.pi)) for name, angle in zip(names, offset, strict=True)
    }
    for joint, (name, change) in zip(arm.joint_names, changes.items(), strict=True):
        homing = motors[name]["homing_offset"] = motors[name]["homing_offset"] + change
        if abs(homing) > LARGEST:
            raise InputError(
                f"{joint}: a homing offset of {homing} counts, expected at most {LARGEST}; run lerobot-calibrate with "
                "the arm nearer to the middle of its range"
            )
    return motors, changes


def write_homing(path: Path, motors: dict[str, Any]) -> None:
    """Write a calibration as LeRobot does."""
    write_text(path, json.dumps(motors, indent=4))


def half_ranges(source: Path, arm: Arm, options: ImportOptions) -> Array:
    """Half ranges (n,) [rad] of a calibration; negative: turned motor."""
    motors, names = read_homing(source, arm, options.columns.items(), turned=True)
    chosen = [motors[name] for name in names]
    counts = [(one["range_max"] - one["range_min"]) * (-1 if one.get("drive_mode") else 1) for one in chosen]
    return np.array(counts) * np.pi / COUNTS_PER_TURN


def read_homing(
    source: Path, arm: Arm, columns: Iterable[tuple[str, str]] = (), *, turned: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Read the motors of LeRobot's calibration, perhaps ``turned`` ones, and the name of each joint's (n,); FileError.

    ``columns``: pairs of `ImportOptions.columns`.
    """
    remedy = "give the JSON file that lerobot-calibrate wrote"
    with reading(source, "not a calibration of LeRobot", remedy):
        motors = json.loads(read_bounded(source, remedy))
        for name, motor in motors.items():
            if not all(isinstance(motor[key], int) for key in _NUMBERS):
                raise TypeError(f"{', '.join(_NUMBERS)} of {name} are not all whole numbers")
            if motor.get("drive_mode") and not turned:
                raise ValueError("a drive_mode other than 0, which turns a joint in some units and not in others")
    mapped = {read_linear(theirs, motors)[0]: ours for ours, theirs in columns}
    names = list(motors)
    chosen = match_joints([mapped.get(name, name) for name in names], arm, source, "calibration").columns
    return motors, [names[column] for column in chosen]
