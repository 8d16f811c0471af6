"""The run folder: where every stage leaves its files, and a lock for one process.

The next process that takes the lock repairs what a killed one left.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import msgspec

from rejoint.logs.journal import recover
from rejoint.system.errors import FileError
from rejoint.system.files import JSON_MOST, UNFINISHED, UNWRITABLE, read_bounded, read_json, unwritable


class Located(Protocol):
    """Something in a folder of its own."""

    @property
    def path(self) -> Path:
        """The folder."""


class FilePlace:
    """A path below the folder of what has it as an attribute."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, owner: Located, _: type) -> Path:
        return owner.path / self.name


@dataclass(frozen=True)
class Outputs:
    """Files of a training in its folder."""

    path: Path

    policy = FilePlace("policy.onnx")
    """the trained policy with its contract"""
    folder = FilePlace("training")
    """what a training needs on its way, and its curves"""
    curves = FilePlace("training/curves.parquet")
    """Parquet, one row per update, the fields of `CurvePoint`"""
    checkpoint = FilePlace("training/checkpoint.pt")
    """what an interrupted training goes on from"""

    def snapshot(self, updates: int) -> Path:
        """Path of the policy kept after so many updates."""
        return self.folder / f"policy-{updates:04}.onnx"


@dataclass(frozen=True, kw_only=True)
class Kept:
    """The earlier repair that twin and policy come from."""

    run: str
    """folder"""
    since: str
    """local date and time when that repair began, ISO 8601"""
    error: float
    """[m] rms tool error of the twin in the new excitation"""
    fitted: float
    """[m] the same when it was fitted"""

    def __str__(self) -> str:
        """Say it in a sentence."""
        return (
            f"the arm still moves as its twin of {self.since[:10]} says, within {1e3 * self.error:.1f} mm "
            f"({1e3 * self.fitted:.1f} then); twin and policy are kept from {self.run}"
        )


try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

FORMAT = 2
"""Version of the layout of a run folder; a reader refuses others"""

LOGS = "logs:"
"""Robot of a run made from logs; their folder follows"""

_LOGGER = logging.getLogger("rejoint")


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """What a run folder is about."""

    robot: str
    """address of the robot"""
    arm: str
    """name of the arm"""
    seed: int
    version: str
    """version of the software that made the folder"""
    created: str
    """local date and time, ISO 8601"""
    arm_file: str = ""
    """`file_digest` of the arm's own description; empty without one"""
    format: int = FORMAT
    """version of the folder's layout"""


@dataclass(frozen=True)
class RunFolder:
    """Where each stage of a run leaves its files."""

    path: Path

    info = FilePlace("run.json")
    """robot, arm and seed (`RunInfo`)"""
    description = FilePlace("arm.toml")
    """the arm's own description, where it is not one of the catalogue"""
    settings = FilePlace("settings.json")
    """payload, tool and the like of the diagnosis (`KeptSettings`)"""
    diagnosis = FilePlace("diagnosis.json")
    """what is wrong with the arm"""
    twin = FilePlace("twin.toml")
    """the identified twin"""
    measurements = FilePlace("measurements.parquet")
    """where the tool was seen from outside"""
    calibration = FilePlace("calibration.toml")
    """what lies behind the encoders, and whether to correct by it"""
    views = FilePlace("views.parquet")
    """what a camera saw of the board, picture by picture"""
    pictures = FilePlace("pictures")
    """folder of the pictures themselves"""
    camera = FilePlace("camera.toml")
    """how camera, board and arm stand to each other"""
    judgement = FilePlace("judgement.json")
    """twins judged on held-out motion"""
    kept = FilePlace("kept.json")
    """from which earlier repair twin and policy are, where they are"""
    policy = FilePlace("policy.onnx")
    """the trained policy with its contract"""
    gains = FilePlace("gains.json")
    """what a search for better gains of the servos found"""
    comparison = FilePlace("comparison.json")
    """every controller on the same arm"""
    effort = FilePlace("effort.json")
    """what the stages cost: the arm's time, its joints' travel"""
    trials = FilePlace("comparison.trials")
    """trials of a comparison that is not done yet"""
    quick = FilePlace("quick.json")
    """left by ``--quick``: nothing in the folder is a result"""
    finished = FilePlace("finished.json")
    """what `rejoint repair` leaves when all of it is done"""
    report = FilePlace("report.html")
    """the page for the owner"""
    figures = FilePlace("figures")
    """folder of the report's figures as PNG files"""

    def arm(self, name: str) -> str:
        """Return the arm's own description, or ``name`` in the catalogue."""
        return str(self.description) if self.description.exists() else name

    @property
    def outputs(self) -> Outputs:
        """What the training leaves: the policy, curves and checkpoints."""
        return Outputs(self.path)

    def log(self, name: str) -> Path:
        """Path of the run log called ``name``; slashes become dashes."""
        return self.path / "logs" / f"{name.replace('/', '-')}.parquet"

    def logs(self) -> dict[str, Path]:
        """Paths of all run logs by name, sorted."""
        return {path.stem: path for path in sorted((self.path / "logs").glob("*.parquet"))}

    def trial_logs(self) -> tuple[Path, ...]:
        """Paths of the run logs of the comparison."""
        return tuple(path for name, path in self.logs().items() if _TRIAL.fullmatch(name))


