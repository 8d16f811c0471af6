"""Text files with named columns, one row per control cycle.

Columns: ``time``, ``position.JOINT`` and ``command.JOINT``, and where known ``target.x`` .. ``true_tcp.z``; others by a
map. A name ends in its unit (``time_s``, ``time_ms``, ``position.elbow_flex_deg``, ``target.x_mm``) unless the
options give it; a column with no unit at all, or with two, is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.columns import GROUPS, LENGTHS, Column, understood
from rejoint.logs.joints import match_joints, radians
from rejoint.logs.options import TIME_UNITS, ImportOptions
from rejoint.logs.runlog import AXES, Array
from rejoint.logs.textfile import Sheet, has_decimal_commas, head, number, read_sheet
from rejoint.logs.track import Points, RecordedMotion, Track
from rejoint.system.errors import FileError

_ENDINGS = (".csv", ".tsv", ".txt", ".dat", ".log")
_EXPECTED = "a time, position.JOINT and command.JOINT"


def fits(source: Path, options: ImportOptions) -> bool:
    """Tell whether a file is text with columns, or a folder holds some with those of a log."""
    if source.is_dir():
        return bool(_files(source, options)[0])
    return source.is_file() and head(source) is not None


def motions(source: Path, arm: Arm, options: ImportOptions) -> tuple[int, Iterator[RecordedMotion]]:
    """Count the text files with logs at a path and read them one by one, sorted by name."""
    options.refuse_others(source, "csv", "angle_unit", "time_unit", "joint_map", "calibration", "columns")
    files, others = _files(source, options) if source.is_dir() else ([source], [])
    if not files:
        raise FileError(source, "no CSV file with columns position.JOINT here", "check the path or the format")
    left = [f"files without columns of a log left out: {', '.join(file.name for file in others)}"] * bool(others)
    return len(files), (_read(file, arm, options, left if file == files[0] else []) for file in files)


def _files(folder: Path, options: ImportOptions) -> tuple[list[Path], list[Path]]:
    """Return the files of a folder that hold columns of a log, and other tables in it."""
    found: list[Path] = []
    others: list[Path] = []
    for file in sorted(file for file in folder.iterdir() if file.suffix.lower() in _ENDINGS and file.is_file()):
        sheet = head(file)
        named = sheet is not None and any(title.startswith(("position.", "command.")) for title in sheet.titles)
        mapped = sheet is not None and bool(
            {*(options.columns or {}), *(options.columns or {}).values()} & {*sheet.titles}
        )
        if named or mapped:
            found.append(file)
        elif sheet is not None or file.suffix.lower() == ".csv":
            others.append(file)
    return found, others


def _read(file: Path, arm: Arm, options: ImportOptions, notes: list[str]) -> RecordedMotion:
    sheet = read_sheet(file)
    doubled = sorted({title for title in sheet.titles if title and sheet.titles.count(title) > 1})
    if doubled:
        raise FileError(file, f"line 1: column {', '.join(doubled)} stands there twice", "rename one of them")
    columns, ignored = understood(sheet, arm, options)
    time_column = _time_column(sheet, columns)
    sheet, cut = _without_cut_line(sheet, columns)
    values, commas = _values(sheet, columns)
    notes = [*notes, *cut, *[f"columns ignored: {', '.join(ignored)}"] * bool(ignored)]
    if not sheet.plain or commas:
        notes.append(f"read as {sheet.found}{', decimal commas' * commas}")
    time = values[:, time_column.index] / TIME_UNITS[time_column.unit]
    tracks, units = {}, set()
    for what, group in (("state", "position"), ("command", "command")):
        chosen = [column for column in columns if column.group == group]
        if group == "command" and not chosen:
            continue
        track, dropped = _track(sheet, chosen, (what, group), (time, values), arm, options)
        tracks[what] = track
        units |= {column.unit for column in chosen}
        notes += [f"columns of {group} that are no joints dropped: {', '.join(dropped)}"] * bool(dropped)
    return RecordedMotion(
        name=file.stem, state=tracks["state"], command=tracks.get("command"), angle_unit="/".join(sorted(units)),
        points=_points(time, values, columns, file), robot=f"csv:{file.stem}",
        extra={"source": file.name, "format": "csv"}, notes=tuple(notes),
    )  # fmt: skip


def _time_column(sheet: Sheet, columns: list[Column]) -> Column:
    times = [column for column in columns if column.group == "time"]
    if len(times) != 1:
        found = " and ".join(column.title for column in times) or "none"
        raise FileError(
            sheet.path, f"{found} of the columns {sheet.shown} says the time, expected one; the file is {sheet.found}",
            f"name one {' or '.join(f'time_{unit}' for unit in TIME_UNITS)}, or map yours: --map time=THEIRS",
        )  # fmt: skip
    if not any(column.group in GROUPS[:2] for column in columns):
        raise FileError(
            sheet.path, f"no column with joint positions; found {sheet.found}: {sheet.shown}",
            f"name them position.JOINT and command.JOINT, or map yours: --map JOINT=THEIRS; expected {_EXPECTED}",
        )  # fmt: skip
    return times[0]


def _track(
    sheet: Sheet, chosen: list[Column], what: tuple[str, str], numbers: tuple[Array, Array], arm: Arm,
    options: ImportOptions,
) -> tuple[Track, tuple[str, ...]]:  # fmt: skip
    """Return states or commands in the arm's order, and the columns that are no joints."""
    names, titles = [column.name for column in chosen], [column.title for column in chosen]
    match = match_joints(names, arm, options, sheet.path, what[1], titles)
    joints = [chosen[index] for index in match.columns]
    raw = numbers[1][:, [column.index for column in joints]]
    for unit in {column.unit for column in joints}:
        of_unit = np.array([column.unit == unit for column in joints])
        raw = np.where(of_unit, radians(np.where(of_unit, raw, 0.0), unit, arm, options, sheet.path), raw)
    track = Track(
        path=sheet.path, what=what[0], time=numbers[0], value=raw, columns=match.names, place="line",
        number=np.array(sheet.numbers, dtype=np.int64),
    )  # fmt: skip
    return track, match.dropped


