"""Readers of files and folders with columns: SAGE, tables, and LeRobot's datasets.

SAGE (github.com/isaac-sim2real/sage): a folder per motion. ``control.csv`` (type, timestamp, positions) holds commands,
``state_motor.csv`` states, in the order of ``joint_list.txt``, in microseconds and radians. Tables: text, JSON records,
NumPy archives. LeRobot, versions 2 and 3 (huggingface/lerobot, folder ``datasets``): ``observation.state`` was
measured, ``action`` sent; each episode is one log.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from rejoint.arms import Array
from rejoint.logs.columns import RawMotion
from rejoint.logs.joints import TIME_UNITS, ImportOptions
from rejoint.logs.runlog import LOG_MOST, read_parquet
from rejoint.system.errors import FileError
from rejoint.system.files import JSON_MOST, begins_with, read_bounded, reading, require_file
from rejoint.system.textfile import ANGLES, TEXT_MOST, head, read_sheet, shown, split_unit


class Reader(NamedTuple):
    """Reads one format."""

    found: Callable[[Path], list[Path]]
    """its files or folders at a path, sorted by name"""
    read: Callable[[Path, ImportOptions], Iterable[RawMotion]]
    """the motions in one of these"""


_CONTROL, _STATE, _JOINTS = "control.csv", "state_motor.csv", "joint_list.txt"
_CUT = "cut it into several motions"


def _sage_folders(source: Path) -> list[Path]:
    if not source.is_dir():
        return []
    return [source] if _is_sage(source) else sorted(filter(_is_sage, source.iterdir()))


def _is_sage(folder: Path) -> bool:
    return (folder / _STATE).is_file() or ((folder / _CONTROL).is_file() and (folder / _JOINTS).is_file())


def _read_sage(folder: Path, options: ImportOptions) -> list[RawMotion]:
    file = folder / _JOINTS
    with reading(file, "a SAGE motion needs it, and it is no readable text", "copy it"):
        text = read_bounded(file, TEXT_MOST, _CUT).decode("utf-8-sig")
    names = [name.strip() for name in text.splitlines() if name.strip()]
    ticks = TIME_UNITS[options.time_unit or "us"]
    state, sent = (
        _sage_motion(folder / file, names, group, ticks)
        for file, group in ((_STATE, "position"), (_CONTROL, "command"))
    )
    return [state.with_commands(sent)]


def _sage_motion(path: Path, names: list[str], group: str, ticks: float) -> RawMotion:
    sheet, remedy = read_sheet(path), f"mend the line or leave this motion out; {_JOINTS} names the joints"
    if sheet.titles[1:3] != ("timestamp", "positions"):
        raise FileError(path, f"line 1: columns {shown(sheet.titles)}, expected type, timestamp, positions", remedy)
    values = np.empty((len(sheet), len(names)))
    for row, text in enumerate(sheet.words(2)):
        said = f"line {sheet.lines[row]}: positions {text[:40]!r} are no list of {len(names)} numbers"
        with reading(path, said, remedy):
            numbers = json.loads(text)
            values[row] = numbers if len(numbers) == len(names) else "of another length"
    columns = {f"{group}.{name}": numbers for name, numbers in zip(names, values.T, strict=True)}
    about = {"number": sheet.lines, "place": "line", "angle_unit": "rad"}
    return RawMotion.of(path.parent.resolve().name, path, columns, time=sheet.numbers([1])[:, 0] / ticks, **about)


_ENDINGS = (".csv", ".tsv", ".txt", ".dat", ".log", ".json", ".npz")
_AGAIN = "record it again, or write its columns as text"


def _tables(source: Path) -> list[Path]:
    if not source.is_dir():
        return [source] * (source.is_file() and _holds_columns(source))
    return [file for file in sorted(source.iterdir()) if file.suffix.lower() in _ENDINGS and _holds_columns(file)]


def _holds_columns(file: Path) -> bool:
    return _columns_of(file) is not None or head(file) is not None


def _columns_of(file: Path) -> Callable[[Path], tuple[dict[str, Array], str]] | None:
    """Reader of the columns of a file by its ending and first bytes; None: not of text."""
    magic, read = _KINDS.get(file.suffix.lower(), (b"", None))
    return read if magic and begins_with(file, magic) else None


def _read_table(file: Path, options: ImportOptions) -> list[RawMotion]:
    if (read := _columns_of(file)) is not None:
        columns, found = read(file)
        return [RawMotion.of(file.stem, file, columns, found=found)]
    sheet = read_sheet(file, names=options.names, whole=False)
    motion = RawMotion(
        name=file.stem,
        path=file,
        titles=sheet.titles,
        values=sheet.numbers,
        number=sheet.lines,
        place="line",
        found=sheet.found,
        notes=sheet.remarks,
    )
    return [motion]


def _records(file: Path) -> tuple[dict[str, Array], str]:
    with reading(file, "JSON without one list of records of numbers", _AGAIN):
        data = json.loads(read_bounded(file, TEXT_MOST, "cut it into several files"))
        (rows,) = [one for one in data.values() if isinstance(one, list) and one and isinstance(one[0], dict)]
        columns = {
            key: [row.get(key) for row in rows] for key, value in rows[0].items() if isinstance(value, int | float)
        }
        beside = {key: [one] * len(rows) for key, one in data.items() if isinstance(one, int | float)}
        return {key: np.array(one, dtype=float) for key, one in (beside | columns).items()}, "JSON with records"


def _archive(file: Path) -> tuple[dict[str, Array], str]:
    """Arrays of a NumPy archive; (T, n) become columns NAME_0 and so on, with the unit of NAME at their ends."""
    with reading(file, "no archive of NumPy arrays", _AGAIN):
        require_file(file, LOG_MOST, "cut it into several files")
        with np.load(file, allow_pickle=False) as arrays:
            held = {name: arrays[name] for name in arrays.files}
    numbers = {name: one for name, one in held.items() if one.ndim in (1, 2) and one.dtype.kind in "biuf"}
    lengths = [len(one) for one in numbers.values()]
    rows = max(lengths, key=lengths.count, default=0)
    columns: dict[str, Array] = {}
    for name, one in numbers.items():
        if len(one) == rows:
            stem, unit = split_unit(name, ANGLES)
            ending = f"_{unit}" * bool(unit)
            titles = [name] if one.ndim == 1 else [f"{stem}_{i}{ending}" for i in range(one.shape[1])]
            columns |= zip(titles, one.reshape(rows, -1).T.astype(float), strict=True)
    return columns, "a NumPy archive"


_KINDS = {".npz": (b"PK\x03\x04", _archive), ".json": (b"{", _records)}
_INFO = "meta/info.json"
_GROUPS = {"observation.state": "position", "action": "command"}
_SCALARS = ("frame_index", "timestamp", "episode_index")
_TOLERANCE = 1e-4
"""[s] ``tolerance_s`` of LeRobotDataset"""
_REMEDY = "download or record the dataset again"


def _datasets(source: Path) -> list[Path]:
    return [source] * (source / _INFO).is_file()


def _episodes(source: Path, options: ImportOptions) -> Iterator[RawMotion]:
    path = source / _INFO
    with reading(path, "damaged", _REMEDY):
        data = json.loads(read_bounded(path, JSON_MOST, _REMEDY))
        version, fps, frames = str(data["codebase_version"]), float(data["fps"]), int(data["total_frames"])
        if not version.startswith(("v2.", "v3.")):
            said = f"dataset version {version}, expected v2 or v3"
            raise FileError(path, said, "convert it with LeRobot's converter")
        if not 0 < fps < np.inf:
            raise FileError(path, f"fps is {fps}", _REMEDY)
        names = {key: _names(data["features"][key], options, path, key) for key in _GROUPS}
    if options.angle_unit is None:
        said = f"a LeRobot dataset does not say the unit of {' and '.join(_GROUPS)}"
        remedy = "set --angle-unit: deg or rad, or normalised, with the calibration file where you have it"
        raise FileError(path, said, remedy)
    held = _read_frames(source)
    index, stamps, episodes = (held.pop(key)[:, 0] for key in _SCALARS)
    if len(index) != frames:
        raise FileError(source, f"{len(index)} frames in data, but {_INFO} promises {frames}", _REMEDY)
    with reading(source, "frames of another width than its names", _REMEDY):
        columns = {title: one for key in names for title, one in zip(names[key], held[key].T, strict=True)}
    for number in np.unique(episodes).astype(int).tolist():
        rows = np.flatnonzero(episodes == number)
        rows = rows[np.argsort(index[rows], kind="stable")]
        nominal, measured, name = index[rows] / fps, stamps[rows], f"episode_{number:06d}"
        even = bool((np.abs(measured - nominal) < _TOLERANCE).all())
        said = "are" if even else "differ from"
        note = f"the stamps {said} frame numbers over {fps:g} Hz" + ", no measured times" * even
        yield RawMotion.of(
            name,
            source,
            {title: column[rows] for title, column in columns.items()},
            time=nominal if even else measured,
            number=rows + 1,
            place=f"{name}, row",
            found="a LeRobot dataset",
            notes=[note],
            extra={"episode": str(number)},
        )


def _names(feature: dict[str, object], options: ImportOptions, path: Path, key: str) -> list[str]:
    shape, held = feature["shape"], feature["names"]
    if isinstance(held, dict) and len(held) == 1:
        held = next(iter(held.values()))
    if not isinstance(held, list):
        held = options.names
    if not held or shape != [len({*map(str, held)})]:
        raise FileError(path, f"{key} has the shape {shape} and the names {held}", "name all columns with --order")
    return [f"{_GROUPS[key]}.{name}" for name in held]


def _read_frames(source: Path) -> dict[str, Array]:
    """State, action and scalars (T, k) of all frames."""
    files = sorted((source / "data").glob("*/*.parquet"))
    if not files:
        raise FileError(source / "data", "no Parquet file in it", _REMEDY)
    keys, tables = [*_GROUPS, *_SCALARS], list[pa.Table]()
    for file in files:
        with reading(file, "not the frames of a dataset", _REMEDY):
            tables.append(read_parquet(file, _REMEDY, keys).select(keys))
    with reading(source, "frames of different width, or no numbers", _REMEDY):
        table = pa.concat_tables(tables)
        return {key: np.array(table[key].to_pylist(), dtype=float).reshape(len(table), -1) for key in keys}


SAGE = Reader(_sage_folders, _read_sage)
TABLE = Reader(_tables, _read_table)
LEROBOT = Reader(_datasets, _episodes)
