"""Logs of SAGE (github.com/isaac-sim2real/sage): a folder per motion.

``control.csv`` (type, timestamp, positions) holds commands, ``state_motor.csv`` states, in the order of
``joint_list.txt``, in microseconds and radians.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.columns import read_motion
from rejoint.logs.options import TIME_UNITS, ImportOptions
from rejoint.logs.track import ColumnFrame, Pending, RecordedMotion
from rejoint.system.errors import FileError
from rejoint.system.files import read_bounded
from rejoint.system.textfile import TEXT_MOST, read_sheet

_CONTROL, _STATE, _JOINTS = "control.csv", "state_motor.csv", "joint_list.txt"
_FILES = {_STATE: "position", _CONTROL: "command"}
_REMEDY = "mend the line or leave this motion out"


def found(source: Path, options: ImportOptions) -> list[Path]:  # noqa: ARG001 - it declares nothing about this
    """Folders of SAGE motions at a path, sorted by name."""
    if not source.is_dir():
        return []
    return [source] if _is_motion(source) else sorted(filter(_is_motion, source.iterdir()))


def motions(paths: Sequence[Path], arm: Arm, options: ImportOptions) -> list[Pending]:
    """Motions in folders."""
    return [(folder.resolve().name, partial(_read, folder, arm, options)) for folder in paths]


def _is_motion(folder: Path) -> bool:
    return (folder / _STATE).is_file() or ((folder / _CONTROL).is_file() and (folder / _JOINTS).is_file())


def _read(folder: Path, arm: Arm, options: ImportOptions) -> RecordedMotion:
    file, name = folder / _JOINTS, folder.resolve().name
    try:
        text = read_bounded(file, TEXT_MOST, "cut it into several motions").decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(file, f"a SAGE motion needs it, and it is no readable text ({error})", "copy it") from error
    names = [name.strip() for name in text.splitlines() if name.strip()]
    ticks = TIME_UNITS[options.time_unit or "us"]
    frames = [_frame(folder / file, names, group, ticks) for file, group in _FILES.items()]
    extra = {"source": folder.name, "format": "sage"}
    return read_motion(name, frames, arm, options, robot=f"sage:{name}", extra=extra)


def _frame(path: Path, names: list[str], group: str, ticks: float) -> ColumnFrame:
    sheet = read_sheet(path)
    if sheet.titles[1:3] != ("timestamp", "positions"):
        raise FileError(path, f"line 1: columns {sheet.shown}, expected type, timestamp, positions", _REMEDY)
    values = np.empty((len(sheet), len(names)))
    for row, text in enumerate(sheet.words(2)):
        try:
            numbers = json.loads(text)
            values[row] = numbers if len(numbers) == len(names) else "of another length"
        except (TypeError, ValueError, OverflowError, RecursionError) as error:
            said = f"line {sheet.lines[row]}: positions {text[:40]!r} are no list of {len(names)} numbers"
            raise FileError(path, said, f"{_REMEDY}; {_JOINTS} names the joints") from error
    return ColumnFrame(
        path=path,
        titles=tuple(f"{group}.{name}" for name in names),
        values=lambda chosen: values[:, chosen],
        number=sheet.lines,
        place="line",
        time=sheet.numbers([1])[:, 0] / ticks,
        angle_unit="rad",
    )
