"""The run folder: files of every stage, their costs, and a lock for one process."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array, Box
from rejoint.arms.inertia import Payload, loaded
from rejoint.logs.journal import recover
from rejoint.system.errors import LOGGER, FileError
from rejoint.system.files import UNFINISHED, read_json, read_json_if, write_json, writing
from rejoint.system.records import value_type


class FilePlace:
    """A path below a run's folder."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, owner: RunFolder, _: type) -> Path:
        return owner.path / self.name


FORMAT = 2
"""Version; others are refused"""

RUNS = Path("runs")
"""Default parent of run folders"""
LOGS = "logs:"
"""Robot of a run made from logs, before their folder"""


@value_type
class RunInfo:
    """Contents of run.json."""

    robot: str
    """address of the robot"""
    arm: str
    seed: int
    version: str
    """of the software"""
    created: str
    """local date and time, ISO 8601"""
    arm_file: str = ""
    """`file_digest` of the arm's description, or empty"""
    name: str = ""
    """of the arm, or empty"""
    fleet: str = ""
    """its file, or empty"""
    format: int = FORMAT

    @property
    def from_logs(self) -> str:
        """Place of the logs that it was made from; empty: of a robot, which can be driven."""
        return self.robot.removeprefix(LOGS) if self.robot.startswith(LOGS) else ""


@value_type
class KeptSettings:
    """What a run keeps of its diagnosis (`settings.json`); fields as in `rejoint.Settings`."""

    payload: Payload | None = None
    tool: Array | None = None
    keep_out: tuple[Box, ...] = ()
    period: tuple[float, float] | None = None
    within: float | None = None

    def laden(self, arm: Arm) -> Arm:
        """Return an ``arm`` with payload and tool; InputError where it cannot bear them."""
        return loaded(arm, self.payload, self.tool)

    def given(self) -> dict[str, Any]:
        """Return the fields that were given."""
        return {name: value for name, value in vars(self).items() if value is not None and np.size(value)}

    def options(self, *only: str) -> list[str]:
        """Return what was given as options of a command, as they are typed; ``only``: of these fields."""
        found = []
        for name, value in self.given().items():
            if name in (only or _TYPED):
                for text in _TYPED[name](value):
                    found += [f"--{name.replace('_', '-')}", text]
        return found


def _thousandths(values: Iterable[float], between: str = ",") -> str:
    return between.join(f"{1e3 * value:.12g}" for value in values)


_TYPED: dict[str, Callable[[Any], list[str]]] = {
    "payload": lambda load: [f"{load.mass:.12g}{f'@{_thousandths(load.com)}' if any(load.com) else ''}"],
    "tool": lambda tip: [_thousandths(tip)],
    "keep_out": lambda boxes: [_thousandths(box.ends) for box in boxes],
    "period": lambda ends: [_thousandths(dict.fromkeys(ends), "-")],
    "within": lambda error: [_thousandths([error])],
}
"""Kept settings at the command line, in kg, mm and ms"""


@dataclass(frozen=True)
class RunFolder:
    """Files of each stage of a run."""

    path: Path

    info = FilePlace("run.json")
    """`RunInfo`"""
    description = FilePlace("arm.toml")
    """the arm's own description, if it is not the catalogue's"""
    settings = FilePlace("settings.json")
    """`KeptSettings` of the diagnosis: payload, tool and the like"""
    diagnosis = FilePlace("diagnosis.json")
    twin = FilePlace("twin.toml")
    measurements = FilePlace("measurements.json")
    """external measurements of the tool"""
    calibration = FilePlace("calibration.toml")
    """displacements behind the encoders"""
    pictures = FilePlace("pictures")
    """of a board, and their joint positions"""
    camera = FilePlace("camera.toml")
    """poses of camera, board and arm"""
    judgement = FilePlace("judgement.json")
    """twins judged on held-out motion"""
    policy = FilePlace("policy.onnx")
    training = FilePlace("training")
    """work files of a training"""
    curves = FilePlace("training/curves.parquet")
    """one row per update, fields of `CurvePoint`"""
    gains = FilePlace("gains.json")
    """result of a gain search"""
    comparison = FilePlace("comparison.json")
    """controllers on the same arm"""
    effort = FilePlace("effort.json")
    """cost of the stages"""
    trials = FilePlace("comparison.trials")
    """trials of an unfinished comparison"""
    quick = FilePlace("quick.json")
    """mark of ``--quick``: no results"""
    finished = FilePlace("finished.json")
    """mark of a finished `rejoint repair`"""
    report = FilePlace("report.html")
    figures = FilePlace("figures")
    """the report's figures as PNG files"""

    def arm(self, name: str) -> str:
        """Return the arm's own description, or ``name`` in the catalogue."""
        return str(self.description) if self.description.exists() else name

    def snapshot(self, updates: int) -> Path:
        """Policy after so many updates of a training."""
        return self.training / f"policy-{updates:04}.onnx"

    def log(self, name: str) -> Path:
        """Path of a run log; slashes become dashes."""
        return self.path / "logs" / f"{name.replace('/', '-')}.parquet"

    def logs(self) -> dict[str, Path]:
        """Run logs by name, sorted."""
        return {path.stem: path for path in sorted((self.path / "logs").glob("*.parquet"))}


