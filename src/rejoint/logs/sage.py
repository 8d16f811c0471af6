"""Logs of SAGE (github.com/isaac-sim2real/sage): a folder per motion.

``control.csv`` (type, timestamp, positions) holds commands, ``state_motor.csv`` states, in the order of
``joint_list.txt``, in microseconds and radians.
"""

from __future__ import annotations

import json
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
_REMEDY = "mend the line or leave this motion out"


def fits(source: Path, options: ImportOptions) -> bool:  # noqa: ARG001 - it declares nothing about this
    """Whether a folder holds SAGE motions."""
    return bool(_folders(source))


def motions(source: Path, arm: Arm, options: ImportOptions) -> list[Pending]:
    """Motions in a folder, sorted by name."""
    folders = _folders(source)
    if not folders:
        raise FileError(
            source, f"no SAGE motion here: no folder with {_CONTROL} or {_STATE}", "check the path or the format"
        )
    return [(folder.resolve().name, partial(_read, folder, arm, options)) for folder in folders]


def _folders(source: Path) -> list[Path]:
    if not source.is_dir():
        return []
    return [source] if _is_motion(source) else sorted(filter(_is_motion, source.iterdir()))


def _is_motion(folder: Path) -> bool:
    return (folder / _STATE).is_file() or ((folder / _CONTROL).is_file() and (folder / _JOINTS).is_file())


def _read(folder: Path, arm: Arm, options: ImportOptions) -> RecordedMotion:
    try:
        text = read_bounded(folder / _JOINTS, TEXT_MOST, "cut it into several motions").decode("utf-8-sig")
    except FileNotFoundError as error:
        raise FileError(
            folder / _JOINTS, "no such file, but a SAGE motion needs it", "copy the whole folder"
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(folder / _JOINTS, f"not readable text ({error})", "copy it again") from error
    names = [name.strip() for name in text.splitlines() if name.strip()]
    ticks = TIME_UNITS[options.time_unit or "us"]
    frames = [
        _frame(folder / file, names, group, ticks) for file, group in ((_STATE, "position"), (_CONTROL, "command"))
    ]
    name = folder.resolve().name
    return read_motion(
        name, frames, arm, options, robot=f"sage:{name}", extra={"source": str(folder.name), "format": "sage"}
    )


def _frame(path: Path, names: list[str], group: str, ticks: float) -> ColumnFrame:
    sheet = read_sheet(path)
    if sheet.titles[1:3] != ("timestamp", "positions"):
        raise FileError(path, f"line 1: columns {sheet.shown}, expected type, timestamp, positions", _REMEDY)
    rows = []
    for text, line in zip(sheet.words(2), sheet.lines, strict=True):
        try:
            row = [float(value) for value in json.loads(text)]
        except (TypeError, ValueError, OverflowError, RecursionError) as error:
            raise FileError(path, f"line {line}: positions {text[:40]!r} are no list of numbers", _REMEDY) from error
        if len(row) != len(names):
            raise FileError(
                path, f"line {line}: {len(row)} positions, but {_JOINTS} names {len(names)} joints", _REMEDY
            )
        rows.append(row)
    values = np.array(rows, dtype=float).reshape(-1, len(names))
    return ColumnFrame(
        path=path,
        titles=tuple(f"{group}.{name}" for name in names),
        values=lambda chosen: values[:, chosen],
        number=sheet.lines,
        place="line",
        time=sheet.numbers([1])[:, 0] / ticks,
        angle_unit="rad",
    )
