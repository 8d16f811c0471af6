"""The whole chain: diagnosis, twin, policy, comparison and report, going on where it was interrupted."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar, get_args

from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.comparison.targets import draw_targets
from rejoint.logs.runfolder.effort import StageCost, add
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.robots import place_of
from rejoint.runs.given import (
    FIRST_ROBOT,
    NO_GAUGE,
    ArmLike,
    GaugeLike,
    Live,
    Period,
    RobotLike,
    RunLike,
    Targets,
    address_of,
    arm_of,
    as_targets,
    is_batchable,
    run_about,
)
from rejoint.runs.history.summary import summarise
from rejoint.runs.run import Run, finish, newest_or_new, require_same_pace
from rejoint.runs.stages.again import keep_what_holds
from rejoint.runs.stages.calibrate import calibrate
from rejoint.runs.stages.compare import compare
from rejoint.runs.stages.comparing import Compared
from rejoint.runs.stages.diagnose import Diagnosed, diagnose
from rejoint.runs.stages.driving import Controllers, any_geared
from rejoint.runs.stages.gains import gains
from rejoint.runs.stages.identify import identify
from rejoint.runs.stages.report import report
from rejoint.runs.stages.train import train
from rejoint.system.errors import FileError
from rejoint.system.extras import require
from rejoint.system.progress import Progress, no_progress, paced, part

if TYPE_CHECKING:
    from rejoint.arms import Arm
    from rejoint.control.policy import Policy
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.training.presets import Preset
    from rejoint.twin.twin import Twin

Found = TypeVar("Found")

QUICK_TARGETS = 3
"""Targets that controllers are compared on for a first try (chosen)"""

StageName = Literal["diagnose", "calibrate", "identify", "gains", "train", "compare", "report"]
STAGES: tuple[StageName, ...] = get_args(StageName)
MOVING: tuple[StageName, ...] = ("diagnose", "calibrate", "gains", "compare")
"""Stages in which the arm moves"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """How a stage of a repair stands."""

    name: StageName
    state: Literal["started", "kept", "done"]
    """kept: an earlier call has done it, as it was asked for then"""
    file: Path
    """by which the stage counts as done"""
    number: int
    """its place among the stages of this repair, from 1"""
    total: int
    """number of them"""
    why: str = ""
    """it is kept, where not for being done already"""
    result: object = None
    """what the function of the same name returned; of what is kept, diagnosis and comparison only"""


OnStage = Callable[[Stage], object]
"""Called when a stage starts, when it is done, and instead of both where it is kept."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Repaired:
    """What a repair came to, read from its folder."""

    run: Run
    """folder with everything"""

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """What was wrong with the arm."""
        return _there(self.run.diagnosis)

    @cached_property
    def twin(self) -> Twin:
        """The simulation that was fitted to the arm."""
        return _there(self.run.twin)

    @cached_property
    def policy(self) -> Policy:
        """The policy that was trained on it."""
        return _there(self.run.policy)

    @cached_property
    def comparison(self) -> Comparison:
        """Every controller on the arm: errors [m], times [s], with intervals."""
        return _there(self.run.comparison)

    @cached_property
    def recommendation(self) -> Recommendation:
        """The controller to use, and why."""
        return recommend(self.comparison)

    @property
    def page(self) -> Path:
        """The report: one page that opens in a browser."""
        return self.run.folder.report


def _there(found: Found | None) -> Found:
    """Return what a finished run has found; FileError if its file was removed since."""
    if found is None:
        raise FileError("run folder", "a file of a finished repair is missing", "repair again")
    return found


