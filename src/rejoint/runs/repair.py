"""The whole chain: diagnosis, twin, policy, comparison and report. Stages with a file are done."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar, cast, get_args

import numpy as np

from rejoint.arms import Arm
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.recording import Observer, StageObserver
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import Kept, RunFolder, StageCost, add
from rejoint.logs.runlog import RunLog, read_log
from rejoint.robots import place_of
from rejoint.runs.history import summarise
from rejoint.runs.run import Run, exclusive, finish, is_finished, newest_or_new, require_same_pace
from rejoint.runs.stages.calibrate import calibrate
from rejoint.runs.stages.compare import Compared, ComparisonJob, TrialPlan, comparison_job
from rejoint.runs.stages.diagnose import Diagnosed, diagnose
from rejoint.runs.stages.gains import gains
from rejoint.runs.stages.identify import identify
from rejoint.runs.stages.report import report
from rejoint.runs.stages.train import train
from rejoint.session.context import equipped
from rejoint.session.controllers import Controllers, any_geared, listed, require_possible
from rejoint.session.inputs import (
    FIRST_ROBOT,
    NO_GAUGE,
    ArmLike,
    GaugeLike,
    Period,
    RobotLike,
    RunLike,
    Settings,
    Targets,
    address_of,
    arm_of,
    as_targets,
    is_batchable,
    laden,
    period_of,
    run_about,
    settled,
)
from rejoint.system.errors import FileError
from rejoint.system.extras import require
from rejoint.system.files import read_json, write_json, write_whole
from rejoint.system.numbers import as_seed
from rejoint.system.shell import give_back

if TYPE_CHECKING:
    from rejoint.arms import Arm
    from rejoint.control.controllers.policy import Policy
    from rejoint.diagnosis.calibration.procedure import FilmingGauge, Gauge
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.runs.stages.compare import HelperProcess
    from rejoint.training.presets import Preset
    from rejoint.twin.twin import Twin


Found = TypeVar("Found")

StageName = Literal["diagnose", "calibrate", "identify", "gains", "train", "compare", "report"]
STAGES: tuple[StageName, ...] = get_args(StageName)
MOVING: tuple[StageName, ...] = ("diagnose", "calibrate", "gains", "compare")
"""Stages that move the arm"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """Progress of a stage."""

    name: StageName
    state: Literal["started", "kept", "done"]
    """kept: done by an earlier call with the same inputs"""
    file: Path
    """marks the stage as done"""
    number: int
    """from 1"""
    total: int
    why: str = ""
    """why it is kept, if not for being done"""
    result: object = None
    """of the function of the same name; if kept, only of diagnosis and comparison"""


def there(found: Found | None) -> Found:
    """Return a finished run's result; FileError if its file was removed."""
    if found is None:
        raise FileError("run folder", "a file of a finished repair is missing", "repair again")
    return found


def stages_of(
    robot: RobotLike,
    arm: Arm,
    files: RunFolder,
    *,
    controllers: Controllers = (),
    gauge: GaugeLike | None = None,
    quick: bool = False,
) -> dict[StageName, Path]:
    """Name the stages of a repair in order, each with its file."""
    places = (
        files.diagnosis,
        files.calibration,
        files.twin,
        files.gains,
        files.policy,
        files.comparison,
        files.report,
    )
    found: dict[StageName, Path] = dict(zip(STAGES, places, strict=True))
    if gauge == NO_GAUGE or (gauge is None and not is_batchable(robot)):
        del found["calibrate"]
    rivals = not controllers and not quick
    if not (isinstance(robot, str) and place_of(robot).tunable(arm) and (rivals or any_geared(controllers))):
        del found["gains"]
    return found


