"""The run folder and its files: run logs as Parquet, results as JSON, written whole or not at all.

A run log is a table with one row per control cycle. Row k holds the state that was read in cycle k
and the command that was sent right after it, in force until the next one. Columns are flat
(``position.joint1``), so that any tool that reads Parquet can plot them.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rejoint.errors import FileError, InputError, first_line

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

Array = NDArray[np.float64]
T = TypeVar("T")

FORMAT = 1
"""Version of the run-log layout; a reader refuses others."""

LOGS = "logs:"
"""Beginning of what stands for the robot of a run that was made from logs alone; their folder follows"""

_METADATA_KEY = b"rejoint"
_UNWRITABLE = "free some space, allow writing there, or choose another folder"
_AXES = ("x", "y", "z")


@dataclass(frozen=True, kw_only=True, eq=False)
class RunLog:
    """What one arm was told and what it did; T rows, n joints."""

    arm: str
    """name of the arm"""
    joint_names: tuple[str, ...]
    robot: str
    """address of the robot"""
    label: str
    """what was run, such as ``excitation`` or ``hold/policy/0/2``"""
    time: Array
    """(T,) [s] on the robot's clock, strictly increasing"""
    position: Array
    """(T, n) [rad] measured joint positions"""
    command: Array
    """(T, n) [rad] sent joint positions"""
    target: Array
    """(T, 3) [m] TCP target; NaN where there is none"""
    true_tcp: Array
    """(T, 3) [m] where the tool really was; NaN where nobody knows"""
    extra: dict[str, str] = field(default_factory=dict)
    """anything else worth keeping: seed, profile, software version"""

    def __post_init__(self) -> None:
        rows, n = self.time.shape[0], len(self.joint_names)
        shapes = {
            "time": (rows,),
            "position": (rows, n),
            "command": (rows, n),
            "target": (rows, 3),
            "true_tcp": (rows, 3),
        }
        for name, shape in shapes.items():
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != shape:
                raise InputError(f"run log {self.label}: {name} has shape {array.shape}, expected {shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for name in ("time", "position", "command"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"run log {self.label}: {name} holds values that are not finite")
        if (np.diff(self.time) <= 0).any():
            raise InputError(
                f"run log {self.label}: time must increase, row {int(np.argmax(np.diff(self.time) <= 0)) + 1}"
            )

    def __len__(self) -> int:
        return len(self.time)

    def require(self, arm: str, joint_names: tuple[str, ...]) -> None:
        """Raise InputError unless the log is of that arm, its joints in that order."""
        if self.arm != arm:
            raise InputError(f"run log {self.label} is of arm {self.arm}, expected {arm}; name its arm with --arm")
        if self.joint_names != joint_names:
            found, expected = ", ".join(self.joint_names), ", ".join(joint_names)
            raise InputError(f"run log {self.label} has joints {found}, expected {expected}; import it again")


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """What a run folder is about; written once, when the folder is made."""

    robot: str
    """address of the robot"""
    arm: str
    """name of the arm"""
    seed: int
    version: str
    """version of the software that made the folder"""
    created: str
    """local date and time, ISO 8601"""


@dataclass(frozen=True)
class RunFolder:
    """Where each stage of a run leaves its files."""

    path: Path

    @property
    def info(self) -> Path:
        """Robot, arm and seed (`RunInfo`)."""
        return self.path / "run.json"

    def arm(self, name: str) -> str:
        """Return what the arm of this run is built from: its own description, or ``name`` in the catalogue."""
        own = self.path / "arm.toml"
        return str(own) if own.exists() else name

    @property
    def diagnosis(self) -> Path:
        """What is wrong with the arm."""
        return self.path / "diagnosis.json"

    @property
    def twin(self) -> Path:
        """The identified twin."""
        return self.path / "twin.toml"

    @property
    def judgement(self) -> Path:
        """The twin and others judged on motion that the fit has not seen."""
        return self.path / "judgement.json"

    @property
    def training(self) -> Path:
        """Folder of training curves and checkpoints."""
        return self.path / "training"

    @property
    def policy(self) -> Path:
        """The trained policy with its contract."""
        return self.path / "policy.onnx"

    @property
    def comparison(self) -> Path:
        """Every controller on the same arm."""
        return self.path / "comparison.json"

    @property
    def report(self) -> Path:
        """The page for the owner."""
        return self.path / "report.html"

    @property
    def figures(self) -> Path:
        """Folder of the report's figures as PNG files."""
        return self.path / "figures"

    def log(self, name: str) -> Path:
        """Path of the run log called ``name``; slashes become dashes."""
        return self.path / "logs" / f"{name.replace('/', '-')}.parquet"

    def logs(self) -> dict[str, Path]:
        """Paths of all run logs by name, sorted."""
        return {path.stem: path for path in sorted((self.path / "logs").glob("*.parquet"))}


def write_log(path: Path, log: RunLog) -> None:
    """Write a run log as Parquet."""
    columns: dict[str, Array] = {"time": log.time}
    for group in ("position", "command"):
        columns |= {f"{group}.{name}": getattr(log, group)[:, i] for i, name in enumerate(log.joint_names)}
    for group in ("target", "true_tcp"):
        columns |= {f"{group}.{axis}": getattr(log, group)[:, i] for i, axis in enumerate(_AXES)}
    header = {
        "format": FORMAT, "arm": log.arm, "joints": list(log.joint_names), "robot": log.robot, "label": log.label,
        "extra": log.extra,
    }  # fmt: skip
    table = pa.table(columns).replace_schema_metadata({_METADATA_KEY: json.dumps(header).encode()})
    write_whole(path, lambda temporary: pq.write_table(table, temporary, compression="zstd", write_page_checksum=True))


def read_log(path: Path) -> RunLog:
    """Read a run log; FileError names a file that is missing, damaged or something else."""
    remedy = "record it again or take another file"
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        if _METADATA_KEY not in (table.schema.metadata or {}):
            raise FileError(path, "no run log, but some other table", "turn it into one with `rejoint import`")
        header = json.loads(table.schema.metadata[_METADATA_KEY])
        if header["format"] != FORMAT:
            raise FileError(path, f"run log of format {header['format']}, expected {FORMAT}", remedy)
        names = tuple(header["joints"])

        def group(prefix: str, parts: Sequence[str]) -> Array:
            return np.stack([table[f"{prefix}.{part}"].to_numpy() for part in parts], axis=-1)

        return RunLog(
            arm=header["arm"], joint_names=names, robot=header["robot"], label=header["label"],
            time=table["time"].to_numpy(), position=group("position", names), command=group("command", names),
            target=group("target", _AXES), true_tcp=group("true_tcp", _AXES), extra=header["extra"],
        )  # fmt: skip
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "check the path") from error
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, InputError) as error:
        raise FileError(path, f"not a readable run log ({first_line(error)})", remedy) from error


