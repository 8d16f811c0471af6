"""The whole chain: diagnosis, twin, policy, comparison and report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from rejoint.arms import Arm
from rejoint.control.comparison.recommend import recommend
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import POLICY
from rejoint.control.recording import Observer
from rejoint.control.servogains import GEARED_POLICY, RIVALS
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import RunFolder
from rejoint.robots import is_virtual, place_of
from rejoint.runs.history import summarise
from rejoint.runs.run import Run, exclusive, finish, staged
from rejoint.runs.stages.calibrate import calibrate
from rejoint.runs.stages.compare import ONE_ARM_PROTOCOL, Compared, TrialPlan, compare
from rejoint.runs.stages.diagnose import Diagnosed, diagnose
from rejoint.runs.stages.fitting import gains, identify, train
from rejoint.session.context import ControllerMaker, Controllers, named
from rejoint.session.inputs import (
    FIRST_ROBOT,
    NO_GAUGE,
    ArmLike,
    GaugeLike,
    RobotLike,
    RunLike,
    Settings,
    Targets,
    address_of,
    arm_of,
    as_targets,
    opened,
    period_of,
    settled,
)
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.records import as_options, entity
from rejoint.system.shell import give_back

if TYPE_CHECKING:
    from rejoint.training.task import Preset


StageName = Literal["diagnose", "calibrate", "identify", "gains", "train", "compare", "report"]
STAGES: tuple[StageName, ...] = get_args(StageName)
MOVING: tuple[StageName, ...] = ("diagnose", "calibrate", "gains", "compare")
"""Stages that move the arm"""


@entity
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
    result: object = None
    """of the function of the same name; if kept, only of diagnosis and comparison"""


_FILES = ("diagnosis", "calibration", "twin", "gains", "policy", "comparison", "report")


def stages_of(
    robot: RobotLike, arm: Arm, files: RunFolder, plan: RepairPlan | None = None, *, quick: bool = False
) -> dict[StageName, Path]:
    """Name the stages of a repair in order, each with its file."""
    what = plan or RepairPlan()
    found = {name: getattr(files, file) for name, file in zip(STAGES, _FILES, strict=True)}
    if what.gauge == NO_GAUGE or (what.gauge is None and not is_virtual(robot)):
        del found["calibrate"]
    asked = named(what.controllers).values()
    rivals = any(one in RIVALS for one in asked) if asked else not quick
    if not (rivals and _is_tunable(robot, arm)):
        del found["gains"]
    if asked and not any(one in (POLICY, GEARED_POLICY) for one in asked):
        del found["train"]
    return found


def _is_tunable(robot: RobotLike, arm: Arm) -> bool:
    return isinstance(robot, str) and place_of(robot).tunable(arm)


QUICK_TARGETS, QUICK_POINTS = 3, 6
"""Targets of a quick comparison, and postures of a quick calibration; chosen"""


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

    The same call resumes an interrupted repair. Nothing changes on the arm. On Ctrl-C and SIGTERM it holds, then
    `Interrupted` is raised. A dry run simulates diagnosis and comparison.

    Parameters
    ----------
    robot
        robot or its address; default: an emulated worn arm
    run
        run, or its folder; default: below ``runs/``, this robot's interrupted one, else a new one
    arm
        arm, name or file; default: by the address, else a myCobot 280
    quick
        test all steps in a minute; no result
    plan
        recipe, controllers, targets, measuring device
    only
        do this stage alone
    settings
        payload, tool, control period, seed; the run keeps them
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
        for another robot's run, an unknown preset, controller or target; nothing has moved
    AddressError, GuardTripError, RobotError, UnsavedError
        from the stages; finished ones are kept

    Examples
    --------
    >>> result = rejoint.repair("serial:///dev/ttyAMA0")
    >>> print(result.diagnosis.verdict, result.recommendation.controller)
    >>> print(result.page)
    """
    what = as_options(plan, RepairPlan)
    chosen, _ = settled(settings, None, robot)
    if only is None and not chosen.dry_run:
        require("rejoint repair", "train", "report")
    built = opened(run, arm).arm if isinstance(run, Run) else arm_of(robot, arm)
    if not chosen.dry_run:
        from rejoint.training.task import load_preset  # late: a process that only moves arms trains nothing

        load_preset(what.preset)
    posed = what.targets is not None and as_targets(what.targets, built, sets=1, seed=0)[1] is not None
    maker = ControllerMaker(built, period_of(robot, chosen.period))
    maker.require_possible(what.controllers, tunable=_is_tunable(robot, built), posed=posed)
    about = opened(Run.plan(run, address_of(robot), built, chosen.seed), built)
    chosen, told = settled(chosen, about, robot)
    watching = as_options(observer, Observer)
    if told:
        watching.message(told)
    if about.folder.quick.exists() and not quick:
        raise InputError(
            f"{about.path} is of a quick try, which is no result; give another --run, or delete the folder"
        )
    if chosen.dry_run:
        diagnose(robot, arm=built, quick=quick, settings=chosen, observer=watching)
        trials = TrialPlan(sets=1, repetitions=1)
        compare(robot, ["default"], what.targets, arm=built, plan=trials, settings=chosen, observer=watching)
        watching.message("The first is the diagnosis, the second the comparison of one controller with ten targets.")
        return about
    files = stages_of(robot, about.arm, about.folder, what, quick=quick)
    if only is not None and only not in files:
        raise InputError(f"this repair has no stage {only}; it has: {', '.join(files)}")
    found = about.begin()
    points = QUICK_POINTS if quick and not what.gauge else None
    works: dict[StageName, Callable[..., object]] = {
        "diagnose": partial(diagnose, robot, run=found, quick=quick, settings=chosen),
        "calibrate": partial(calibrate, robot, run=found, gauge=what.gauge, count=points, settings=chosen),
        "identify": partial(identify, run=found),
        "gains": partial(gains, robot, found, settings=chosen),
        "train": partial(train, run=found, preset=what.preset, quick=quick),
        "compare": partial(_compare, robot, found, what, chosen, quick=quick),
        "report": lambda observer: report(found),  # noqa: ARG005
    }
    for number, (name, file) in enumerate(files.items(), start=1):
        if only in (None, name):
            stage = Stage(name=name, state="started", file=file, number=number, total=len(files))
            _do(stage, works[name], found, watching)
    watching.progress(1.0, "done")
    return found


