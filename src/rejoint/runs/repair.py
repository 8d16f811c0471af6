"""The whole chain: diagnosis, twin, policy, comparison and report; and the session that does its stages by hand."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from rejoint.arms import Arm
from rejoint.control.comparison.recommend import recommend
from rejoint.control.recording import Observer, StageObserver
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import Kept, RunFolder, StageCost, add
from rejoint.logs.runlog import RunLog, read_log
from rejoint.robots import place_of
from rejoint.runs.history import summarise
from rejoint.runs.run import Run, exclusive, finish, is_finished, newest_or_new, require_same_pace
from rejoint.runs.stages.calibrate import Calibrated, calibrate
from rejoint.runs.stages.compare import Compared, ComparisonJob, TrialPlan, compare, comparison_job
from rejoint.runs.stages.diagnose import Diagnosed, diagnose
from rejoint.runs.stages.gains import gains
from rejoint.runs.stages.identify import identify
from rejoint.runs.stages.train import TrainedPolicy, train
from rejoint.session.context import Controllers, any_geared, equipped, listed, require_possible
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
    as_run,
    as_targets,
    is_batchable,
    laden,
    period_of,
    run_about,
    settled,
)
from rejoint.session.session import ArmSession
from rejoint.system.errors import FileError
from rejoint.system.extras import require
from rejoint.system.files import read_json, write_json, write_whole
from rejoint.system.numbers import as_seed
from rejoint.system.shell import give_back

if TYPE_CHECKING:
    from rejoint.training.presets import Preset
    from rejoint.twin.twin import Twin


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


_FILES = ("diagnosis", "calibration", "twin", "gains", "policy", "comparison", "report")


def stages_of(
    robot: RobotLike, arm: Arm, files: RunFolder, plan: RepairPlan | None = None, *, quick: bool = False
) -> dict[StageName, Path]:
    """Name the stages of a repair in order, each with its file."""
    what = plan or RepairPlan()
    found: dict[StageName, Path] = {name: getattr(files, file) for name, file in zip(STAGES, _FILES, strict=True)}
    if what.gauge == NO_GAUGE or (what.gauge is None and not is_batchable(robot)):
        del found["calibrate"]
    rivals = not what.controllers and not quick
    if not (_is_tunable(robot, arm) and (rivals or any_geared(listed(what.controllers)))):
        del found["gains"]
    return found


def _is_tunable(robot: RobotLike, arm: Arm) -> bool:
    return isinstance(robot, str) and place_of(robot).tunable(arm)


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
        last = _last_repair(run)
        why = None if last is None else _still_holds(run, last, preset)
    except FileError as error:
        _LOGGER.warning("nothing is kept of the last repair: %s", error)
        return None
    if last is not None and why is not None:
        shutil.copytree(last.folder.outputs.folder, run.folder.outputs.folder, dirs_exist_ok=True)
        write_json(run.folder.kept, why)
        for name in ("twin", "gains", "policy"):
            if (source := getattr(last.folder, name)).exists():
                write_whole(getattr(run.folder, name), partial(shutil.copyfile, source))
    return why


def _last_repair(run: Run) -> Run | None:
    """Newest finished repair of the same arm beside ``run``, with a training."""
    folders = [RunFolder(path.parent) for path in run.path.parent.glob("*/run.json")]
    trained = [one for one in folders if one.outputs.curves.exists() and not one.quick.exists() and is_finished(one)]
    others = [Run.open(folder.path) for folder in trained if folder.path != run.path]
    same = (other for other in others if other.is_of(run.robot, run.arm))
    return max(same, key=lambda other: other.info.created, default=None)


def _still_holds(run: Run, last: Run, preset: str) -> Kept | None:
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


QUICK_TARGETS = 3
"""Targets of a quick comparison; chosen"""


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
) -> Run:
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
    Run
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
    _require_possible(robot, built, what, chosen.period)
    folder = newest_or_new(address_of(robot), built, as_seed(chosen.seed))[0] if run is None else run
    about = run_about(folder, address_of(robot), built, chosen.seed)
    assert about is not None  # noqa: S101 - for the type checker; a folder was given
    chosen, told = settled(chosen, about, robot)
    watching = observer or Observer()
    if told:
        watching.message(told)
    require_same_pace(about, quick=quick)
    found = about.begin()
    _RepairStages(robot, found, what, chosen, watching, quick=quick, only=only).do_all()
    watching.progress(1.0, "done")
    return found


def _require_possible(robot: RobotLike, arm: Arm, plan: RepairPlan, period: Period | None) -> None:
    if isinstance(plan.preset, str):
        from rejoint.training.presets import load_preset  # late: a process that only moves arms trains nothing

        load_preset(plan.preset)
    turns = None if plan.targets is None else as_targets(plan.targets, arm, sets=1, seed=0)[1]
    able = {"tunable": _is_tunable(robot, arm), "posed": turns is not None}
    require_possible(listed(plan.controllers), arm, period_of(robot, period), **able)


class _RepairStages:
    """Does stages without a file; always writes the report."""

    def __init__(
        self,
        robot: RobotLike,
        run: Run,
        plan: RepairPlan,
        settings: Settings,
        observer: Observer,
        *,
        quick: bool,
        only: StageName | None,
    ) -> None:
        self.robot, self.run, self.plan, self.settings, self.observer = robot, run, plan, settings, observer
        self.quick, self.only = quick, only
        self.controllers = listed(plan.controllers)
        self.files = stages_of(robot, run.arm, run.folder, plan, quick=quick)

    def do_all(self) -> None:
        """Do the stages in order."""
        robot, run, plan, quick, settings = self.robot, self.run, self.plan, self.quick, self.settings
        emulated = is_batchable(robot)
        gauge = None if plan.gauge == NO_GAUGE else plan.gauge
        moving: dict[str, Any] = {"run": run, "settings": settings}
        self.do("diagnose", partial(diagnose, robot, quick=quick, **moving))
        self.do("calibrate", partial(calibrate, robot, gauge=gauge, **moving))
        fresh, why = quick or (emulated if plan.fresh is None else plan.fresh), None
        if not fresh and isinstance(plan.preset, str):
            why = keep_what_holds(run, plan.preset)
        self.do("identify", partial(identify, run=run, quick=quick), why)
        self.do("gains", partial(gains, robot, **moving), why)
        self.do("train", partial(train, run=run, preset=plan.preset, quick=quick), why)
        self.do("compare", self._compare)
        self.do("report", lambda observer: report(run))  # noqa: ARG005

    def _comparison(self, observer: Observer) -> ComparisonJob:
        plan, run, quick, emulated = self.plan, self.run, self.quick, is_batchable(self.robot)
        trials, targets = plan.trials or TrialPlan(), plan.targets
        sets, repetitions = (1, 1) if quick else (3, 2) if emulated else (None, None)
        trials = replace(
            trials,
            sets=sets if trials.sets is None else trials.sets,
            directions=emulated and not quick,
            repetitions=repetitions if trials.repetitions is None else trials.repetitions,
        )
        if quick and targets is None:
            targets = draw_targets(run.arm, sets=1, count=QUICK_TARGETS, seed=run.seed)
        settings = replace(self.settings, calibration=NO_GAUGE) if plan.gauge == NO_GAUGE else self.settings
        arm = equipped(run.arm, self.robot, self.settings)
        about: dict[str, Any] = {"run": run, "arm": arm, "plan": trials, "settings": settings, "observer": observer}
        return comparison_job(self.robot, self.controllers, targets, **about)

    def _compare(self, observer: Observer) -> Compared:
        with exclusive(self.run):
            return self._comparison(observer).drive(observer.progress)

    def do(self, name: StageName, work: Callable[..., object], why: Kept | None = None) -> None:
        """Do a stage, or report that it is done, and ``why`` it is kept."""
        if name not in self.files or self.only not in (None, name):
            return
        number, total = list(self.files).index(name), len(self.files)
        stage = Stage(name=name, state="started", file=self.files[name], number=number + 1, total=total)
        if name != "report" and stage.file.exists():
            result = self._kept(name)
            self.observer.stage(replace(stage, state="kept", result=result, why=str(why or "")))
            return
        self.observer.stage(stage)
        begun = time.monotonic()
        share = (number / total, (number + 1) / total) if self.only is None else (0.0, 1.0)
        try:
            result = work(observer=StageObserver(self.observer, *share))
        finally:
            add(self.run.folder, StageCost(name=name, wall=time.monotonic() - begun))
            give_back()
        self.observer.stage(replace(stage, state="done", result=result))

    def _kept(self, name: StageName) -> object:
        diagnosis, comparison = self.run.diagnosis, self.run.comparison
        if name == "diagnose" and diagnosis is not None:
            return Diagnosed(diagnosis=diagnosis)
        if name == "compare" and comparison is not None:
            return Compared(comparison=comparison, recommendation=recommend(comparison))
        return None


def report(run: RunLike) -> Path:
    """Write the report of a run: one self-contained page, and its figures as PNG files.

    Parameters
    ----------
    run
        run, or its folder

    Returns
    -------
    Path
        of ``report.html``

    Raises
    ------
    FileError
        if the run is empty, or a file damaged

    Examples
    --------
    >>> page = rejoint.report("runs/mine")
    >>> webbrowser.open(page.resolve().as_uri())
    """
    from rejoint.pages.report.page import write_report

    found = as_run(run)
    with exclusive(found):
        page = write_report(found.path)
        finish(found)
        summarise(found)
        return page


class Session(ArmSession):
    """An arm with everything that drives it, see `rejoint.connect`; its run takes up what a stage finds.

    One motion at a time, always guarded; between motions the arm holds. Before its first motion to a point or along a
    path it goes slowly to its rest posture. Use it in a ``with`` block.

    Examples
    --------
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.diagnose(), arm.identify(), arm.train(), arm.compare()
    ...     arm.move_to([0.2, 0.05, 0.18])  # by the controller that the comparison recommends
    """

    def diagnose(self, *, quick: bool = False) -> Diagnosed:
        """Excite the arm and say what is wrong with it; as `rejoint.diagnose`."""
        with self.lent() as about:
            return diagnose(self.robot, quick=quick, **about)

    def calibrate(self, gauge: GaugeLike | None = None, *, count: int | None = None) -> Calibrated:
        """Find out where the tool really is; as `rejoint.calibrate`."""
        with self.lent() as about:
            return calibrate(self.robot, gauge=gauge, count=count, **about)

    def identify(self, *, quick: bool = False) -> Twin:
        """Fit a twin to what the diagnosis recorded; as `rejoint.identify`."""
        with self.lent() as about:
            return identify(run=about["run"], quick=quick, observer=self.observer)

    def train(self, *, quick: bool = False) -> TrainedPolicy:
        """Train a policy on copies of the twin; as `rejoint.train`."""
        with self.lent() as about:
            return train(run=about["run"], quick=quick, observer=self.observer)

    def compare(
        self, controllers: Controllers = (), targets: Targets | None = None, *, plan: TrialPlan | None = None
    ) -> Compared:
        """Try controllers on the arm and recommend one; as `rejoint.compare`."""
        with self.lent() as about:
            return compare(self.robot, controllers, targets, plan=plan, **about)


def connect(
    address: RobotLike,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Session:
    """Connect to an arm, to drive it under the guard; nothing moves yet.

    Without a guard: `rejoint.open_robot`.

    Parameters
    ----------
    address
        ``emulated:worn`` (virtual time), ``tcp://HOST:PORT``, ``serial:///dev/DEVICE``, ``feetech:///dev/DEVICE``, or
        an open robot
    run
        run, or its folder, for twin, calibration, recommended controller and logs; without one the generic policy
        drives, if this arm has one
    arm
        arm, name or file; default: by the run or the address
    settings
        controller, payload, control period and the like
    observer
        receives messages, progress, control cycles

    Returns
    -------
    Session
        the arm

    Raises
    ------
    AddressError
        if nothing usable is there
    MissingExtraError
        for an emulated arm without the simulator
    InputError, ContractError
        if run, controller and arm do not fit

    Examples
    --------
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.move_to([0.2, 0.05, 0.18])
    >>> settings = rejoint.Settings(payload=0.1)
    >>> arm = rejoint.connect("emulated:worn", settings=settings)
    """
    found = Session(address, run=run, arm=arm, settings=settings, observer=observer)
    try:
        found.driver()
        found.correction  # noqa: B018 - what does not fit is refused now
        return found.open()
    except BaseException as error:
        found.__exit__(type(error), error, error.__traceback__)
        raise
