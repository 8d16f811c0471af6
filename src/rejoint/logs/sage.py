"""Logs of SAGE, NVIDIA's sim-to-real actuator toolkit (github.com/isaac-sim2real/sage).

A motion is a folder. ``control.csv`` (type, timestamp, positions) holds the commands, ``state_motor.csv``
(type, timestamp, positions, velocities, torques) the states, each list in the joint order of
``joint_list.txt``; stamps count microseconds on one clock, positions are radians. The two files are sampled
independently. Velocities, torques and ``event.csv`` have no place in a run log and are not read.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.joints import match_joints, radians
from rejoint.logs.options import TIME_UNITS, ImportOptions
from rejoint.logs.runlog import Array
from rejoint.logs.textfile import TEXT_MOST
from rejoint.logs.track import RecordedMotion, Track
from rejoint.system.errors import FileError
from rejoint.system.files import read_bounded

_CONTROL, _STATE, _JOINTS = "control.csv", "state_motor.csv", "joint_list.txt"
_REMEDY = "mend the line or leave this motion out"


def fits(source: Path, options: ImportOptions) -> bool:  # noqa: ARG001 - it declares nothing about this
    """Tell whether a folder is a SAGE motion or holds some."""
    return bool(_folders(source))


def motions(source: Path, arm: Arm, options: ImportOptions) -> tuple[int, Iterator[RecordedMotion]]:
    """Count the motions in a folder and read them one by one, sorted by name."""
    options.refuse_others(source, "sage", "angle_unit", "time_unit", "joint_map", "calibration")
    folders = _folders(source)
    if not folders:
        raise FileError(
            source, f"no SAGE motion here: no folder with {_CONTROL} or {_STATE}", "check the path or the format"
        )
    return len(folders), (_read(folder, arm, options) for folder in folders)


def _folders(source: Path) -> list[Path]:
    if not source.is_dir():
        return []
    if _is_motion(source):
        return [source]
    return sorted(folder for folder in source.iterdir() if folder.is_dir() and _is_motion(folder))


def _is_motion(folder: Path) -> bool:
    return (folder / _STATE).is_file() or ((folder / _CONTROL).is_file() and (folder / _JOINTS).is_file())


def _read(folder: Path, arm: Arm, options: ImportOptions) -> RecordedMotion:
    names = _lines(folder / _JOINTS)
    names = [name.strip() for name in names if name.strip()]
    match = match_joints(names, arm, options, folder / _JOINTS, "joint list")
    unit = options.angle_unit or "rad"
    ticks = TIME_UNITS[options.time_unit or "us"]

    def track(file: str, what: str) -> Track:
        time, values, number = _samples(folder / file, len(names))
        chosen = radians(values[:, match.columns], unit, arm, options, folder / file)
        return Track(
            path=folder / file, what=what, time=time / ticks, value=chosen, columns=match.names,
            place="line", number=number,
        )  # fmt: skip

    return RecordedMotion(
        name=folder.resolve().name, state=track(_STATE, "state"), command=track(_CONTROL, "command"), angle_unit=unit,
        robot=f"sage:{folder.resolve().name}", extra={"source": str(folder.name), "format": "sage"},
        notes=(f"columns that are no joints of {arm.name} dropped: {', '.join(match.dropped)}",) * bool(match.dropped),
    )  # fmt: skip


def _lines(path: Path) -> list[str]:
    try:
        return read_bounded(path, TEXT_MOST, "cut it into several motions").decode("utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise FileError(path, "no such file, but a SAGE motion needs it", "copy the whole folder") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"not readable text ({error})", "copy it again") from error


def _samples(path: Path, joints: int) -> tuple[Array, Array, np.ndarray]:
    """Read time (T,) in the unit of the file, positions (T, joints) and line numbers (T,)."""
    times: list[float] = []
    values: list[list[float]] = []
    numbers: list[int] = []
    reader = csv.reader(_lines(path), strict=True)
    try:
        header = next(reader, [])
        if header[1:3] != ["timestamp", "positions"]:
            raise FileError(path, f"line 1: columns {', '.join(header)}, expected type, timestamp, positions", _REMEDY)
        for row in reader:
            if len(row) != len(header):
                raise FileError(path, f"line {reader.line_num}: {len(row)} columns, expected {len(header)}", _REMEDY)
            times.append(_number(row[1], path, reader.line_num))
            values.append(_positions(row[2], joints, path, reader.line_num))
            numbers.append(reader.line_num)
    except csv.Error as error:
        raise FileError(path, f"line {reader.line_num}: {error}", _REMEDY) from error
    return np.array(times), np.array(values, dtype=float).reshape(-1, joints), np.array(numbers, dtype=np.int64)


def _number(text: str, path: Path, line: int) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise FileError(path, f"line {line}: timestamp {text!r} is no number", _REMEDY) from error


def _positions(text: str, joints: int, path: Path, line: int) -> list[float]:
    try:
        row = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"line {line}: positions {text[:40]!r} are no list of numbers", _REMEDY) from error
    if not isinstance(row, list) or len(row) != joints:
        found = len(row) if isinstance(row, list) else type(row).__name__
        raise FileError(path, f"line {line}: {found} positions, but {_JOINTS} names {joints} joints", _REMEDY)
    try:
        return [float(value) for value in row]
    except (TypeError, ValueError, OverflowError) as error:
        raise FileError(path, f"line {line}: positions {text[:40]!r} are no list of numbers", _REMEDY) from error
