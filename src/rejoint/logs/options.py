"""Declarations about foreign logs."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec

from rejoint.arms import Arm
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import TOML_MOST, read_bounded

ANGLE_UNITS = ("rad", "deg", "normalised")
TIME_UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Ticks per second"""
STAMPS = ("header", "log")

_N = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_LINEAR = re.compile(
    rf"\s*(?P<sign>[+-]?)\s*(?:(?P<scale>{_N})\s*\*\s*)?(?P<column>.+?)\s*"
    rf"(?:(?P<op>[*/])\s*(?P<factor>{_N}))?\s*(?P<offset>[+-]\s*{_N})?\s*"
)
"""``6.33*m0-0.646``, ``-m0/6.33 + 0.1`` or ``m0``"""


@dataclass(frozen=True, kw_only=True)
class Linear:
    """``scale`` times a column, plus ``offset`` in its unit."""

    column: str
    scale: float = 1.0
    offset: float = 0.0

    @classmethod
    def of(cls, text: str, known: Collection[str]) -> Linear:
        """Read ``6.33*m0-0.646``; ``known`` names stay names. InputError for a scale of 0."""
        found = _LINEAR.fullmatch(text)
        if text in known or found is None:
            return cls(column=text)
        scale = float(found["scale"] or 1.0) * (-1.0 if found["sign"] == "-" else 1.0)
        factor = float(found["factor"] or 1.0)
        if not scale or not factor:
            raise InputError(f"--map: {text!r} has a scale of 0")
        scale = scale / factor if found["op"] == "/" else scale * factor
        return cls(column=found["column"], scale=scale, offset=float((found["offset"] or "0").replace(" ", "")))


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Declarations about imported files; None: as in the file."""

    angle_unit: str | None = None
    """``rad``, ``deg``, or ``normalised`` for LeRobot's -100..100"""
    time_unit: str | None = None
    """``s``, ``ms``, ``us`` or ``ns``"""
    rate: float | None = None
    """[Hz] of rows without a time"""
    columns: Mapping[str, str] | None = None
    """name in the log -> column: ``{"time": "t", "elbow": "-q3"}``; see `rejoint.logs.columns`"""
    names: tuple[str, ...] | None = None
    """of columns without names"""
    state_topic: str | None = None
    """bags: measured joint states; default ``/joint_states``"""
    command_topic: str | None = None
    """bags: commanded joint states; default ``/joint_commands``"""
    stamp: str | None = None
    """bags: ``header`` (messages) or ``log`` (recording times)"""
    calibration: Path | None = None
    """LeRobot: of normalised values; default: by encoder steps"""
    torque_off: tuple[str, ...] | None = None
    """joints without torque"""
    force: bool = False
    """import despite failed consistency checks, and store the reasons"""

    def __post_init__(self) -> None:
        for name, known in (("angle_unit", ANGLE_UNITS), ("time_unit", TIME_UNITS), ("stamp", STAMPS)):
            value = getattr(self, name)
            if value not in (None, *known):
                said = f"--{name.replace('_', '-')} {value!r} is unknown"
                raise InputError(f"{said}; choose from {', '.join(known)}")
        if self.calibration is not None and self.angle_unit not in ("normalised", "deg"):
            raise InputError("--calibration belongs together with --angle-unit normalised or deg; give one of these")
        if self.names is not None and len(set(self.names)) != len(self.names):
            raise InputError(f"--order names a column twice: {', '.join(self.names)}")
        if self.rate is not None and not 0.0 < self.rate < float("inf"):
            raise InputError(f"--rate {self.rate} is no rate; give rows in a second")

    def check_joints(self, arm: Arm) -> None:
        """Raise InputError for unknown joints."""
        for joint in self.torque_off or ():
            if joint not in arm.joint_names:
                raise InputError(f"--torque-off {joint!r}: {arm.name} has the joints {', '.join(arm.joint_names)}")


def read_map(texts: Iterable[str]) -> dict[str, str]:
    """Read ``ours=theirs`` pairs or a TOML file; InputError, FileError."""
    pairs: list[tuple[str, str]] = []
    for text in texts:
        if text.endswith(".toml"):
            pairs += _map_file(Path(text)).items()
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


def _map_file(path: Path) -> dict[str, str]:
    remedy = 'write lines such as joint1 = "6.33*m0-0.646"'
    try:
        return msgspec.toml.decode(read_bounded(path, TOML_MOST, remedy), type=dict[str, str])
    except (OSError, ValueError, RecursionError) as error:
        raise FileError(path, f"no map ({type(error).__name__}: {error})", remedy) from error
