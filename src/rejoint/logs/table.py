"""Files with columns: text, JSON records, and NumPy archives."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.columns import holds_positions, read_motion
from rejoint.logs.options import ImportOptions
from rejoint.logs.runlog import LOG_MOST, Array
from rejoint.logs.track import ColumnFrame, Pending, RecordedMotion
from rejoint.system.errors import FileError
from rejoint.system.files import begins_with, read_bounded, require_file
from rejoint.system.textfile import TEXT_MOST, head, read_sheet

_ENDINGS = (".csv", ".tsv", ".txt", ".dat", ".log", ".json", ".npz")
_REMEDY = "record it again, or write its columns as text"


def fits(source: Path, options: ImportOptions) -> bool:
    """Whether a path holds columns of a log."""
    if source.is_dir():
        return bool(_files(source, options)[0])
    return source.is_file() and _titles(source) is not None


def motions(source: Path, arm: Arm, options: ImportOptions) -> list[Pending]:
    """Motions of the files at a path, sorted by name."""
    files, others = _files(source, options) if source.is_dir() else ([source], [])
    if not files:
        raise FileError(source, "no file with columns position.JOINT here", "check the path or the format")
    left = [f"files without columns of a log left out: {', '.join(file.name for file in others)}"] * bool(others)
    return [(file.stem, partial(_read, file, arm, options, left * (file == files[0]))) for file in files]


def _files(folder: Path, options: ImportOptions) -> tuple[list[Path], list[Path]]:
    found: list[Path] = []
    others: list[Path] = []
    for file in sorted(file for file in folder.iterdir() if file.suffix.lower() in _ENDINGS and file.is_file()):
        titles = _titles(file)
        if titles is not None and (not titles or holds_positions([*titles, *(options.names or ())], options)):
            found.append(file)
        elif titles is not None or file.suffix.lower() == ".csv":
            others.append(file)
    return found, others


def _titles(file: Path) -> tuple[str, ...] | None:
    """Titles of a file; empty for JSON and archives, None for other files."""
    if begins_with(file, b"PK\x03\x04"):
        return () if file.suffix.lower() == ".npz" else None
    if file.suffix.lower() == ".json" and begins_with(file, b"{"):
        return ()
    sheet = head(file)
    return None if sheet is None else sheet.titles


def _read(file: Path, arm: Arm, options: ImportOptions, notes: Sequence[str]) -> RecordedMotion:
    more: list[str] = []
    if _titles(file) == ():
        frame = (_archive if file.suffix.lower() == ".npz" else _records)(file)
    else:
        frame, more = _text(file, options)
    return read_motion(
        file.stem,
        [frame],
        arm,
        options,
        robot=f"table:{file.stem}",
        notes=[*notes, *more],
        extra={"source": file.name, "format": "table"},
    )


def _text(file: Path, options: ImportOptions) -> tuple[ColumnFrame, list[str]]:
    sheet = read_sheet(file, names=options.names, whole=False)
    notes = [f"read as {sheet.found}"] * (not sheet.plain)
    notes += ["the last line does not end and may be cut: left out"] * (not sheet.ends)
    frame = ColumnFrame(
        path=file, titles=sheet.titles, values=sheet.numbers, number=sheet.lines, place="line", found=sheet.found
    )
    return frame, notes


def _frame(file: Path, columns: dict[str, Array], rows: int, found: str) -> ColumnFrame:
    titles = tuple(columns)
    return ColumnFrame(
        path=file,
        titles=titles,
        values=lambda chosen: np.stack([columns[titles[i]] for i in chosen], axis=1),
        number=np.arange(1, rows + 1),
        found=found,
    )


def _records(file: Path) -> ColumnFrame:
    """Return records of a JSON file; numbers beside them hold for every row."""
    try:
        data = json.loads(read_bounded(file, TEXT_MOST, "cut it into several files"))
        lists = {
            key: rows for key, rows in data.items() if isinstance(rows, list) and rows and isinstance(rows[0], dict)
        }
        (rows,) = lists.values()
        titles = [key for key, value in rows[0].items() if isinstance(value, int | float)]
        columns = {title: np.array([_number(row.get(title)) for row in rows]) for title in titles}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise FileError(file, f"JSON without one list of records of numbers ({error})", _REMEDY) from error
    beside = {key: value for key, value in data.items() if isinstance(value, int | float) and key not in columns}
    columns |= {key: np.full(len(rows), float(value)) for key, value in beside.items()}
    return _frame(file, columns, len(rows), "JSON with records")


def _number(value: Any) -> float:  # noqa: ANN401 - whatever stands in the file
    return float("nan") if value is None else float(value)


def _archive(file: Path) -> ColumnFrame:
    """Arrays of a NumPy archive; (T, n) become columns NAME_0 and so on."""
    try:
        require_file(file, LOG_MOST, "cut it into several files")
        with zipfile.ZipFile(file) as archive:
            if sum(member.file_size for member in archive.infolist()) > LOG_MOST:
                raise FileError(file, f"unfolds to more than {LOG_MOST} bytes", "cut it into several files")
        with np.load(file, allow_pickle=False) as arrays:
            held = {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FileError(file, f"no archive of NumPy arrays ({error})", _REMEDY) from error
    numbers = {name: one for name, one in held.items() if one.ndim in (1, 2) and one.dtype.kind in "biuf"}
    lengths = [len(one) for one in numbers.values()]
    rows = max(lengths, key=lengths.count, default=0)
    columns: dict[str, Array] = {}
    for name, one in numbers.items():
        if len(one) == rows and one.ndim == 1:
            columns[name] = one.astype(float)
        elif len(one) == rows:
            columns |= {f"{name}_{i}": one[:, i].astype(float) for i in range(one.shape[1])}
    return _frame(file, columns, rows, "a NumPy archive")
