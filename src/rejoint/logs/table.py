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


def found(source: Path, options: ImportOptions) -> list[Path]:
    """Files with columns of a log at a path, sorted by name."""
    if not source.is_dir():
        return [source] * (source.is_file() and _titles(source) is not None)
    held = {file: _titles(file) for file in sorted(source.iterdir()) if file.suffix.lower() in _ENDINGS}
    known = options.names or ()
    return [
        file
        for file, titles in held.items()
        if titles == () or (titles and holds_positions([*titles, *known], options))
    ]


def motions(paths: Sequence[Path], arm: Arm, options: ImportOptions) -> list[Pending]:
    """One motion of each file."""
    beside = paths[0].parent.glob("*.csv") if len(paths) > 1 else ()
    others = sorted(file.name for file in beside if file not in paths)
    left = [f"files without columns of a log left out: {', '.join(others)}"] * bool(others)
    return [(file.stem, partial(_read, file, arm, options, left * (file == paths[0]))) for file in paths]


def _titles(file: Path) -> tuple[str, ...] | None:
    """Titles of a file; empty for JSON and archives, None for other files."""
    kinds = {".npz": b"PK\x03\x04", ".json": b"{"}
    kind = kinds.get(file.suffix.lower())
    if kind is not None and begins_with(file, kind):
        return ()
    sheet = head(file)
    return None if sheet is None else sheet.titles


def _read(file: Path, arm: Arm, options: ImportOptions, notes: list[str]) -> RecordedMotion:
    if _titles(file) == ():
        frame = (_archive if file.suffix.lower() == ".npz" else _records)(file)
    else:
        sheet = read_sheet(file, names=options.names, whole=False)
        notes = [
            *notes,
            *[f"read as {sheet.found}"] * (not sheet.plain),
            *["the last line does not end and may be cut: left out"] * (not sheet.ends),
        ]
        frame = ColumnFrame(
            path=file, titles=sheet.titles, values=sheet.numbers, number=sheet.lines, place="line", found=sheet.found
        )
    extra = {"source": file.name, "format": "table"}
    return read_motion(file.stem, [frame], arm, options, robot=f"table:{file.stem}", notes=notes, extra=extra)


def _frame(file: Path, columns: dict[str, Array], rows: int, found: str) -> ColumnFrame:
    values = list(columns.values())
    return ColumnFrame(
        path=file,
        titles=tuple(columns),
        values=lambda chosen: np.stack([values[i] for i in chosen], axis=1),
        number=np.arange(1, rows + 1),
        found=found,
    )


def _records(file: Path) -> ColumnFrame:
    """Return records of a JSON file; numbers beside them hold for every row."""
    try:
        data = json.loads(read_bounded(file, TEXT_MOST, "cut it into several files"))
        (rows,) = [one for one in data.values() if isinstance(one, list) and one and isinstance(one[0], dict)]
        columns = {key: _numbers([row.get(key) for row in rows]) for key, value in rows[0].items() if _is_number(value)}
        beside = {key: _numbers([one] * len(rows)) for key, one in data.items() if _is_number(one)}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise FileError(file, f"JSON without one list of records of numbers ({error})", _REMEDY) from error
    return _frame(
        file, columns | {key: one for key, one in beside.items() if key not in columns}, len(rows), "JSON with records"
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float)


def _numbers(values: list[Any]) -> Array:
    return np.array([np.nan if value is None else float(value) for value in values])


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
        if len(one) == rows:
            parts = {name: one} if one.ndim == 1 else {f"{name}_{i}": part for i, part in enumerate(one.T)}
            columns |= {title: part.astype(float) for title, part in parts.items()}
    return _frame(file, columns, rows, "a NumPy archive")
