"""CSV files with named columns, one row per control cycle.

Columns: ``time``, ``position.JOINT`` and ``command.JOINT``, and where known ``target.x`` .. ``true_tcp.z``.
A name ends in its unit (``time_s``, ``time_ms``, ``position.elbow_flex_deg``, ``target.x_mm``) unless the
options give it; a column with no unit at all, or with two, is refused.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.joints import match_joints, radians
from rejoint.logs.options import OPTIONS, TIME_UNITS, ImportOptions
from rejoint.logs.runlog import Array
from rejoint.logs.track import Points, RecordedMotion, Track
from rejoint.system.errors import FileError

AXES = ("x", "y", "z")
_LENGTHS = {"m": 1.0, "mm": 1e3}
_GROUPS = ("position", "command", "target", "true_tcp")
_UNITS = {
    "time": tuple(TIME_UNITS), "position": ("rad", "deg"), "command": ("rad", "deg"),
    "target": tuple(_LENGTHS), "true_tcp": tuple(_LENGTHS),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Column:
    index: int
    title: str
    group: str
    """``time``, ``position``, ``command``, ``target`` or ``true_tcp``"""
    name: str
    """joint or axis"""
    unit: str


def fits(source: Path) -> bool:
    """Tell whether a CSV file has columns of joint positions or commands, or a folder holds such files."""
    return bool(_files(source))


def motions(source: Path, arm: Arm, options: ImportOptions) -> tuple[int, Iterator[RecordedMotion]]:
    """Count the CSV logs at a path and read them one by one, sorted by name."""
    options.refuse_others(source, "csv", "angle_unit", "time_unit", "joint_map", "calibration")
    files = [source] if source.is_file() else _files(source)
    if not files:
        raise FileError(source, "no CSV file with columns position.JOINT here", "check the path or the format")
    return len(files), (_read(file, arm, options) for file in files)


def _files(source: Path) -> list[Path]:
    if source.is_dir():
        return sorted(file for file in source.glob("*.csv") if file.is_file() and _has_columns(file))
    return [source] if source.is_file() and _has_columns(source) else []


def _has_columns(file: Path) -> bool:
    try:
        with file.open(encoding="utf-8-sig", newline="") as lines:
            header = next(csv.reader([lines.readline(65_536)]), [])
    except (OSError, UnicodeDecodeError, csv.Error):
        return False
    return any(title.startswith(("position.", "command.")) for title in header)


def _read(file: Path, arm: Arm, options: ImportOptions) -> RecordedMotion:
    titles, values, number = _cells(file)
    columns, ignored = _columns(titles, options, file)
    notes = [f"columns ignored: {', '.join(ignored)}"] * bool(ignored)
    times = [column for column in columns if column.group == "time"]
    if len(times) != 1:
        found = " and ".join(column.title for column in times) or "none"
        raise FileError(
            file, f"{found} of the columns {', '.join(titles)} says the time, expected one",
            f"name one {' or '.join(f'time_{unit}' for unit in TIME_UNITS)}",
        )  # fmt: skip
    time = values[:, times[0].index] / TIME_UNITS[times[0].unit]
    tracks, units = {}, []
    for what, group in (("state", "position"), ("command", "command")):
        chosen = [column for column in columns if column.group == group]
        names, full = [column.name for column in chosen], [column.title for column in chosen]
        match = match_joints(names, arm, options, file, group, full)
        joints = [chosen[index] for index in match.columns]
        raw = values[:, [column.index for column in joints]]
        for unit in {column.unit for column in joints}:
            of_unit = np.array([column.unit == unit for column in joints])
            raw = np.where(of_unit, radians(np.where(of_unit, raw, 0.0), unit, arm, options, file), raw)
            units.append(unit)
        notes += [f"columns of {group} that are no joints dropped: {', '.join(match.dropped)}"] * bool(match.dropped)
        tracks[what] = Track(
            path=file, what=what, time=time, value=raw, columns=match.names,
            place="line", number=number,
        )  # fmt: skip
    return RecordedMotion(
        name=file.stem, state=tracks["state"], command=tracks["command"], angle_unit="/".join(sorted(set(units))),
        points=_points(time, values, columns, file), robot=f"csv:{file.stem}",
        extra={"source": file.name, "format": "csv"}, notes=tuple(notes),
    )  # fmt: skip


def _columns(titles: list[str], options: ImportOptions, file: Path) -> tuple[list[_Column], list[str]]:
    columns, ignored = [], []
    for index, title in enumerate(titles):
        group = _group(title)
        if group is None:
            ignored.append(title)
            continue
        name = title.removeprefix(f"{group}.")
        stem, _, ending = name.rpartition("_")
        known = bool(stem) and ending in _UNITS[group]
        unit = _unit(title, group, ending if known else None, options, file)
        columns.append(_Column(index=index, title=title, group=group, name=stem if known else name, unit=unit))
    return columns, ignored


def _group(title: str) -> str | None:
    """Tell what a column holds by its title; None for something that a log does not need."""
    if title in ("time", *(f"time_{unit}" for unit in TIME_UNITS)):
        return "time"
    group, _, name = title.partition(".")
    return group if group in _GROUPS and name else None


def _unit(title: str, group: str, written: str | None, options: ImportOptions, file: Path) -> str:
    name = {"time": "time_unit", "position": "angle_unit", "command": "angle_unit"}.get(group)
    declared, option = (getattr(options, name), OPTIONS[name]) if name else (None, "")
    if written and declared and written != declared:
        raise FileError(
            file, f"column {title} is in {written} by its name, but {option} says {declared}",
            f"leave {option} out or rename the column",
        )  # fmt: skip
    unit: str | None = written or declared
    if unit is None:
        endings = " or ".join(f"{title}_{unit}" for unit in _UNITS[group])
        more = f" or set {option}" if option else ""
        raise FileError(file, f"column {title} does not say its unit", f"rename it {endings}{more}")
    return unit


def _points(time: Array, values: Array, columns: list[_Column], file: Path) -> dict[str, Points]:
    points = {}
    for group in ("target", "true_tcp"):
        axes = {column.name: column for column in columns if column.group == group}
        count = sum(column.group == group for column in columns)
        if not count:
            continue
        if set(axes) != set(AXES) or count != len(AXES):
            raise FileError(file, f"columns of {group} are not x, y and z, once each", "name all three or none")
        scale = np.array([_LENGTHS[axes[axis].unit] for axis in AXES])
        points[group] = Points(time=time, value=values[:, [axes[axis].index for axis in AXES]] / scale)
    return points


def _cells(file: Path) -> tuple[list[str], Array, np.ndarray]:
    """Read the header, the numbers (T, columns) and their line numbers (T,).

    A cell is NaN where it is empty, and in a column that a log does not need where it holds no number.
    """
    remedy = "mend the line or take another file"
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except FileNotFoundError as error:
        raise FileError(file, "no such file", "check the path") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(file, f"not readable text ({error})", "save it as UTF-8") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows, numbers = [], []
    try:
        titles = [title.strip() for title in next(reader, [])]
        doubled = sorted({title for title in titles if titles.count(title) > 1})
        if doubled:
            raise FileError(file, f"line 1: column {', '.join(doubled)} stands there twice", "rename one of them")
        needed = [_group(title) is not None for title in titles]
        for row in reader:
            if not row:
                continue
            if len(row) != len(titles):
                found = f"line {reader.line_num}: {len(row)} columns, the header has {len(titles)}"
                raise FileError(file, found, remedy)
            rows.append([
                _cell(cell, need, (file, reader.line_num, title))
                for cell, need, title in zip(row, needed, titles, strict=True)
            ])  # fmt: skip
            numbers.append(reader.line_num)
    except csv.Error as error:
        raise FileError(file, f"line {reader.line_num}: {error}", remedy) from error
    return titles, np.array(rows, dtype=float).reshape(len(rows), len(titles)), np.array(numbers, dtype=np.int64)


def _cell(text: str, needed: bool, place: tuple[Path, int, str]) -> float:
    if not text.strip() or not needed:
        return np.nan
    try:
        return float(text)
    except ValueError as error:
        file, line, title = place
        raise FileError(file, f"line {line}, column {title}: {text[:40]!r} is no number", "mend the cell") from error
