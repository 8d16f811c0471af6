"""Summary rows of runs and checks: one for the arm, one for each joint.

Unique file names let several machines write into one folder.
"""

from __future__ import annotations

import hashlib
import re
import types
import typing
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from rejoint.arms import Arm
from rejoint.logs.runlog import read_parquet
from rejoint.system.errors import FileError, first_line
from rejoint.system.files import write_whole
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
_TIME = pa.timestamp("us")
_EARLIEST, _LATEST = (pa.scalar(end, _TIME).value for end in (datetime.min, datetime.max))


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


def _column(kind: Any) -> pa.DataType:  # noqa: ANN401
    plain = next(one for one in (typing.get_args(kind) or (kind,)) if one is not types.NoneType)
    return {str: pa.string(), float: pa.float64(), datetime: _TIME}[plain]


_KINDS = typing.get_type_hints(HistoryRow)
SCHEMA = pa.schema([(item.name, _column(_KINDS[item.name])) for item in fields(HistoryRow)])
"""Columns"""


def utc_now() -> datetime:
    """UTC without a zone."""
    return datetime.now(UTC).replace(tzinfo=None)


def write_rows(path: Path, rows: Sequence[HistoryRow]) -> None:
    """Write summary rows, whole or not at all; FileError."""
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema=SCHEMA)
    table = table.replace_schema_metadata({_FORMAT_KEY: str(FORMAT).encode()})
    write_whole(path, lambda temporary: pq.write_table(table, temporary, write_page_checksum=True))


def read_table(path: Path) -> pa.Table:
    """Read a table of `SCHEMA`; FileError if damaged or of a later version."""
    remedy = "delete it; the other files are not concerned"
    try:
        table = read_parquet(path, remedy)
        told = (table.schema.metadata or {}).get(_FORMAT_KEY)
        if told is None:
            raise FileError(path, "holds no summary rows", "move it elsewhere; the other files are not concerned")
        version = int(told)
        if not 1 <= version <= FORMAT:
            raise FileError(path, f"summary rows of format {version}, expected {FORMAT}", "update rejoint")
        count, found = len(table), table.column_names
        columns = [table[item.name] if item.name in found else pa.nulls(count, item.type) for item in SCHEMA]
        table = pa.table(columns, schema=SCHEMA)
        _require_usable(table)
        return table
    except (OSError, pa.ArrowException, LookupError, TypeError, ValueError) as error:
        raise FileError(path, f"damaged ({first_line(error)})", remedy) from error


def _require_usable(table: pa.Table) -> None:
    """Raise ValueError for rows without key columns, or impossible times."""
    for name in ("time", "kind", "arm"):
        if table[name].null_count:
            raise ValueError(f"rows without {name}")
    for item in SCHEMA:
        if item.type == _TIME:
            ends = pc.min_max(table[item.name].cast(pa.int64()))
            if any(end is not None and not _EARLIEST <= end <= _LATEST for end in ends.as_py().values()):
                raise ValueError(f"{item.name} is no date")


def read_rows(path: Path) -> list[HistoryRow]:
    """Read summary rows; errors as `read_table`."""
    return rows_from(read_table(path))


def rows_from(table: pa.Table) -> list[HistoryRow]:
    """Rows of a table of `SCHEMA`."""
    texts = {item.name for item in SCHEMA if item.type == pa.string()}
    found = []
    for row in table.to_pylist():
        values: dict[str, Any] = {name: "" if value is None and name in texts else value for name, value in row.items()}
        found.append(HistoryRow(**values))
    return found
