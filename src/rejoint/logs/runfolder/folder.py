"""The run folder: where every stage leaves its files, what the folder is about, and that one process works in it.

What a killed process left half done there is put right by the next one that takes the lock.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec

from rejoint.logs.journal import recover
from rejoint.logs.runfolder.outputs import Outputs
from rejoint.system.errors import FileError
from rejoint.system.files import JSON_MOST, UNFINISHED, UNWRITABLE, read_bounded, read_json, unwritable

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

FORMAT = 2
"""Version of the layout of a run folder; a reader refuses later ones. The first had no number and no finished.json"""

LOGS = "logs:"
"""Beginning of what stands for the robot of a run that was made from logs alone; their folder follows"""

_LOGGER = logging.getLogger("rejoint")


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
    arm_file: str = ""
    """digest of the arm's own description beside it, `file_digest`; empty where there is none"""
    format: int = 1
    """version of the folder's layout"""


@dataclass(frozen=True)
class RunFolder:
    """Where each stage of a run leaves its files."""

    path: Path

    @property
    def info(self) -> Path:
        """Robot, arm and seed (`RunInfo`)."""
        return self.path / "run.json"

    @property
    def description(self) -> Path:
        """The arm's own description, where it is not one of the catalogue."""
        return self.path / "arm.toml"

    def arm(self, name: str) -> str:
        """Return what the arm of this run is built from: its own description, or ``name`` in the catalogue."""
        return str(self.description) if self.description.exists() else name

    @property
    def diagnosis(self) -> Path:
        """What is wrong with the arm."""
        return self.path / "diagnosis.json"

    @property
    def twin(self) -> Path:
        """The identified twin."""
        return self.path / "twin.toml"

    @property
    def measurements(self) -> Path:
        """Where the tool was seen from outside."""
        return self.path / "measurements.parquet"

    @property
    def calibration(self) -> Path:
        """What lies behind the encoders, and whether to correct by it."""
        return self.path / "calibration.toml"

    @property
    def views(self) -> Path:
        """What a camera saw of the board, picture by picture."""
        return self.path / "views.parquet"

    @property
    def pictures(self) -> Path:
        """Folder of the pictures themselves."""
        return self.path / "pictures"

    @property
    def camera(self) -> Path:
        """How camera, board and arm stand to each other."""
        return self.path / "camera.toml"

    @property
    def judgement(self) -> Path:
        """The twin and others judged on motion that the fit has not seen."""
        return self.path / "judgement.json"

    @property
    def kept(self) -> Path:
        """From which earlier repair twin and policy are, where they are."""
        return self.path / "kept.json"

    @property
    def outputs(self) -> Outputs:
        """What the training leaves: the policy, curves and checkpoints."""
        return Outputs(self.path)

    @property
    def policy(self) -> Path:
        """The trained policy with its contract."""
        return self.outputs.policy

    @property
    def gains(self) -> Path:
        """What a search for better gains of the servos found."""
        return self.path / "gains.json"

    @property
    def comparison(self) -> Path:
        """Every controller on the same arm."""
        return self.path / "comparison.json"

    @property
    def effort(self) -> Path:
        """What the stages cost: the arm's time, its joints' travel."""
        return self.path / "effort.json"

    @property
    def trials(self) -> Path:
        """Trials of a comparison that is not done yet."""
        return self.path / "comparison.trials"

    @property
    def quick(self) -> Path:
        """What a stage that did little of everything leaves: nothing in the folder is a result."""
        return self.path / "quick.json"

    @property
    def finished(self) -> Path:
        """What `rejoint repair` leaves when all of it is done."""
        return self.path / "finished.json"

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

    def trial_logs(self) -> tuple[Path, ...]:
        """Paths of the run logs of the comparison; those of earlier ones, which were set aside, are not among them."""
        return tuple(path for name, path in self.logs().items() if _TRIAL.fullmatch(name))


_TRIAL = re.compile(r"(crossing|hold)-\D+-\d{1,4}-\d{1,4}")


class _Head(msgspec.Struct):
    """What run.json has said in every version."""

    version: str = "of some other version"
    format: int = 1


def read_info(path: Path) -> RunInfo:
    """Read run.json; FileError if it is missing or damaged, or if a later version made the folder."""
    try:
        head = msgspec.json.decode(read_bounded(path, JSON_MOST, "choose another folder"), type=_Head)
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        head = _Head()  # as `read_json` will say
    if head.format > FORMAT:
        problem = (
            f"a run folder of format {head.format}, made by rejoint {head.version}; formats up to {FORMAT} are known"
        )
        raise FileError(path, problem, "update rejoint, or choose another folder")
    return read_json(path, RunInfo)


@contextmanager
def locked(folder: RunFolder) -> Iterator[None]:
    """Keep other processes from working in a run folder meanwhile, and put right what a killed one left there.

    FileError where one is, or where nothing can be written: better known before an arm has moved. The lock goes with
    the process that holds it, however that ends. Where the system has no such locks, nothing is kept out, and nothing
    is put right: it might be another process's work.
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
    """Take the lock; returns whether there are locks. FileError if another process has it."""
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
    """Remove what was being written when a process was killed; what an arm did until then becomes a run log."""
    logs = folder.path / "logs"
    for place in (folder.path, logs, folder.outputs.folder, folder.figures, folder.pictures):
        for unfinished in place.glob(f".*{UNFINISHED}"):
            unfinished.unlink()
    for log in recover(logs):
        _LOGGER.warning("A run that was cut short is kept: %s", log)
