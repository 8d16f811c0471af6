"""A run: one repair and its folder."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.arms import CATALOGUE, Arm, Array, differing, load_arm, write_arm_toml
from rejoint.arms.inertia import bare
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.controllers.policy import Policy
from rejoint.control.robot import JointState, Robot, WatchedRobot
from rejoint.control.servogains import GainsFound
from rejoint.logs.history import plain_name
from rejoint.logs.journal import Journal
from rejoint.logs.runfolder import LOGS, RUNS, RunFolder, RunInfo, StageCost, add, files_below, locked, read_info
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import UNFINISHED, as_path, digest, read_bounded, read_json_if, reading, unused, write_json
from rejoint.system.numbers import as_seed
from rejoint.system.records import Readable, entity
from rejoint.system.shell import __version__
from rejoint.twin.twin import Twin, read_twin

if TYPE_CHECKING:
    from rejoint.diagnosis.diagnosis import Diagnosis


@entity
class Run(Readable):
    """One repair: folder, robot, arm, seed, results.

    Examples
    --------
    >>> run = rejoint.Run.open("runs/mine")
    >>> print(run.diagnosis.verdict)
    >>> policy = run.policy
    """

    folder: RunFolder
    info: RunInfo
    """content of run.json"""
    arm: Arm

    @classmethod
    def open(cls, path: Run | Path | str) -> Run:
        """Open a run folder, unless it is open; FileError if missing, damaged, or of a later version."""
        if isinstance(path, Run):
            return path
        folder = RunFolder(as_path("a run or its folder", path))
        if not folder.info.exists():
            within = sorted(str(p.parent.relative_to(path)) for p in files_below(folder.path, "run.json"))
            start = "start with: rejoint diagnose ROBOT --run FOLDER"
            hint = f"it holds runs, name one of: {', '.join(within)}" if within else start
            raise FileError(path, "no run folder (it holds no run.json)", hint)
        info = read_info(folder.info)
        if info.arm_file and _digest(folder) != info.arm_file:
            remedy = "bring back the description that this run was begun with, or begin another run"
            raise FileError(folder.description, "damaged or changed since the run was begun", remedy)
        return cls(folder=folder, info=info, arm=replace(load_arm(folder.arm(info.arm)), name=info.arm))

    @classmethod
    def plan(
        cls,
        path: Run | Path | str | None,
        robot: str,
        arm: Arm,
        seed: int | None = 0,
        *,
        name: str = "",
        fleet: str = "",
    ) -> Run:
        """Open the run folder, or plan what `create` writes; same errors.

        Default path: `newest_or_new` of this robot below `RUNS`. Default seed: the folder's.
        """
        if path is None:
            path = newest_or_new(robot, arm, RUNS / plain_name(f"{name or arm.name}-{robot}-seed{as_seed(seed)}"))
        folder = path.folder if isinstance(path, Run) else RunFolder(as_path("a run or its folder", path))
        if isinstance(path, Run) or folder.info.exists():
            run = cls.open(path)
            seed = run.seed if seed is None else seed
            own, given = (Path(one.removeprefix(LOGS)).absolute() for one in (run.robot, robot))  # as logs are named
            if (own, run.seed) != (given, seed):
                raise InputError(
                    f"{run.path} is a run of {run.robot} (seed {run.seed}), and this would be {robot} (seed {seed}); "
                    "give another --run"
                )
            run.require(arm)
            return run
        info = RunInfo(
            robot=robot,
            arm=arm.name,
            seed=as_seed(seed),
            version=__version__,
            created=datetime.now().isoformat(timespec="seconds"),
            name=name,
            fleet=fleet,
        )
        run = cls(folder=folder, info=info, arm=arm)
        if folder.path.is_dir() and not _empty(folder.path) and not run._lost():
            raise InputError(f"{path} is not a run folder and not empty; give another --run")
        return run

    def _lost(self) -> bool:
        """Whether the folder is of a run of this robot and arm, whose description is lost."""
        kept = self.diagnosis
        return bool(kept and kept.robot == self.robot and not self.other_than(load_arm(self.folder.arm(kept.arm))))

    @classmethod
    def create(cls, path: Path | str, robot: str, arm: Arm, seed: int = 0) -> Run:
        """Make or open the run folder.

        InputError for another robot, arm or seed, or other files.
        """
        return cls.plan(path, robot, arm, seed).begin()

    def begin(self) -> Run:
        """Write the description of the run, if missing; FileError."""
        if self.folder.info.exists():
            return self
        run, arm = self, bare(self.arm)
        if arm.name not in CATALOGUE or arm.keep_out or differing(arm, load_arm(arm.name)):
            write_arm_toml(self.folder.description, arm)
            run = replace(self, info=replace(self.info, arm_file=_digest(self.folder)))
        write_json(run.folder.info, run.info)
        return run

    def other_than(self, arm: Arm) -> tuple[str, ...]:
        """Fields that differ from ``arm``, without loads."""
        return differing(bare(self.arm), bare(arm))

    def require(self, arm: Arm) -> None:
        """Raise InputError for another arm."""
        if changed := self.other_than(arm):
            raise InputError(
                f"{self.path} was begun with {self.arm.name}, and the arm that is given is {arm.name} (another "
                f"{', '.join(changed[:3])}); give another --run, or {self.folder.arm(self.info.arm)} as the arm"
            )

    @property
    def path(self) -> Path:
        """The folder."""
        return self.folder.path

    @property
    def robot(self) -> str:
        """Address of the robot; for logs alone ``logs:`` and their place."""
        return self.info.robot

    @property
    def seed(self) -> int:
        """Seed of all random numbers."""
        return self.info.seed

    def seeded(self, seed: int | None) -> Run:
        """Run with another seed, if one is given."""
        return self if seed is None else replace(self, info=replace(self.info, seed=as_seed(seed)))

    @property
    def diagnosis(self) -> Diagnosis | None:
        """What is wrong with the arm, if diagnosed."""
        from rejoint.diagnosis.diagnosis import Diagnosis

        return read_json_if(self.folder.diagnosis, Diagnosis)

    @property
    def twin(self) -> Twin | None:
        """The twin, if identified."""
        return read_twin(self.folder.twin, self.arm) if self.folder.twin.exists() else None

    @property
    def policy(self) -> Policy | None:
        """The policy, if trained."""
        return Policy.load(self.folder.policy) if self.folder.policy.exists() else None

    @property
    def gains(self) -> GainsFound | None:
        """Better gains of the servos, if searched."""
        return read_json_if(self.folder.gains, GainsFound)

    @property
    def comparison(self) -> Comparison | None:
        """Every controller on the arm, if compared."""
        return read_json_if(self.folder.comparison, Comparison)

    @property
    def recommendation(self) -> Recommendation | None:
        """The controller to use, and why, if compared."""
        found = self.comparison
        return None if found is None else recommend(found)

    @property
    def page(self) -> Path:
        """The report, for a browser."""
        return self.folder.report

    def _shown(self) -> list[tuple[str, str]]:
        state = "finished" if self.folder.finished.exists() else "unfinished"
        return [("path", str(self.path)), ("robot", self.robot), ("arm", self.arm.name), ("state", state)]

    def to_pandas(self) -> Any:  # noqa: ANN401 - pandas is not part of the installation
        """Return a `pandas.DataFrame` of the comparison: a row for each controller; InputError before it."""
        if self.comparison is None:
            raise InputError(f"{self.path} has no comparison yet; make it with: rejoint compare ROBOT {self.path}")
        return self.comparison.to_pandas()

    @property
    def logs(self) -> dict[str, RunLog]:
        """All run logs by name, sorted."""
        return {name: RunLog.load(path) for name, path in self.folder.logs().items()}


def newest_or_new(robot: str, arm: Arm, home: Path) -> Path:
    """Return the newest run folder in ``home`` if interrupted, else a new one."""
    last = max((int(p.name) for p in home.glob("*") if p.name.isdecimal()), default=0)
    newest = RunFolder(home / f"{last:03}")
    again = last > 0 and not newest.finished.exists()
    with suppress(FileError):  # who uses an unreadable one is told so
        if again and newest.info.exists():
            run = Run.open(newest.path)
            again = run.robot == robot and not run.other_than(arm)
    return newest.path if again else home / f"{last + 1:03}"


def finish(run: Run) -> None:
    """Mark a run as finished if no result is missing."""
    folder = run.folder
    results = (folder.judgement,) if run.info.from_logs else (folder.diagnosis, folder.policy, folder.comparison)
    if all(path.exists() for path in (folder.twin, *results)):
        mark(folder.finished)


def mark(path: Path) -> None:
    """Write a file by which its run is finished, or a quick try, whose results are not valid."""
    write_json(path, {path.stem: datetime.now().isoformat(timespec="seconds")})


@contextmanager
def exclusive(run: Run | None) -> Iterator[None]:
    """Lock the run folder during a stage; a failed one leaves no new folder."""
    if run is None:
        yield
        return
    with locked(run.folder):
        try:
            yield
        except BaseException:
            path = run.path
            if path.is_dir() and not run.folder.info.exists():
                with suppress(OSError):  # logs are there
                    (path / "logs").rmdir()
                if _empty(path):
                    shutil.rmtree(path)
                    if RUNS in path.parents:  # what was made for it goes with it
                        with suppress(OSError):  # other runs are there
                            os.removedirs(path.parent)
            raise


def _empty(path: Path) -> bool:
    """Whether a folder holds no more than what a run begins with."""
    begun = {"run.json", "arm.toml", "settings.json", ".lock"}
    return all(entry.name in begun or entry.name.endswith(UNFINISHED) for entry in path.iterdir())


def _digest(folder: RunFolder) -> str:
    remedy = "bring it back, or begin another run"
    with reading(folder.description, "cannot be read", remedy):
        return digest(read_bounded(folder.description, remedy))


@contextmanager
def staged(run: Run | None, stage: str, path: Path | None = None) -> Iterator[Callable[[Robot], Robot]]:
    """Return what wraps the robots of a stage; the run then knows their motion, which is journaled.

    Time and travel are added to the stage's costs. An error comes with a note on the log of the motion, in the run or
    beside ``path``.
    """
    file = dated(run, stage) if path is None and run is not None else path
    journals, moving, travel, begun = list[Journal](), 0.0, 0.0, time.monotonic()  # one, from the first step on

    def watch(robot: Robot) -> Robot:
        before: JointState | None = None

        def see(state: JointState, command: Array | None) -> None:
            nonlocal before, moving, travel
            if command is None:
                return
            last, before = before, state
            if last is None:
                return
            if not journals and file is not None:
                if run is not None:
                    run.begin()
                journals.append(Journal(file, robot.arm, robot.address, stage))
            moving += max(float(np.nan_to_num(state.time[0] - last.time[0])), 0.0)
            travel += float(np.nansum(np.abs(state.position[0] - last.position[0])))
            for journal in journals:
                journal.append(last.time[0], last.position[0], command[0], *np.full((2, 3), np.nan))

        return WatchedRobot(robot, see) if robot.count == 1 else robot

    try:
        yield watch
    except BaseException as error:
        for journal in journals:
            error.add_note(journal.rescue())
        raise
    else:
        for journal in journals:
            journal.discard()
    finally:
        if run is not None:
            add(run.folder, StageCost(name=stage, wall=time.monotonic() - begun, moving=moving, travel=travel))


def dated(run: Run, name: str) -> Path:
    """Path of a new run log with its date."""
    return unused(run.folder.log(f"{name}-{datetime.now():%Y%m%d-%H%M%S}"))
