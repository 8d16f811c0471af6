"""All summary rows below a folder; only new files are opened.

``.history.parquet`` caches them by name, size and time of each file; it may be deleted.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from rejoint.logs.history.rows import SCHEMA, SUMMARY, HistoryRow, read_table, rows_from
from rejoint.logs.runlog import read_parquet
from rejoint.system.errors import FileError
from rejoint.system.files import write_whole

INDEX = ".history.parquet"
"""Name of the cache"""
CHECKS = "checks"
"""Folder of the checks, by arm"""

_FILE = "file"
_INDEXED = SCHEMA.append(pa.field(_FILE, pa.string()))


def find_rows(folder: Path, arm: str | None = None) -> tuple[list[HistoryRow], tuple[str, ...]]:
    """Summary rows below a folder, oldest first, and unreadable files; ``arm``: only its checks."""
    table, problems = find_table(folder, arm)
    rows = rows_from(table)
    return sorted(rows, key=lambda row: (row.arm, row.time, row.kind)), problems  # joints stay in the arm's order


def find_table(folder: Path, arm: str | None = None) -> tuple[pa.Table, tuple[str, ...]]:
    """Table of `SCHEMA`, and unreadable files."""
    paths = _files(folder)
    if arm is not None:
        paths = {key: path for key, path in paths.items() if _is_of(path.relative_to(folder), arm)}
    known = _copy(folder)
    known = known.filter(pc.is_in(known[_FILE], pa.array(list(paths), pa.string())))
    seen = set(known[_FILE].to_pylist())
    fresh, problems = _read({key: path for key, path in paths.items() if key not in seen})
    table = pa.concat_tables([known, fresh]).combine_chunks()
    if len(fresh) and arm is None:
        with suppress(FileError):  # a folder that may only be read is read again the next time
            write_whole(folder / INDEX, lambda temporary: pq.write_table(table, temporary, write_page_checksum=True))
    return table.select(SCHEMA.names), problems


def _read(paths: dict[str, Path]) -> tuple[pa.Table, tuple[str, ...]]:
    tables: list[pa.Table] = []
    problems = []
    for key, path in sorted(paths.items()):
        try:
            table = read_table(path)
            tables.append(table.append_column(_FILE, pa.array([key] * len(table), pa.string())))
        except FileError as error:
            problems.append(_plain(os.fsencode(str(error))))
    return pa.concat_tables([_INDEXED.empty_table(), *tables]).combine_chunks(), tuple(problems)


def _copy(folder: Path) -> pa.Table:
    """Return the cache, or an empty one."""
    empty = _INDEXED.empty_table()
    try:
        table = read_parquet(folder / INDEX, "delete it")
    except (OSError, pa.ArrowException, FileError):
        return empty
    return table if table.schema.equals(_INDEXED) else empty


def _files(folder: Path) -> dict[str, Path]:
    found = {}
    for place in _folders(folder):
        path = place / SUMMARY
        with suppress(OSError):
            seen = path.stat()
            found[f"{_plain(os.fsencode(path.relative_to(folder)))} {seen.st_size} {seen.st_mtime_ns}"] = path
    return found


def _plain(text: bytes) -> str:
    return text.decode(errors="backslashreplace")


def _folders(folder: Path) -> Iterator[Path]:
    """Yield folders with summary rows once, links included."""
    seen = set[tuple[int, int]]()
    for where, below, names in os.walk(folder, followlinks=True):
        place = Path(where)
        try:
            own = place.stat()
        except OSError:  # it went meanwhile
            continue
        if (own.st_dev, own.st_ino) in seen:
            below.clear()
            continue
        seen.add((own.st_dev, own.st_ino))
        if SUMMARY in names:
            yield place


def _is_of(path: Path, arm: str) -> bool:
    parts = path.parts
    return CHECKS not in parts or parts[parts.index(CHECKS) + 1] == arm
