"""The whole chain: diagnosis, twin, policy, comparison and report, going on where it was interrupted."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.comparison.targets import draw_targets
from rejoint.robots import place_of
from rejoint.runs.chain import Chain, OnStage, StageName, stages_of, there
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
    period_of,
    run_about,
)
from rejoint.runs.history.summary import summarise
from rejoint.runs.run import Run, exclusive, finish, newest_or_new, require_same_pace
from rejoint.runs.stages.again import keep_what_holds
from rejoint.runs.stages.calibrate import calibrate
from rejoint.runs.stages.compare import comparison_job
from rejoint.runs.stages.comparing import Compared, ComparisonJob
from rejoint.runs.stages.controllers import Controllers, listed, require_possible
from rejoint.runs.stages.diagnose import diagnose
from rejoint.runs.stages.early import EarlyTrials
from rejoint.runs.stages.gains import gains
from rejoint.runs.stages.identify import identify
from rejoint.runs.stages.report import report
from rejoint.runs.stages.train import train
from rejoint.system.extras import require
from rejoint.system.numbers import as_seed
from rejoint.system.progress import Progress, no_progress, paced

if TYPE_CHECKING:
    from rejoint.arms import Arm
    from rejoint.control.policy import Policy
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.training.presets import Preset
    from rejoint.twin.twin import Twin


QUICK_TARGETS = 3
"""Targets that controllers are compared on for a first try (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Repaired:
    """What a repair came to, read from its folder."""

    run: Run
    """folder with everything"""

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """What was wrong with the arm."""
        return there(self.run.diagnosis)

    @cached_property
    def twin(self) -> Twin:
        """The simulation that was fitted to the arm."""
        return there(self.run.twin)

    @cached_property
    def policy(self) -> Policy:
        """The policy that was trained on it."""
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
        """The report: one page that opens in a browser."""
        return self.run.folder.report


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
        if the run is of another robot, or there is no such preset, controller or target: before the robot is opened
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
    controllers = listed(controllers)
    _require_possible(robot, chosen, preset, controllers, targets, period)
    folder = newest_or_new(address_of(robot), chosen, as_seed(seed))[0] if run is None else run
    about = run_about(folder, address_of(robot), chosen, seed)
    assert about is not None  # noqa: S101 - for the type checker; a folder was given
    require_same_pace(about, quick=quick)
    emulated = is_batchable(robot)
    meter = None if gauge == NO_GAUGE else gauge
    files = stages_of(robot, chosen, about.folder, controllers=controllers, gauge=gauge, quick=quick)
    chain = Chain(about.begin(), files, on_stage, on_progress, only=only)
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
    few = (1, 1) if quick else (3, 2) if emulated else (None, None)
    if quick and targets is None:
        targets = draw_targets(found.arm, sets=1, count=QUICK_TARGETS, seed=found.seed)
    job = partial(
        comparison_job, robot, controllers, targets, run=found, arm=found.arm, seed=found.seed,
        sets=few[0] if sets is None else sets, repetitions=few[1] if repetitions is None else repetitions,
        full=full, paper=False, period=period,
        calibration=NO_GAUGE if gauge == NO_GAUGE else None, directions=emulated and not quick, live=live,
    )  # fmt: skip
    both = only is None and not (files["train"].exists() or files["compare"].exists())
    ahead = job().begin_ahead() if emulated and both and not controllers else None  # what needs no policy
    with nullcontext() if ahead is None else closing(ahead):
        chain.do("train", lambda update: train(run=found, preset=preset, quick=quick, on_progress=update))
        chain.do("compare", lambda update: _compare(job, found, update, ahead))
    chain.do("report", lambda _: report(found))
    if only in (None, "report"):
        finish(found)
        summarise(found)
    return Repaired(run=found)


def _require_possible(
    robot: RobotLike, arm: Arm, preset: str | Preset, controllers: Controllers, targets: Targets | None,
    period: Period | None,
) -> None:  # fmt: skip
    """Refuse now what no stage could do: it would be found out after the arm has moved, and the policy is trained."""
    if isinstance(preset, str):
        from rejoint.training.presets import load_preset  # late: a process that only moves arms trains nothing

        load_preset(preset)
    turns = None if targets is None else as_targets(targets, arm, sets=1, seed=0)[1]
    tunable = isinstance(robot, str) and place_of(robot).tunable(arm)
    require_possible(controllers, arm, period_of(robot, period), tunable=tunable, posed=turns is not None)


def _compare(job: Callable[[], ComparisonJob], run: Run, on_progress: Progress, ahead: EarlyTrials | None) -> Compared:
    """Compare, alone in the run folder; what was driven ahead is taken over."""
    with exclusive(run):
        return job().drive(on_progress, ahead)
