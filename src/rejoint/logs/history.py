"""Summary rows of runs and checks: one for the arm, one for each joint.

Unique file names let several machines write into one folder. ``.history.parquet`` caches the rows below a folder by
name, size and time of each file, so that only new files are opened; it may be deleted.
"""

from __future__ import annotations

import hashlib
import os
import re
import typing
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from rejoint.arms import Arm
from rejoint.logs.runlog import read_parquet
from rejoint.system.errors import FileError
from rejoint.system.files import reading, write_whole
from rejoint.system.shell import __version__

_PASSING = re.compile(r"[?&](hours|ambient)=[^&]*")
_HOURS = re.compile(r"[?&]hours=([\d.]+)")
_NOT_A_NAME = re.compile(r"[^\w.-]+")


def name_of(address: str, model: str) -> str:
    """Name an arm by address and description."""
    return plain_name(f"{model}-{_PASSING.sub('', address)}")


def plain_name(text: str) -> str:
    """Make ``text`` a file name."""
    return _NOT_A_NAME.sub("-", text).strip("-.") or "arm"


def hours_of(address: str) -> float | None:
    """[h] of use in an emulated arm's address, or None."""
    found = _HOURS.search(address) if address.startswith("emulated:") else None
    return None if found is None else float(found[1])


def setup_of(arm: Arm) -> str:
    """Fingerprint of a description."""
    text = hashlib.sha256()
    for item in fields(arm):
        value = getattr(arm, item.name)
        parts = (value.lower, value.upper) if item.name == "targets" else (value,)
        for part in parts:
            text.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return text.hexdigest()[:16]


SUMMARY = "summary.parquet"
"""File name of summary rows"""
FORMAT = 1
"""Version; later ones are skipped"""

_FORMAT_KEY = b"rejoint.history"


@dataclass(frozen=True, kw_only=True)
class HistoryRow:
    """Summary of an arm or joint; None: unknown; times in UTC."""

    time: datetime
    """without a zone"""
    kind: str
    """``check``, ``run`` (unfinished) or ``repair``"""
    arm: str
    """user's name of the arm"""
    joint: str = ""
    """empty: the arm"""
    robot: str = ""
    """address"""
    model: str = ""
    """name of the description, such as mycobot280"""
    version: str = __version__
    """of the software"""
    setup: str = ""
    """fingerprint of the description"""
    norm: str = ""
    """reason of a new baseline, or empty"""
    used_h: float | None = None
    """[h] of use, by the user"""
    temperature_c: float | None = None
    hysteresis_mm: float | None = None
    reversal_mm: float | None = None
    deviation_mm: float | None = None
    sag_mm: float | None = None
    lever_mm: float | None = None
    """[mm/rad] of angles in millimetres"""
    error_mm: float | None = None
    """encoders: AP of a check, diagnosis of a run"""
    repeatability_mm: float | None = None
    approach_mm: float | None = None
    true_error_mm: float | None = None
    true_approach_mm: float | None = None
    controlled_mm: float | None = None
    """after a repair, see `Outlook.controlled_mm`"""
    tolerance_mm: float | None = None
    """the user's"""
    stiffness_nm_per_rad: float | None = None
    """of the servo, by a diagnosis"""
    coulomb_nm: float | None = None
    lag_s: float | None = None
    offset_rad: float | None = None
    controller: str = ""
    """recommended"""
    settled_mm: float | None = None
    """encoder error at rest with it"""
    settled_true_mm: float | None = None
    success: float | None = None
    """share of reached targets with it"""
    state: str = ""
    """of a check: learning, steady, drifting or alarm; else of a run"""
    cause: str = ""
    """largest change, in words"""
    line: str = ""
    """message to the user"""
    due_early: datetime | None = None
    """10th percentile of the time at the tolerance"""
    due: datetime | None = None
    due_late: datetime | None = None
    """90th percentile; None: perhaps never"""

    @property
    def left_mm(self) -> float | None:
        """[mm] tool error under a run's controller."""
        return self.settled_mm if self.settled_true_mm is None else self.settled_true_mm

    @property
    def counts_mm(self) -> float | None:
        """[mm] tool error that counts."""
        with_it = self.left_mm if self.kind == "repair" else self.controlled_mm
        bare = self.error_mm if self.true_error_mm is None else self.true_error_mm
        return bare if with_it is None else with_it

    @property
    def over(self) -> bool:
        """Whether it reached the tolerance."""
        limit, counts = self.tolerance_mm, self.counts_mm
        return limit is not None and counts is not None and counts >= limit