def _compare(
    robot: RobotLike, run: Run, plan: RepairPlan, settings: Settings, *, quick: bool, observer: Observer
) -> Compared:
    given, targets, emulated = as_options(plan.trials, TrialPlan), plan.targets, is_virtual(robot)
    small = ONE_ARM_PROTOCOL if quick else Protocol(crossings=False)
    usual = TrialPlan(
        sets=1 if quick else 3 if emulated else None,
        repetitions=1 if quick else 2 if emulated else None,
        protocol=small if emulated and not given.full else None,  # as on a real arm
    )
    trials = replace(usual, **{name: value for name, value in vars(given).items() if value is not None})
    if quick and targets is None:
        targets = draw_targets(run.arm, sets=1, count=QUICK_TARGETS, seed=run.seed)
    if plan.gauge == NO_GAUGE:
        settings = replace(settings, calibration=NO_GAUGE)
    return compare(robot, plan.controllers, targets, run=run, plan=trials, settings=settings, observer=observer)


def _do(stage: Stage, work: Callable[..., object], run: Run, observer: Observer) -> None:
    """Do a stage, or report that it is done."""
    if stage.name != "report" and stage.file.exists():
        observer.stage(replace(stage, state="kept", result=_kept(run, stage.name)))
        return
    observer.stage(stage)
    try:
        result = work(observer=observer)
    finally:
        give_back()
    observer.stage(replace(stage, state="done", result=result))


def _kept(run: Run, name: StageName) -> object:
    if name == "diagnose" and (diagnosis := run.diagnosis):
        return Diagnosed(diagnosis=diagnosis)
    if name == "compare" and (comparison := run.comparison):
        return Compared(comparison=comparison, recommendation=recommend(comparison))
    return None


def report(run: RunLike) -> Path:
    """Write the report of a run: one page, and its figures as PNG files.

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

    found = Run.open(run)
    with exclusive(found), staged(found, "report"):
        page = write_report(found.path)
        finish(found)
        summarise(found)
        return page