def _without_cut_line(sheet: Sheet, columns: list[Column]) -> tuple[Sheet, list[str]]:
    """Leave the last row out where it may have been cut in the middle of a number: its line does not end."""
    if sheet.ends or len(sheet.rows) < 3 or not columns:
        return sheet, []
    last = max(column.index for column in columns)
    shortest = min(len(row[last].strip()) for row in sheet.rows[:-1])
    if last != len(sheet.titles) - 1 or len(sheet.rows[-1][last].strip()) >= shortest:
        return sheet, []
    line = sheet.numbers[-1]
    left = replace(sheet, rows=sheet.rows[:-1], numbers=sheet.numbers[:-1])
    return left, [f"line {line}, the last, does not end and may be cut: left out"]


def _values(sheet: Sheet, columns: list[Column]) -> tuple[Array, bool]:
    """Read the numbers (T, columns), NaN where a log needs none, and whether they have decimal commas."""
    needed = [column.index for column in columns]
    commas = has_decimal_commas(sheet, needed)
    values = np.full((len(sheet.rows), len(sheet.titles)), np.nan)
    for index, (row, line) in enumerate(zip(sheet.rows, sheet.numbers, strict=True)):
        for column in needed:
            values[index, column] = number(row[column], (sheet, line, sheet.titles[column]), commas=commas)
    return values, commas


def _points(time: Array, values: Array, columns: list[Column], file: Path) -> dict[str, Points]:
    points = {}
    for group in ("target", "true_tcp"):
        axes = {column.name: column for column in columns if column.group == group}
        count = sum(column.group == group for column in columns)
        if not count:
            continue
        if set(axes) != set(AXES) or count != len(AXES):
            raise FileError(file, f"columns of {group} are not x, y and z, once each", "name all three or none")
        scale = np.array([LENGTHS[axes[axis].unit] for axis in AXES])
        points[group] = Points(time=time, value=values[:, [axes[axis].index for axis in AXES]] / scale)
    return points
