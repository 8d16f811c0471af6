"""Comparison: every controller on the same arm, with the same targets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm
from rejoint.control.catalogue import ON_REQUEST
from rejoint.control.comparison.compare import Settings
from rejoint.control.comparison.racing import Race
from rejoint.control.comparison.result import Protocol
from rejoint.diagnosis.open_loop import DWELL
from rejoint.runs.given import (
    ArmLike,
    CalibrationLike,
    Live,
    Period,
    RobotLike,
    RunLike,
    Targets,
    TwinLike,
    address_of,
    arm_of,
    as_run,
    as_targets,
    as_twin,
    is_batchable,
    period_of,
)
from rejoint.runs.openloop import open_loop
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.comparing import Compared, ComparisonJob
from rejoint.runs.stages.controllers import Controllers, all_named, listed, make_factories
from rejoint.runs.stages.known import calibration_of, correction_of
from rejoint.runs.stages.loads import PayloadLike, Say, say_heavy, silent, with_load
from rejoint.system.numbers import as_seed
from rejoint.system.progress import Progress, no_progress, paced

SETS, REPETITIONS = 10, 6
"""Target sets and repetitions where arms are emulated or all is driven (Park et al. 2024: six repetitions)"""

RACE_SETS = 1
"""Target sets of a race at most (chosen: those of the diagnosis. Twenty targets instead of ten decide hardly more, as
`python -m benchmarks.racing --sets 2` shows)"""

RACE_PROTOCOL = Protocol(hold=DWELL)
"""A race holds each target as long as the diagnosis does, so that both measure the same"""


@paced
def compare(
    robot: RobotLike,
    controllers: Controllers = (),
    targets: Targets | None = None,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    twin: TwinLike | None = None,
    calibration: CalibrationLike | None = None,
    payload: PayloadLike | None = None,
    tool: ArrayLike | None = None,
    sets: int | None = None,
    repetitions: int | None = None,
    protocol: Protocol | None = None,
    period: Period | None = None,
    directions: bool = False,
    seed: int | None = None,
    full: bool = False,
    on_progress: Progress = no_progress,
    say: Say = silent,
    live: Live | None = None,
) -> Compared:
    """Try controllers on the same arm, with the same targets, from the same start, and recommend one.

    Emulated arms are tried side by side; on a real one the controllers race: the trials take turns, who misses three
    targets in a row, is beaten beyond doubt, or is no better by what matters than a simpler one is driven no further,
    and it ends when one is left, or after all sets.
    What the diagnosis of the run measured open loop is not driven again: it is what ``default`` does. While an arm
    moves, Ctrl-C and SIGTERM first bring it to a hold; then `Interrupted` is raised, which is a KeyboardInterrupt. In a
    run, the same call then goes on after the last finished trial.

    Parameters
    ----------
    robot
        robot or its address
    controllers
        names of baselines (``default``, ``pid-sum``, ``pid-literal``, ``integrator``, ``feedforward``), ``push``,
        ``shelf``, ``predictive``, policies, their files, or controllers of your own; a mapping names them. None given:
        all baselines, on a real arm without the paper's PIDs (``pid-sum``, ``pid-literal``), the policy that comes with
        the package (``shelf``) where it suits, on a real arm only where the run has no policy, the policy of the run,
        and predictive control where there is a twin; after a search for gains of the servos these two under the gains
        found, and ``servo-gains`` and ``servo-gains+push`` beside them
    targets
        (K, 3) or (S, K, 3) [m], or `Pose` objects, or a CSV file in mm with the header ``x,y,z`` and perhaps columns
        of an orientation, which only baselines heed; by default drawn, ten in a set; in a race the first ten are those
        of the diagnosis
    run
        run, or its folder, with the policy and the twin, into which results are written; without one nothing is
    arm
        arm, name or file; needed only without a run, where the address does not tell
    twin
        twin whose stiffness the feed-forward controller believes, on which predictive control plans, and as
        which a real arm must stand; by default that of the run
    calibration
        what lies behind the encoders, or its file: all controllers are aimed by it; ``none`` for no correction. By
        default that of ``run``
    payload
        [kg] that the hand carries at its tool centre point, or a `Payload`; everything is computed with it
    tool
        (3,) [m] from the tool centre point of the arm's description to the tip of a tool, in the frame of the former
    sets
        number of target sets that are drawn; by default 10, in a race at most 1
    repetitions
        number of times that each set is driven to by each controller; by default 6, in a race 1
    protocol
        thresholds [m] and times [s] of a trial; by default those of Park et al. 2024, and holds of eight seconds, in a
        race of five, as in the diagnosis
    period
        [s] interval of the control periods; by default what the robot suits
    directions
        whether the recommended controller also comes to five poses from three directions, in as many cycles as there
        are repetitions: vAP after ISO 9283 (on a real arm four minutes a cycle)
    seed
        of targets and an emulated arm's noise; by default that of the run, else 0
    full
        no race: a real arm is driven to all targets with every controller that does not miss three in a row
    on_progress
        called with the share that is done and what is being tried
    say
        told, in lines, which targets are too heavy, before an arm moves
    live
        shows the arm meanwhile: a `LiveView`

    Returns
    -------
    Compared
        ``recommendation``, the whole ``comparison``, and one log of each controller

    Raises
    ------
    InputError, ContractError
        if a controller, its control period or the targets do not fit; nothing has moved
    GuardTripError, RobotError
        if the motion of a real arm had to be ended
    UnsavedError
        if the result could not be written; it is in the error

    Examples
    --------
    >>> found = rejoint.compare("emulated:worn", ["integrator", policy], sets=1, repetitions=2)
    >>> print(found.recommendation.controller, *found.recommendation.why)
    >>> print(found.comparison.row("integrator").hold.settled.mean.value)  # metres
    """
    about = None if run is None else as_run(run).seeded(seed)
    chosen = arm_of(robot, arm) if about is None else about.arm
    with exclusive(about):
        return comparison_job(
            robot, controllers, targets, run=about, arm=chosen, twin=twin, calibration=calibration, payload=payload,
            tool=tool, sets=sets, repetitions=repetitions, protocol=protocol, period=period, directions=directions,
            seed=as_seed(seed) if about is None else about.seed, full=full, say=say, live=live,
        ).drive(on_progress)  # fmt: skip


def comparison_job(
    robot: RobotLike, controllers: Controllers, targets: Targets | None, *, run: Run | None, arm: Arm, seed: int,
    twin: TwinLike | None = None, calibration: CalibrationLike | None = None, payload: PayloadLike | None = None,
    tool: ArrayLike | None = None, sets: int | None = None, repetitions: int | None = None,
    protocol: Protocol | None = None, period: Period | None = None, directions: bool = False, full: bool = False,
    paper: bool = True, say: Say = silent, live: Live | None = None,
) -> ComparisonJob:  # fmt: skip
    """Put together what `compare` is to do, in a ``run`` or without one, and refuse what does not fit.

    Without ``paper`` the paper's PIDs (`ON_REQUEST`) take part only where they are named.
    """
    chosen, controllers = with_load(arm, robot, payload, tool), listed(controllers)
    real = not is_batchable(robot)
    race = Race() if real and not full else None
    points, turns = as_targets(
        targets, chosen, sets=(SETS if race is None else RACE_SETS) if sets is None else sets, seed=seed
    )
    known = as_twin(twin) if twin is not None else None if run is None else run.twin
    say_heavy(chosen, known, points, say, turns)
    factories = make_factories(
        controllers, chosen, period_of(robot, period), run=run, twin=known, real=real, posed=turns is not None
    )
    if not (controllers or paper):
        factories = {name: make for name, make in factories.items() if name not in ON_REQUEST}
    settings = Settings(
        repetitions=(REPETITIONS if race is None else 1) if repetitions is None else repetitions,
        seed=seed, batched=not real,
        protocol=protocol or (Protocol() if race is None else RACE_PROTOCOL), leave_out=not controllers, race=race,
    )  # fmt: skip
    model = calibration_of(calibration, run, chosen, address_of(robot))
    before = None
    if race is not None and run is not None and payload is None and tool is None and turns is None:
        before = open_loop(run, address_of(robot), settings.protocol, model)
    if before is not None and targets is None:
        points[0] = before.targets
    return ComparisonJob(
        robot=robot, arm=chosen, run=run, factories=factories, targets=points, settings=settings, period=period,
        twin=known, correct=correction_of(calibration, run, chosen, address_of(robot), points),
        model=model, live=live, by_name=all_named(controllers), directions=directions, turns=turns,
        file=str(targets) if isinstance(targets, Path | str) else "",
        before=before if before is not None and np.array_equal(points[0], before.targets) else None,
    )  # fmt: skip