class StageChain:
    """Does stages without a file; always writes the report."""

    def __init__(self, run: Run, files: dict[StageName, Path], observer: Observer, *, only: StageName | None) -> None:
        self.run, self._files, self.observer = run, files, observer
        self._only, self.why = only, ""
        """a single stage; why twin and policy are kept"""

    def does(self, *names: StageName) -> bool:
        """Whether this call does all these stages."""
        return self._only is None and not any(self._files[name].exists() for name in names)

    def do(self, name: StageName, work: Callable[[Observer], object]) -> None:
        """Do a stage, or report that it is done."""
        if name not in self._files or self._only not in (None, name):
            return
        number, total = list(self._files).index(name), len(self._files)
        stage = Stage(name=name, state="started", file=self._files[name], number=number + 1, total=total)
        if name != "report" and stage.file.exists():
            why = self.why if name in ("identify", "gains", "train") else ""
            self.observer.stage(replace(stage, state="kept", result=self._kept(name), why=why))
            return
        self.observer.stage(stage)
        begun = time.monotonic()
        share = (number / total, (number + 1) / total) if self._only is None else (0.0, 1.0)
        try:
            result = work(StageObserver(self.observer, *share))
        finally:
            add(self.run.folder, StageCost(name=name, wall=time.monotonic() - begun))
            give_back()
        self.observer.stage(replace(stage, state="done", result=result))

    def _kept(self, name: StageName) -> object:
        if name == "diagnose":
            return Diagnosed(diagnosis=there(self.run.diagnosis))
        if name == "compare":
            comparison = there(self.run.comparison)
            return Compared(comparison=comparison, recommendation=recommend(comparison))
        return None


WORSE = 2.0
"""Relative error of a twin that still holds; chosen, see `python -m benchmarks again`"""
WINDOW = 6.0
"""[s] of motion predicted at a time"""

_LOGGER = logging.getLogger("rejoint")


def keep_what_holds(run: Run, preset: str) -> Kept | None:
    """Copy twin and policy of the last repair into ``run`` if they still hold."""
    if run.folder.twin.exists() or not run.folder.log("excitation").exists():
        return None
    try:
        last = last_repair(run)
        why = None if last is None else still_holds(run, last, preset)
    except FileError as error:
        _LOGGER.warning("nothing is kept of the last repair: %s", error)
        return None
    if last is not None and why is not None:
        _take_over(run, last, why)
    return why


def last_repair(run: Run) -> Run | None:
    """Newest finished repair of the same arm beside ``run``."""
    found = []
    for path in run.path.parent.glob("*/run.json"):
        folder = RunFolder(path.parent)
        files = (folder.diagnosis, folder.twin, folder.policy, folder.outputs.curves)
        if folder.path == run.path or folder.quick.exists() or not all(file.exists() for file in files):
            continue
        other = Run.open(folder.path)
        if other.is_of(run.robot, run.arm) and is_finished(folder):
            found.append(other)
    return max(found, key=lambda other: other.info.created, default=None)


def still_holds(run: Run, last: Run, preset: str) -> Kept | None:
    """Test the twin of ``last`` on ``run``; None if gains or ``preset`` changed."""
    twin, policy, now, before = last.twin, last.policy, run.diagnosis, last.diagnosis
    if twin is None or policy is None or now is None or before is None:
        return None
    if now.servo_gains != before.servo_gains or policy.contract.preset != preset:
        return None
    error, fitted = twin_error(laden(run), twin, read_log(run.folder.log("excitation"))), twin.held_out.twin.tcp
    if error > WORSE * fitted:
        return None
    since = read_json(last.folder.kept, Kept).since if last.folder.kept.exists() else last.info.created
    return Kept(run=str(last.path), since=since, error=error, fitted=fitted)


def twin_error(arm: Arm, twin: Twin, log: RunLog) -> float:
    """Rms tool error [m] of the twin's prediction of a log."""
    from rejoint.twin.judgement import prediction_error
    from rejoint.twin.replay import Replay, cut

    replay = Replay(arm, [log], cut([log], WINDOW), stiction=twin.stiction, acceleration=twin.acceleration)
    predicted = np.concatenate(replay.predict(twin.parameters.repeat(1)), axis=1)[0]
    return prediction_error(arm, predicted, np.concatenate(replay.measured())).tcp


