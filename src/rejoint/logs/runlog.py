"""Run logs: commands and readings of one arm, as Parquet.

Row k holds the state of cycle k and the command sent after it.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike

from rejoint.arms import Arm, ArmLike, Array, Index, load_arm
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import CHANGED, MEGABYTE, begins_with, reading, require_file, write_whole
from rejoint.system.numbers import LONGEST_PERIOD, as_floats, interpolated
from rejoint.system.records import taken
from rejoint.system.stopping import noted
from rejoint.system.textfile import head, shown

FORMAT = 1
"""Version; others are refused"""

LOG_MOST = 1000 * MEGABYTE
"""[bytes] (chosen: 100 hours at 40 Hz)"""

VALUES_MOST = 200_000_000
"""(chosen: 1.6 GB of memory)"""

GAP, REGULAR = 1.5, 0.8
"""Periods after which a row is lost, and share of rows within them; chosen"""

TWO_TURNS = 4.0 * np.pi
"""[rad] (chosen: beyond any joint)"""

_PACKED = (b"PK\x03\x04", b"\x1f\x8b", b"\x28\xb5\x2f\xfd", b"BZh", b"\xfd7zXZ")
"""First bytes of ZIP (also spreadsheets), gzip, zstd, bzip2 and xz; source: the program `file`"""
_METADATA_KEY = b"rejoint"
AXES = ("x", "y", "z")
"""Column names of a place"""
_ARRAYS = ("time", "position", "command", "target", "true_tcp")
_ABOUT = ("arm", "robot", "label", "extra")
_OPTIONAL = ("servo_load", "torque", "current", "gain", "aim")
_POINTS = ("target", "true_tcp", "aim")


@dataclass(frozen=True, kw_only=True, eq=False)
class RunLog:
    """Commands and readings of one arm; T rows, n joints.

    Examples
    --------
    >>> log = rejoint.RunLog.of(time, command, position, arm="so101")
    >>> log.save("logs/one.parquet")
    >>> log = rejoint.RunLog.load("logs/one.parquet")
    """

    arm: str
    """name"""
    joint_names: tuple[str, ...]
    robot: str
    """address"""
    label: str
    """such as ``excitation`` or ``hold/policy/0/2``"""
    time: Array
    """(T,) [s] on the robot's clock, increasing"""
    position: Array
    """(T, n) [rad] measured"""
    command: Array
    """(T, n) [rad] sent; NaN: not recorded"""
    target: Array
    """(T, 3) [m] of the TCP; NaN: none"""
    true_tcp: Array
    """(T, 3) [m] true tool; NaN: unknown"""
    servo_load: Array | None = None
    """(T, n) torque as a share of the largest, positive with the joint"""
    aim: Array | None = None
    """(T, 3) [m] corrected target"""
    torque: Array | None = None
    """(T, n) measured, unit in ``units``"""
    current: Array | None = None
    """(T, n) of motors, positive with the joint, unit in ``units``"""
    gain: Array | None = None
    """(T, n) P gain in the servo's unit, 0 without torque"""
    units: dict[str, str] = field(default_factory=dict)
    """of ``torque`` (``N m``) and ``current`` (``A``)"""
    extra: dict[str, str] = field(default_factory=dict)
    """seed, profile, software version and others"""

    def __repr__(self) -> str:
        return f"RunLog({self.label!r} of {self.robot}, {self.arm}: {len(self.time)} rows, {self.duration:.1f} s)"

    @property
    def duration(self) -> float:
        """[s] from the first to the last row."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0

    @property
    def period(self) -> float:
        """[s] from row to row, in the median."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    def __post_init__(self) -> None:
        rows = np.size(self.time)
        for name in self.arrays:
            shape = (rows,) if name == "time" else (rows, len(self.parts(name)))
            array = as_floats(f"run log {self.label}: {name}", getattr(self, name)).copy()
            if array.shape != shape:
                raise InputError(f"run log {self.label}: {name} has shape {array.shape}, expected {shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for name in ("time", "position", *(("command",) if self.commanded else ())):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"run log {self.label}: {name} holds values that are not finite")
        if (np.diff(self.time) <= 0).any():
            raise InputError(f"run log {self.label}: time must increase, row {np.argmax(np.diff(self.time) <= 0) + 1}")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def commanded(self) -> bool:
        """Whether the log holds commands."""
        return not np.isnan(self.command).all() or not self.command.size

    @cached_property
    def sent(self) -> tuple[Array, Array]:
        """Times (T,) [s] and commands (T, n) [rad]; interpolated where imported regular logs lost rows."""
        steps = np.diff(self.time) / self.period
        if "format" not in self.extra or np.quantile(steps, REGULAR) > GAP:
            return self.time, self.command
        rows = np.append(0, np.cumsum(np.maximum(np.rint(steps), 1)))
        time = np.interp(np.arange(rows[-1] + 1), rows, self.time)
        return time, interpolated(time, self.time, self.command)

    def rows(self, which: slice | Index) -> RunLog:
        """Return some rows."""
        return taken(self, self.arrays, which)

    def visits(self) -> list[Index]:
        """Rows of each target in turn, and of each stretch without one."""
        filled = np.nan_to_num(self.target, nan=np.inf)  # NaN differs from itself
        changed = (filled[1:] != filled[:-1]).any(axis=1)
        return np.split(np.arange(len(self)), np.flatnonzero(changed) + 1)

    @property
    def arrays(self) -> tuple[str, ...]:
        """Names of fields with a row per reading."""
        return (*_ARRAYS, *(name for name in _OPTIONAL if getattr(self, name) is not None))

    def parts(self, group: str) -> tuple[str, ...]:
        """Columns of a group: joints or axes."""
        return AXES if group in _POINTS else self.joint_names

    @classmethod
    def of(
        cls,
        time: ArrayLike,
        command: ArrayLike,
        position: ArrayLike,
        *,
        arm: ArmLike,
        label: str = "motion",
        target: ArrayLike | None = None,
        true_tcp: ArrayLike | None = None,
    ) -> RunLog:
        """Make a run log of arrays in memory.

        Parameters
        ----------
        time
            (T,) [s] of the readings, strictly increasing
        command
            (T, n) [rad] sent after each reading
        position
            (T, n) [rad] measured
        arm
            arm, name or file; its joints are the columns
        label
            name of the motion
        target, true_tcp
            (T, 3) [m]

        Returns
        -------
        RunLog
            with read-only copies of the arrays

        Raises
        ------
        InputError
            for wrong shapes, values or times

        Examples
        --------
        >>> log = rejoint.RunLog.of(time, command, position, arm="so101")
        >>> print(rejoint.diagnose(log).verdict)
        """
        known, unknown = load_arm(arm), np.full((np.size(time), 3), np.nan)
        given = dict[str, Any](time=time, command=command, position=position, target=target, true_tcp=true_tcp)
        given = {name: unknown if one is None else one for name, one in given.items()}
        return cls(arm=known.name, joint_names=known.joint_names, robot="memory", label=label, **given)

    @classmethod
    def load(cls, path: Path | str) -> RunLog:
        """Read a run log; FileError."""
        path, remedy = Path(path), "record it again or take another file"
        with reading(path, "not a readable run log", remedy):
            require_file(path, LOG_MOST, remedy)
            table = read_parquet(path, remedy) if begins_with(path, b"PAR1") else None
            if table is None or _METADATA_KEY not in (table.schema.metadata or {}):
                raise FileError(path, f"no run log, but {describe(path)}", "turn it into one with `rejoint import`")
            header = json.loads(table.schema.metadata[_METADATA_KEY])
            if header["format"] != FORMAT:
                raise FileError(path, f"run log of format {header['format']}, expected {FORMAT}", remedy)
            groups: dict[str, list[Array]] = {}
            for column in table.column_names:
                groups.setdefault(column.partition(".")[0], []).append(table[column].to_numpy())
            (time,) = groups.pop("time")
            arrays: dict[str, Any] = {group: np.stack(parts, axis=-1) for group, parts in groups.items()}
            about = {key: header[key] for key in _ABOUT}
            joints, units = tuple(header["joints"]), header.get("units", {})
            log = cls(joint_names=joints, units=units, time=time, **about, **arrays)
            if header.get("digest", _digest(log)) != _digest(log):
                raise FileError(path, CHANGED, remedy)
            return log

    def save(self, path: Path | str) -> None:
        """Write a run log as Parquet, whole or not at all; FileError."""
        columns = {"time": self.time}
        for group in self.arrays[1:]:
            named = zip(self.parts(group), getattr(self, group).T, strict=True)
            columns |= {f"{group}.{name}": values for name, values in named}
        header = {"format": FORMAT, **_about(self), "digest": _digest(self)}
        table = pa.table(columns).replace_schema_metadata({_METADATA_KEY: json.dumps(header).encode()})
        write_parquet(Path(path), table)

    def require(self, arm: Arm) -> None:
        """Raise InputError unless arm, joints, times and angles fit."""
        if self.arm != arm.name:
            raise InputError(f"run log {self.label} is of arm {self.arm}, expected {arm.name}; name its arm with --arm")
        if self.joint_names != arm.joint_names:
            raise InputError(
                f"run log {self.label} has joints {', '.join(self.joint_names)}, expected {', '.join(arm.joint_names)}"
                "; import it again"
            )
        if not len(self):
            raise InputError(f"run log {self.label} has no rows; leave it out")
        if self.period > LONGEST_PERIOD:
            raise InputError(f"run log {self.label}: its rows are {self.period:.4g} s apart; give times in seconds")
        for what, values in (("position", self.position), ("command", self.command)):
            farthest = np.abs(values).max(initial=0.0, where=np.isfinite(values) & ~arm.endless)
            if farthest > TWO_TURNS:
                raise InputError(
                    f"run log {self.label}: a {what} of {farthest:.4g} rad, beyond two turns; give radians"
                )


MOST_ALIKE = 16
"""Logs of a group of `similar_in_length`; chosen"""


def similar_in_length(logs: Sequence[RunLog]) -> list[Index]:
    """Group logs by their indices: of a group, none lasts twice as long as another."""
    lengths = np.array([log.duration for log in logs])
    order = np.argsort(lengths)
    doubled = np.diff(np.frexp(lengths[order])[1], prepend=0) != 0
    begins = doubled | (np.arange(len(order)) % MOST_ALIKE == 0)
    return np.split(order, np.flatnonzero(begins))[1:]


def write_parquet(path: Path, table: pa.Table) -> None:
    """Write a Parquet file with checksums, whole or not at all; FileError."""

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:  # Arrow takes no path that is no UTF-8
            pq.write_table(table, file, compression="zstd", write_page_checksum=True)

    write_whole(path, write)


def read_parquet(path: Path, remedy: str, columns: list[str] | None = None) -> pa.Table:
    """Read a Parquet file with checksums; FileError."""
    require_file(path, LOG_MOST, remedy)
    _load_pandas()
    with path.open("rb") as raw, pq.ParquetFile(raw, page_checksum_verification=True) as file:
        values = file.metadata.num_rows * file.metadata.num_columns
        if values > VALUES_MOST:
            raise FileError(path, f"{values} numbers, expected at most {VALUES_MOST}", remedy)
        return file.read(columns)


def _load_pandas() -> None:
    """Load pandas before Arrow does: its import loses signals."""
    if "pandas" not in sys.modules:
        with noted(), suppress(Exception):  # Arrow does without it
            import_module("pandas")


def _about(log: RunLog) -> dict[str, Any]:
    about = {key: getattr(log, key) for key in _ABOUT} | {"joints": log.joint_names}
    return about | ({"units": log.units} if log.units else {})


def _digest(log: RunLog) -> str:
    found = hashlib.sha256(json.dumps(_about(log), sort_keys=True).encode())
    for name in log.arrays:  # without loads it is as before
        found.update(np.ascontiguousarray(getattr(log, name), dtype="<f8").tobytes())
    return found.hexdigest()[:16]


def describe(path: Path) -> str:
    """Kind of a file or folder, in words."""
    if path.is_dir():
        return f"a folder with {shown(sorted(entry.name + '/' * entry.is_dir() for entry in path.iterdir()))}"
    if not path.is_file():
        return "neither a file nor a folder"
    with path.open("rb") as file:
        start = file.read(4096)
    if start.startswith(_PACKED):
        return "a packed file or a spreadsheet: unpack it, or save it as CSV"
    sheet = head(path)
    if sheet is not None:
        return f"text in {sheet.found}: {shown(sheet.titles)}"
    return "a Parquet table" if start.startswith(b"PAR1") else "no table"