def write_json(path: Path, value: object) -> None:
    """Write a dataclass (or plain data) as readable JSON."""
    data = msgspec.json.format(msgspec.json.encode(value), indent=2)
    write_whole(path, lambda temporary: temporary.write_bytes(data))


def read_json(path: Path, kind: type[T]) -> T:
    """Read JSON written by `write_json` as an instance of ``kind``; FileError if it is not one."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "run the stage that writes it first") from error
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise FileError(path, f"damaged ({first_line(error)})", "delete it and run its stage again") from error


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path`` and move it there: all or nothing; FileError if it fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        os.close(handle)
        temporary = Path(name)
        try:
            write(temporary)
            temporary.chmod(0o644)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise FileError(path, f"cannot be written ({error.strerror or error})", _UNWRITABLE) from error


def set_aside(path: Path) -> None:
    """Rename a file, if there is one, that another takes the place of, by its time: it may have cost hours."""
    if path.exists():
        made = datetime.fromtimestamp(path.stat().st_mtime)
        path.replace(path.with_stem(f"{path.stem}-{made:%Y%m%d-%H%M%S}"))


@contextmanager
def locked(folder: RunFolder) -> Iterator[None]:
    """Keep other processes from working in a run folder meanwhile.

    FileError where one is, or where nothing can be written: better known before an arm has moved. The lock goes with
    the process that holds it, however that ends. Where the system has no such locks, nothing is kept out.
    """
    path = folder.path / ".lock"
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        file = path.open("a+")
    except OSError as error:
        raise FileError(folder.path, f"nothing can be written there ({error.strerror})", _UNWRITABLE) from error
    with file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                file.seek(0)
                other = f"another rejoint (process {file.read().strip() or 'unknown'}) is working there"
                raise FileError(folder.path, other, "wait until it is done, or choose another folder") from error
            except OSError:
                pass  # a file system without locks
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield
