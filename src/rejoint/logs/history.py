"""Summary rows of runs and checks: one for the arm, one for each joint."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import asdict, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import get_args, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa

from rejoint.arms import Arm
from rejoint.logs.runfolder import files_below
from rejoint.logs.runlog import read_parquet, write_parquet
from rejoint.system.errors import FileError
from rejoint.system.files import reading
from rejoint.system.records import value_type
from rejoint.system.shell import __version__

_PASSING = re.compile(r"[?&](hours|ambient)=[^&]*")
_HOURS = re.compile(r"[?&]hours=([^&]*)")
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
    """Fingerprint of a description, but for rounding."""
    text = hashlib.sha256()
    for item in fields(arm):
        value = getattr(arm, item.name)
        part = value.ends if item.name == "targets" else value
        text.update((np.round(part, 9) + 0.0).tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return text.hexdigest()[:16]


SUMMARY = "summary.parquet"
"""File name of summary rows"""
FORMAT = 1
"""Version; later ones are skipped"""

_FORMAT_KEY = b"rejoint.history"


@value_type
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
    controlled_mm: float | None = None
    """after a repair, see `Outlook.controlled_mm`"""
    tolerance_mm: float | None = None
    """the user's"""
    controller: str = ""
    """recommended"""
    settled_mm: float | None = None
    """encoder error at rest with it"""
    settled_true_mm: float | None = None
    state: str = ""
    """of a check: learning, steady, drifting or alarm; else of a run"""
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
        """[mm] tool error that counts: of a check by the encoders, as its tolerance, else the true one if known."""
        with_it = self.left_mm if self.kind == "repair" else self.controlled_mm
        bare = self.error_mm if self.kind == "check" or self.true_error_mm is None else self.true_error_mm
        return bare if with_it is None else with_it

    @property
    def over(self) -> bool:
        """Whether it reached the tolerance."""
        return (self.counts_mm or 0.0) >= (self.tolerance_mm or float("inf"))


_ARROW = {str: pa.string(), float: pa.float64(), datetime: pa.timestamp("us")}
SCHEMA = pa.schema(
    [(name, _ARROW[(*get_args(kind), kind)[0]]) for name, kind in get_type_hints(HistoryRow).items()],
    metadata={_FORMAT_KEY: str(FORMAT).encode()},
)
"""Columns"""


def utc_now() -> datetime:
    """UTC without a zone."""
    return datetime.now(UTC).replace(tzinfo=None)


def write_rows(path: Path, rows: Sequence[HistoryRow]) -> None:
    """Write summary rows, whole or not at all; FileError."""
    write_parquet(path, pa.Table.from_pylist([asdict(row) for row in rows], schema=SCHEMA))


def read_rows(path: Path) -> list[HistoryRow]:
    """Read summary rows; FileError if damaged or of another version."""
    remedy = "delete it; the other files are not concerned"
    with reading(path, "damaged", remedy):
        table = read_parquet(path, remedy)
        version = (table.schema.metadata or {}).get(_FORMAT_KEY, b"none").decode()
        if version != str(FORMAT):
            raise FileError(path, f"summary rows of format {version}, expected {FORMAT}", "update rejoint, or move it")
        return msgspec.convert(table.to_pylist(), list[HistoryRow])


CHECKS = "checks"
"""Folder of the checks, by arm"""


def find_rows(folder: Path) -> tuple[list[HistoryRow], tuple[str, ...]]:
    """Summary rows below a folder, oldest first, and unreadable files."""
    rows, problems = [], []
    for path in files_below(folder, SUMMARY):
        try:
            rows += read_rows(path)
        except FileError as error:  # whose path may have bytes that are no text
            problems.append(str(error).encode(errors="backslashreplace").decode())
    return sorted(rows, key=lambda row: (row.arm, row.time, row.kind)), tuple(problems)  # joints stay in their order
