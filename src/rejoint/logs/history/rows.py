"""Summary rows: what a run or a check came to, one row for the arm and one for each joint, in a file of their own.

Every file is written whole under a name that nothing else has, so that several machines may write into one folder at
once, and a damaged file loses itself alone. The columns are the fields of `HistoryRow`; whoever reads them needs no
software of ours.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from rejoint.logs.runlog import read_parquet
from rejoint.system.errors import FileError, first_line
from rejoint.system.files import write_whole
from rejoint.system.version import __version__

SUMMARY = "summary.parquet"
"""Name of every file of summary rows"""
FORMAT = 1
"""Version of the columns; a reader leaves files of later ones out, and takes missing columns for unknown"""

_FORMAT_KEY = b"rejoint.history"
_TIME = pa.timestamp("us")
_EARLIEST, _LATEST = (pa.scalar(end, _TIME).value for end in (datetime.min, datetime.max))


@dataclass(frozen=True, kw_only=True)
class HistoryRow:
    """What one run or check says of an arm, or of one joint of it; None is not known. Times are UTC."""

    time: datetime
    """when it was made, without a zone"""
    kind: str
    """check, run (a repair that is not finished, or single stages) or repair"""
    arm: str
    """name that its owner knows the arm by"""
    joint: str = ""
    """empty in the row of the arm itself"""
    robot: str = ""
    """address"""
    model: str = ""
    """name of its description, such as mycobot280"""
    version: str = __version__
    """of the software"""
    setup: str = ""
    """fingerprint of the description of the arm; with another one a new norm begins"""
    norm: str = ""
    """why a new norm begins with this check: moved, or set up with another description; empty where none does"""
    used_h: float | None = None
    """[h] of use so far, where the owner counts them"""
    temperature_c: float | None = None
    hysteresis_mm: float | None = None
    reversal_mm: float | None = None
    deviation_mm: float | None = None
    sag_mm: float | None = None
    lever_mm: float | None = None
    """[mm/rad] by which angles were turned into millimetres"""
    error_mm: float | None = None
    """by the encoders: of a check its AP, of a run what the diagnosis found"""
    repeatability_mm: float | None = None
    approach_mm: float | None = None
    true_error_mm: float | None = None
    true_approach_mm: float | None = None
    controlled_mm: float | None = None
    """of a check after a repair: error of the tool with the controller of that repair, see `Outlook.controlled_mm`"""
    tolerance_mm: float | None = None
    """that the owner gave"""
    stiffness_nm_per_rad: float | None = None
    """of the servo, as a diagnosis found it, as all below down to the offset"""
    coulomb_nm: float | None = None
    lag_s: float | None = None
    offset_rad: float | None = None
    controller: str = ""
    """that a comparison recommends"""
    settled_mm: float | None = None
    """encoder error at rest with that controller"""
    settled_true_mm: float | None = None
    success: float | None = None
    """share of targets reached with it"""
    state: str = ""
    """of a check: learning, steady, drifting or alarm; of a run the condition that its diagnosis tells"""
    cause: str = ""
    """what changed most, in words"""
    line: str = ""
    """what the owner was told"""
    due_early: datetime | None = None
    """when the tolerance is reached: one in ten of the times possible lies before"""
    due: datetime | None = None
    due_late: datetime | None = None
    """one in ten lies after; None where it may never be reached"""

    @property
    def left_mm(self) -> float | None:
        """[mm] error of the tool that a run's controller leaves: the true one where it is known."""
        return self.settled_mm if self.settled_true_mm is None else self.settled_true_mm

    @property
    def counts_mm(self) -> float | None:
        """[mm] error of the tool that counts for its owner: with the controller where the arm was repaired."""
        with_it = self.left_mm if self.kind == "repair" else self.controlled_mm
        bare = self.error_mm if self.true_error_mm is None else self.true_error_mm
        return bare if with_it is None else with_it

    @property
    def over(self) -> bool:
        """Whether that error has reached the tolerance."""
        limit, counts = self.tolerance_mm, self.counts_mm
        return limit is not None and counts is not None and counts >= limit


def _column(kind: Any) -> pa.DataType:  # noqa: ANN401
    plain = next(one for one in (typing.get_args(kind) or (kind,)) if one is not types.NoneType)
    return {str: pa.string(), float: pa.float64(), datetime: _TIME}[plain]


_KINDS = typing.get_type_hints(HistoryRow)
SCHEMA = pa.schema([(item.name, _column(_KINDS[item.name])) for item in fields(HistoryRow)])
"""Columns of every file"""


def utc_now() -> datetime:
    """Return the time in UTC, without a zone, as rows have it."""
    return datetime.now(UTC).replace(tzinfo=None)


def write_rows(path: Path, rows: Sequence[HistoryRow]) -> None:
    """Write a file of summary rows, whole or not at all; FileError if that fails."""
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema=SCHEMA)
    table = table.replace_schema_metadata({_FORMAT_KEY: str(FORMAT).encode()})
    write_whole(path, lambda temporary: pq.write_table(table, temporary, write_page_checksum=True))


def read_table(path: Path) -> pa.Table:
    """Read a file of summary rows as a table of `SCHEMA`, checksums included.

    FileError if it is damaged, of a later version, or holds something else.
    """
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
    """Raise ValueError where rows lack what every row has, or have times of no calendar."""
    for name in ("time", "kind", "arm"):
        if table[name].null_count:
            raise ValueError(f"rows without {name}")
    for item in SCHEMA:
        if item.type == _TIME:
            ends = pc.min_max(table[item.name].cast(pa.int64()))
            if any(end is not None and not _EARLIEST <= end <= _LATEST for end in ends.as_py().values()):
                raise ValueError(f"{item.name} is no date")


def read_rows(path: Path) -> list[HistoryRow]:
    """Read a file of summary rows; errors as `read_table`."""
    return rows_from(read_table(path))


def rows_from(table: pa.Table) -> list[HistoryRow]:
    """Return the rows of a table of `SCHEMA`; text that is missing in it is empty."""
    texts = {item.name for item in SCHEMA if item.type == pa.string()}
    found = []
    for row in table.to_pylist():
        values: dict[str, Any] = {name: "" if value is None and name in texts else value for name, value in row.items()}
        found.append(HistoryRow(**values))
    return found