@paced
def repair(
    robot: RobotLike = FIRST_ROBOT,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    preset: str | Preset = "default",
    controllers: Controllers = (),
    targets: Targets | None = None,
    sets: int | None = None,
    repetitions: int | None = None,
    period: Period | None = None,
    seed: int | None = None,
    full: bool = False,
    quick: bool = False,
    afresh: bool | None = None,
    gauge: GaugeLike | None = None,
    on_progress: Progress = no_progress,
    on_stage: OnStage | None = None,
    only: StageName | None = None,
    live: Live | None = None,
) -> Repaired:
    """Diagnose an arm, fit its twin, train a policy, compare every controller on the arm, and write the report.

    Interrupted, the same call goes on where it stopped. Nothing is changed on the arm itself. While the arm moves,
    Ctrl-C and SIGTERM first bring it to a hold; then `Interrupted` is raised, which is a KeyboardInterrupt.

    Parameters
    ----------
    robot
        robot or its address; by default a worn arm emulated in this process
    run
        run, or its folder; by default below ``runs/``: the newest of this robot if it was interrupted, else a new one
    arm
        arm, name or file (`load_arm` cuts one out of a URDF); by default what the address names, else a myCobot 280
    preset
        recipe of the training: ``default``, ``scratch`` (from random weights), ``paper`` (the literal method), or one
        of your own
    controllers
        as for `compare`; none given: as there, without the paper's PIDs
    targets
        as for `compare`
    period
        as for `compare`
    sets, repetitions
        as for `compare`; by default 3 and 2 for an emulated arm, at most 1 and 1 for a real one
    full
        as for `compare`
    seed
        of everything random; by default that of the run, else 0
    quick
        do little of everything, to see in a minute whether all of it works; no result
    afresh
        fit a twin and train a policy even where those of the last repair of this arm, in the folder beside, still hold:
        the twin predicts the new excitation, and the servos have the gains of then. By default an emulated arm's always
        are made afresh, since the same seeds are to give the same results
    gauge
        what measures the tool, as for `calibrate`, or ``none``: nothing is measured, and nothing corrected; by default
        an emulated arm tells by itself, and a real one is not calibrated
    on_progress
        called with the share that is done, each of the stages counting the same, and what is being done
    on_stage
        called when a stage starts and when it is done, with its result
    only
        do this one stage and no other: for who has the stages done by several computers, in their order
    live
        shows the arm meanwhile: a `LiveView`

    Returns
    -------
    Repaired
        what was wrong, which controller to use and why, the policy, and the page of the report

    Raises
    ------
    MissingExtraError
        without the extras ``train`` and ``report``
    InputError
        if the run is of another robot
    AddressError, GuardTripError, RobotError, UnsavedError
        as the stages raise them; what is finished is kept

    Examples
    --------
    >>> result = rejoint.repair("serial:///dev/ttyAMA0")
    >>> print(result.diagnosis.verdict, result.recommendation.controller)
    >>> print(result.page)
    """
    if only is None:
        require("rejoint repair", "train", "report")
    chosen = run.arm if isinstance(run, Run) else arm_of(robot, arm)
    folder = newest_or_new(address_of(robot), chosen, seed or 0)[0] if run is None else run
    about = run_about(folder, address_of(robot), chosen, seed)
    assert about is not None  # noqa: S101 - for the type checker; a folder was given
    require_same_pace(about, quick=quick)
    if targets is not None:  # what the arm cannot reach is known now, not after the training
        as_targets(targets, chosen, sets=1, seed=0)
    emulated = is_batchable(robot)
    meter = None if gauge == NO_GAUGE else gauge
    files = stages_of(robot, chosen, about.folder, controllers=controllers, gauge=gauge, quick=quick)
    chain = _Chain(about.begin(), files, on_stage, on_progress, only=only)
    found = chain.run
    chain.do("diagnose", lambda update: diagnose(
        robot, run=found, period=period, quick=quick, on_progress=update, live=live,
    ))  # fmt: skip
    chain.do("calibrate", lambda update: calibrate(
        robot, run=found, gauge=meter, period=period, on_progress=update, live=live,
    ))  # fmt: skip
    if not (quick or (emulated if afresh is None else afresh)) and isinstance(preset, str):
        chain.why = str(keep_what_holds(found, preset) or "")
    chain.do("identify", lambda update: identify(run=found, quick=quick, on_progress=update))
    chain.do("gains", lambda update: gains(robot, found, period=period, on_progress=update, live=live))
    chain.do("train", lambda update: train(run=found, preset=preset, quick=quick, on_progress=update))
    few = (1, 1) if quick else (3, 2) if emulated else (None, None)
    if quick and targets is None:
        targets = draw_targets(found.arm, sets=1, count=QUICK_TARGETS, seed=found.seed)
    chain.do("compare", lambda update: compare(
        robot, controllers, targets, run=found, sets=sets or few[0], repetitions=repetitions or few[1], full=full,
        paper=False, period=period, calibration=NO_GAUGE if gauge == NO_GAUGE else None,
        directions=emulated and not quick, on_progress=update, live=live,
    ))  # fmt: skip
    chain.do("report", lambda _: report(found))
    if only in (None, "report"):
        finish(found)
        summarise(found)
    return Repaired(run=found)


def stages_of(
    robot: RobotLike, arm: Arm, files: RunFolder, *, controllers: Controllers = (), gauge: GaugeLike | None = None,
    quick: bool = False,
) -> dict[StageName, Path]:  # fmt: skip
    """Name the stages of a repair in their order, each with the file by which it counts as done."""
    places = (
        files.diagnosis, files.calibration, files.twin, files.gains, files.policy, files.comparison, files.report,
    )  # fmt: skip
    found: dict[StageName, Path] = dict(zip(STAGES, places, strict=True))
    if gauge == NO_GAUGE or (gauge is None and not is_batchable(robot)):
        del found["calibrate"]
    rivals = not controllers and not quick
    if not (isinstance(robot, str) and place_of(robot).tunable(arm) and (rivals or any_geared(controllers))):
        del found["gains"]
    return found


class _Chain:
    """Stages that are done only where their file is not there yet; the report is always written anew."""

    def __init__(
        self, run: Run, files: dict[StageName, Path], on_stage: OnStage | None, on_progress: Progress, *,
        only: StageName | None,
    ) -> None:  # fmt: skip
        self.run, self._files, self._on_stage, self._on_progress = run, files, on_stage, on_progress
        self._only, self.why = only, ""
        """a stage to do alone; why twin and policy are those of an earlier repair"""

    def do(self, name: StageName, work: Callable[[Progress], object]) -> None:
        """Do a stage, or say that it is done already."""
        if name not in self._files or self._only not in (None, name):
            return
        file, number, total = self._files[name], list(self._files).index(name), len(self._files)
        if name != "report" and file.exists():
            self._say(
                Stage(
                    name=name,
                    state="kept",
                    file=file,
                    number=number + 1,
                    total=total,
                    result=self._kept(name),
                    why=self.why if name in ("identify", "gains", "train") else "",
                )
            )
            return
        self._say(Stage(name=name, state="started", file=file, number=number + 1, total=total))
        begun = time.monotonic()
        share = (number / total, (number + 1) / total) if self._only is None else (0.0, 1.0)
        try:
            result = work(part(self._on_progress, *share))
        finally:
            add(self.run.folder, StageCost(name=name, wall=time.monotonic() - begun))
        self._say(Stage(name=name, state="done", file=file, number=number + 1, total=total, result=result))

    def _kept(self, name: StageName) -> object:
        """Return what an earlier call has found, as far as it is on file."""
        if name == "diagnose":
            return Diagnosed(diagnosis=_there(self.run.diagnosis))
        if name == "compare":
            comparison = _there(self.run.comparison)
            return Compared(comparison=comparison, recommendation=recommend(comparison))
        return None

    def _say(self, stage: Stage) -> None:
        if self._on_stage is not None:
            self._on_stage(stage)