_TRIAL = re.compile(r"(crossing|hold)-\D+-\d{1,4}-\d{1,4}")


class _Head(msgspec.Struct):
    """What run.json says in every version."""

    version: str = "of some other version"
    format: int = FORMAT


def read_info(path: Path) -> RunInfo:
    """Read run.json; FileError if missing, damaged or of another version."""
    try:
        head = msgspec.json.decode(read_bounded(path, JSON_MOST, "choose another folder"), type=_Head)
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        head = _Head()  # as `read_json` will say
    if head.format != FORMAT:
        problem = f"a run folder of format {head.format}, made by rejoint {head.version}; expected format {FORMAT}"
        raise FileError(path, problem, "use that version of rejoint, or choose another folder")
    return read_json(path, RunInfo)


@contextmanager
def locked(folder: RunFolder) -> Iterator[None]:
    """Lock a run folder for this process, and repair what a killed one left.

    FileError where another process works there, or nothing can be written. Systems without locks neither lock nor
    repair.
    """
    path = folder.path / ".lock"
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        file = path.open("a+")
    except OSError as error:
        raise FileError(folder.path, f"nothing can be written there ({error.strerror})", UNWRITABLE) from error
    with file:
        has_locks = _lock(file.fileno(), folder)
        try:
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
            if has_locks:
                _put_right(folder)
        except OSError as error:
            raise unwritable(path, error) from error
        mine = os.getpid()
        try:
            yield
        finally:
            if has_locks and os.getpid() == mine:  # a process that was forked meanwhile has the file open as well
                fcntl.flock(file, fcntl.LOCK_UN)


def _lock(handle: int, folder: RunFolder) -> bool:
    """Take the lock; returns whether the system has locks. FileError if another process has it."""
    if fcntl is not None:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError as error:
            holder = (folder.path / ".lock").read_text(encoding="utf-8", errors="replace").strip() or "unknown"
            if holder == str(os.getpid()):
                own = "this program is working there already"
                raise FileError(folder.path, own, "close what it has open there, or choose another folder") from error
            other = f"another rejoint (process {holder}) is working there"
            raise FileError(folder.path, other, "wait until it is done, or choose another folder") from error
        except OSError:
            pass  # a file system without locks
    return False


def _put_right(folder: RunFolder) -> None:
    """Remove unfinished files; journals become run logs."""
    logs = folder.path / "logs"
    for place in (folder.path, logs, folder.outputs.folder, folder.figures, folder.pictures):
        for unfinished in place.glob(f".*{UNFINISHED}"):
            unfinished.unlink()
    for log in recover(logs):
        _LOGGER.warning("A run that was cut short is kept: %s", log)