_ARROW = {str: pa.string(), float: pa.float64(), datetime: pa.timestamp("us")}
_KINDS = typing.get_type_hints(HistoryRow)
SCHEMA = pa.schema(
    [(item.name, _ARROW[(*typing.get_args(_KINDS[item.name]), _KINDS[item.name])[0]]) for item in fields(HistoryRow)]
)
"""Columns"""


def utc_now() -> datetime:
    """UTC without a zone."""
    return datetime.now(UTC).replace(tzinfo=None)


def write_rows(path: Path, rows: Sequence[HistoryRow]) -> None:
    """Write summary rows, whole or not at all; FileError."""
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema=SCHEMA)
    _write_table(path, table.replace_schema_metadata({_FORMAT_KEY: str(FORMAT).encode()}))


def _write_table(path: Path, table: pa.Table) -> None:
    write_whole(path, lambda temporary: pq.write_table(table, temporary, write_page_checksum=True))


def read_table(path: Path) -> pa.Table:
    """Read a table of `SCHEMA`; FileError if damaged or of another version."""
    remedy = "delete it; the other files are not concerned"
    with reading(path, "damaged", remedy):
        table = read_parquet(path, remedy)
        version = (table.schema.metadata or {}).get(_FORMAT_KEY, b"none").decode()
        if version != str(FORMAT):
            raise FileError(path, f"summary rows of format {version}, expected {FORMAT}", "update rejoint, or move it")
        found = table.column_names
        columns = [table[item.name] if item.name in found else pa.nulls(len(table), item.type) for item in SCHEMA]
        table = pa.table(columns, schema=SCHEMA)
        rows_from(table)  # what no row can hold fails here
        return table


def read_rows(path: Path) -> list[HistoryRow]:
    """Read summary rows; errors as `read_table`."""
    return rows_from(read_table(path))


def rows_from(table: pa.Table) -> list[HistoryRow]:
    """Rows of a table of `SCHEMA`; TypeError for rows without key columns."""
    return [
        HistoryRow(**{name: value for name, value in row.items() if value is not None}) for row in table.to_pylist()
    ]


INDEX = ".history.parquet"
"""Name of the cache"""
CHECKS = "checks"
"""Folder of the checks, by arm"""

_FILE = "file"
_INDEXED = SCHEMA.append(pa.field(_FILE, pa.string()))


def find_rows(folder: Path, arm: str | None = None) -> tuple[list[HistoryRow], tuple[str, ...]]:
    """Summary rows below a folder, oldest first, and unreadable files; ``arm``: only its checks."""
    paths = {key: path for key, path in _files(folder).items() if _is_of(path.relative_to(folder), arm)}
    known = _cached(folder)
    known = known.filter(pc.is_in(known[_FILE], pa.array(list(paths), pa.string())))
    tables, problems = [known], list[str]()
    for key in sorted(paths.keys() - {*known[_FILE].to_pylist()}):
        try:
            table = read_table(paths[key])
            tables.append(table.append_column(_FILE, pa.array([key] * len(table), pa.string())))
        except FileError as error:
            problems.append(_plain(str(error)))
    table = pa.concat_tables(tables).combine_chunks()
    if len(tables) > 1 and arm is None:
        with suppress(FileError):  # a folder that may only be read is read again the next time
            _write_table(folder / INDEX, table)
    rows = rows_from(table.select(SCHEMA.names))
    return sorted(rows, key=lambda row: (row.arm, row.time, row.kind)), tuple(problems)  # joints stay in their order


def _cached(folder: Path) -> pa.Table:
    with suppress(FileError), reading(folder / INDEX, "damaged", "delete it"):
        return read_parquet(folder / INDEX, "delete it").cast(_INDEXED)
    return _INDEXED.empty_table()


def _files(folder: Path) -> dict[str, Path]:
    """Files of summary rows by name, size and time; links are followed, each folder counts once."""
    found, seen = {}, set[str]()
    for where, below, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(where)
        if real in seen:
            below.clear()
        elif SUMMARY in names:
            path = Path(where, SUMMARY)
            with suppress(OSError):  # it went meanwhile
                state = path.stat()
                found[f"{_plain(str(path.relative_to(folder)))} {state.st_size} {state.st_mtime_ns}"] = path
        seen.add(real)
    return found


def _plain(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


def _is_of(path: Path, arm: str | None) -> bool:
    parts = path.parts
    return arm is None or CHECKS not in parts or parts[parts.index(CHECKS) + 1] == arm