def _take_over(run: Run, last: Run, why: Kept) -> None:
    shutil.copytree(last.folder.outputs.folder, run.folder.outputs.folder, dirs_exist_ok=True)
    write_json(run.folder.kept, why)
    for name in ("twin", "gains", "policy"):
        if (source := getattr(last.folder, name)).exists():
            write_whole(getattr(run.folder, name), partial(shutil.copyfile, source))


QUICK_TARGETS = 3
"""Targets of a quick comparison; chosen"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Repaired:
    """Result of a repair, read from its folder."""

    run: Run

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """What was wrong with the arm."""
        return there(self.run.diagnosis)

    @cached_property
    def twin(self) -> Twin:
        """The twin fitted to the arm."""
        return there(self.run.twin)

    @cached_property
    def policy(self) -> Policy:
        """The policy trained on it."""
        return there(self.run.policy)

    @cached_property
    def comparison(self) -> Comparison:
        """Every controller on the arm: errors [m], times [s], with intervals."""
        return there(self.run.comparison)

    @cached_property
    def recommendation(self) -> Recommendation:
        """The controller to use, and why."""
        return recommend(self.comparison)

    @property
    def page(self) -> Path:
        """The report, for a browser."""
        return self.run.folder.report


@dataclass(frozen=True, kw_only=True)
class RepairPlan:
    """Options of a repair."""

    preset: str | Preset = "default"
    """recipe, as for `train`"""
    controllers: Controllers = ()
    """as for `compare`"""
    targets: Targets | None = None
    """as for `compare`"""
    trials: TrialPlan | None = None
    """as for `compare`; default: 3 sets, 2 repetitions; a real arm: 1 and 1"""
    fresh: bool | None = None
    """fit and train even if the last twin holds; default: for an emulated arm"""
    gauge: GaugeLike | None = None
    """as for `calibrate`, or ``none`` (default for a real arm)"""


def repair(
    robot: RobotLike = FIRST_ROBOT,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    quick: bool = False,
    plan: RepairPlan | None = None,
    only: StageName | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Repaired:
    """Diagnose an arm, fit a twin, train a policy, compare controllers on the arm, and write the report.

    The same call resumes an interrupted repair. Nothing changes on the arm. Ctrl-C and SIGTERM first bring a moving arm
    to a hold; then `Interrupted`, a KeyboardInterrupt, is raised.

    Parameters
    ----------
    robot
        robot or its address; default: an emulated worn arm
    run
        run, or its folder; default: below ``runs/``, an interrupted one of this robot, else a new one
    arm
        arm, name or file (`load_arm` reads a URDF); default: by the address, else a myCobot 280
    quick
        test all steps in a minute, without a result
    plan
        recipe, controllers, targets, measuring device
    only
        do this stage alone
    settings
        payload, tool, control period, seed and so on, which the run keeps
    observer
        receives stages with results, and progress

    Returns
    -------
    Repaired
        all results, and the report's page

    Raises
    ------
    MissingExtraError
        without the extras ``train`` and ``report``
    InputError
        for another robot's run, or an unknown preset, controller or target, before anything moves
    AddressError, GuardTripError, RobotError, UnsavedError
        from the stages; finished ones are kept

    Examples
    --------
    >>> result = rejoint.repair("serial:///dev/ttyAMA0")
    >>> print(result.diagnosis.verdict, result.recommendation.controller)
    >>> print(result.page)
    """
    if only is None:
        require("rejoint repair", "train", "report")
    what, (chosen, _) = plan or RepairPlan(), settled(settings, None, robot)
    built = run.arm if isinstance(run, Run) else arm_of(robot, arm)
    controllers = listed(what.controllers)
    _require_possible(robot, built, what, controllers, chosen.period)
    folder = newest_or_new(address_of(robot), built, as_seed(chosen.seed))[0] if run is None else run
    about = run_about(folder, address_of(robot), built, chosen.seed)
    assert about is not None  # noqa: S101 - for the type checker; a folder was given
    chosen, told = settled(chosen, about, robot)
    if told and observer is not None:
        observer.message(told)
    require_same_pace(about, quick=quick)
    watching, found = observer or Observer(), about.begin()
    files = stages_of(robot, built, found.folder, controllers=controllers, gauge=what.gauge, quick=quick)
    _do_stages(StageChain(found, files, watching, only=only), robot, what, controllers, chosen, quick=quick)
    watching.progress(1.0, "done")
    if only in (None, "report"):
        finish(found)
        summarise(found)
    return Repaired(run=found)


def _do_stages(
    chain: StageChain,
    robot: RobotLike,
    plan: RepairPlan,
    controllers: Controllers,
    settings: Settings,
    *,
    quick: bool,
) -> None:
    found, emulated, targets = chain.run, is_batchable(robot), plan.targets
    no_gauge = plan.gauge == NO_GAUGE
    meter = cast("Gauge | FilmingGauge | None", None if no_gauge else plan.gauge)
    chain.do("diagnose", lambda watch: diagnose(robot, run=found, quick=quick, settings=settings, observer=watch))
    chain.do("calibrate", lambda watch: calibrate(robot, run=found, gauge=meter, settings=settings, observer=watch))
    fresh = quick or (emulated if plan.fresh is None else plan.fresh)
    if not fresh and isinstance(plan.preset, str):
        chain.why = str(keep_what_holds(found, plan.preset) or "")
    chain.do("identify", lambda watch: identify(run=found, quick=quick, observer=watch))
    chain.do("gains", lambda watch: gains(robot, found, settings=settings, observer=watch))
    few = (1, 1) if quick else (3, 2) if emulated else (None, None)
    trials = plan.trials or TrialPlan()
    trials = replace(
        trials,
        sets=few[0] if trials.sets is None else trials.sets,
        directions=emulated and not quick,
        repetitions=few[1] if trials.repetitions is None else trials.repetitions,
    )
    if quick and targets is None:
        targets = draw_targets(found.arm, sets=1, count=QUICK_TARGETS, seed=found.seed)
    compared = replace(settings, calibration=NO_GAUGE) if no_gauge else settings

    def job(watch: Observer) -> ComparisonJob:
        return comparison_job(
            robot,
            controllers,
            targets,
            run=found,
            arm=equipped(found.arm, robot, settings),
            plan=trials,
            settings=compared,
            observer=watch,
        )

    ahead = job(Observer()).begin_ahead() if chain.does("train", "compare") and emulated and not controllers else None
    with nullcontext() if ahead is None else closing(ahead):
        chain.do("train", lambda watch: train(run=found, preset=plan.preset, quick=quick, observer=watch))
        chain.do("compare", lambda watch: _compare(job(watch), found, watch, ahead))
    chain.do("report", lambda _: report(found))


def _require_possible(
    robot: RobotLike, arm: Arm, plan: RepairPlan, controllers: Controllers, period: Period | None
) -> None:
    if isinstance(plan.preset, str):
        from rejoint.training.presets import load_preset  # late: a process that only moves arms trains nothing

        load_preset(plan.preset)
    turns = None if plan.targets is None else as_targets(plan.targets, arm, sets=1, seed=0)[1]
    tunable = isinstance(robot, str) and place_of(robot).tunable(arm)
    require_possible(controllers, arm, period_of(robot, period), tunable=tunable, posed=turns is not None)


def _compare(job: ComparisonJob, run: Run, observer: Observer, ahead: HelperProcess | None) -> Compared:
    with exclusive(run):
        return job.drive(observer.progress, ahead)