def files_below(folder: Path, name: str) -> list[Path]:
    """Files of that name in a folder and below it, sorted; links are followed, each folder counts once."""
    found, seen = [], set()
    for where, below, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(where)
        if real in seen:
            below.clear()
        elif name in names:
            found.append(Path(where, name))
        seen.add(real)
    return sorted(path for path in found if path.exists())


def runs_below(folder: Path) -> dict[RunFolder, RunInfo]:
    """Return runs in a folder and below it, at any depth, the newest first; warns of those that cannot be read."""
    found = {}
    for path in files_below(folder, "run.json"):
        try:
            found[RunFolder(path.parent)] = read_info(path)
        except FileError as error:
            LOGGER.warning("left out: %s", error)
    return dict(sorted(found.items(), key=lambda run: (run[1].created, run[0].info.stat().st_mtime), reverse=True))


def read_info(path: Path) -> RunInfo:
    """Read run.json; FileError."""
    found = read_json(path, dict[str, Any])
    if (version := found.get("format", FORMAT)) != FORMAT:
        raise FileError(
            path,
            f"a run folder of format {version}, made by rejoint {found.get('version', 'of some other version')}; "
            f"expected format {FORMAT}",
            "use that version of rejoint, or choose another folder",
        )
    return read_json(path, RunInfo)


@contextmanager
def locked(folder: RunFolder) -> Iterator[None]:
    """Lock a run folder, and repair what a killed process left; FileError if locked or not writable."""
    path = folder.path / ".lock"
    with writing(folder.path, "nothing can be written there"):
        folder.path.mkdir(parents=True, exist_ok=True)
        file = path.open("a+")
    with file:
        has_locks = _lock(file.fileno(), folder)
        with writing(path):
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
            if has_locks:
                _put_right(folder)
        mine = os.getpid()
        try:
            yield
        finally:
            if has_locks and os.getpid() == mine:  # a process that was forked meanwhile has the file open as well
                fcntl.flock(file, fcntl.LOCK_UN)


def _lock(handle: int, folder: RunFolder) -> bool:
    """Take the lock; returns whether there are locks. FileError: another process has it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    except BlockingIOError as error:
        holder = (folder.path / ".lock").read_text(encoding="utf-8", errors="replace").strip() or "unknown"
        who, remedy = f"another rejoint (process {holder}) is working there", "wait until it is done"
        if holder == str(os.getpid()):
            who, remedy = "this program is working there already", "close what it has open there"
        raise FileError(folder.path, who, f"{remedy}, or choose another folder") from error
    except OSError:  # a file system without locks
        return False


def _put_right(folder: RunFolder) -> None:
    logs = folder.path / "logs"
    for place in (folder.path, logs, folder.training, folder.figures, folder.pictures):
        for unfinished in place.glob(f".*{UNFINISHED}"):
            unfinished.unlink()
    for log in recover(logs):
        LOGGER.warning("A run that was cut short is kept: %s", log)


@value_type
class StageCost:
    """Cost of a stage, all attempts together."""

    name: str
    wall: float = 0.0
    """[s] wall clock"""
    moving: float = 0.0
    """[s] of the arm"""
    travel: float = 0.0
    """[rad] of all joints"""

    def __add__(self, other: StageCost) -> StageCost:
        return StageCost(
            name=self.name,
            wall=self.wall + other.wall,
            moving=self.moving + other.moving,
            travel=self.travel + other.travel,
        )


@value_type
class Effort:
    """Cost of all stages, in order."""

    stages: tuple[StageCost, ...] = ()

    @property
    def total(self) -> StageCost:
        """All together."""
        return sum(self.stages, StageCost(name="all"))


def cost(one: StageCost) -> str:
    """In words."""
    time = f"{one.wall / 60:.1f} min"
    if not one.moving:
        return time
    turns = f"{one.travel / (2 * np.pi):.1f} turns of its joints"
    return f"{time}; {one.moving / 60:.1f} min of the arm's time with {turns}"


def add(folder: RunFolder, cost: StageCost) -> None:
    """Add a stage's cost to the run's file, if there is a readable one."""
    with suppress(FileError):
        if folder.info.exists():
            stages = {stage.name: stage for stage in (read_effort(folder) or Effort()).stages}
            stages[cost.name] = stages.get(cost.name, StageCost(name=cost.name)) + cost
            write_json(folder.effort, Effort(stages=tuple(stages.values())))


def read_settings(folder: RunFolder) -> KeptSettings:
    """Return what a run keeps; FileError where that is damaged."""
    return read_json_if(folder.settings, KeptSettings) or KeptSettings()


def read_effort(folder: RunFolder) -> Effort | None:
    """Cost of a run's stages, or None."""
    return read_json_if(folder.effort, Effort)
