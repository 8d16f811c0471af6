"""Comparison: every controller on the same arm, with the same targets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.inertia import LoadedArm
from rejoint.control.comparison.compare import BLOCK, Ledger, TrialRunner
from rejoint.control.comparison.compare import Settings as TrialSettings
from rejoint.control.comparison.protocols import measure
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison, Driven, Key, Protocol, TargetErrors
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.correction import ToolModel
from rejoint.control.recording import Observer, Recording, cycle_at_rest, pacing
from rejoint.control.robot import JointState, Robot
from rejoint.diagnosis.open_loop import DWELL
from rejoint.logs.runlog import RunLog
from rejoint.robots import open_robot
from rejoint.runs.history import summarise
from rejoint.runs.run import Run, staged
from rejoint.session.context import ControllerMaker, Controllers, correction_of, guard_limits, say_heavy, stance_of
from rejoint.session.inputs import ArmLike, Borrowed, RobotLike, RunLike, Settings, Targets, as_targets, is_batchable
from rejoint.session.session import ArmSession
from rejoint.system.errors import GuardTripError
from rejoint.system.files import digest, require_space, saving, set_aside, write_json
from rejoint.system.results import Readable
from rejoint.system.shell import __version__
from rejoint.system.stopping import noted

DEFAULT = DefaultController.name


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenLoopTrials:
    """Ten targets, each sent once."""

    targets: Array
    """(K, 3) [m]"""
    driven: Driven
    """one arm at its first set"""
    log: RunLog
    """as of a hold trial"""


def open_loop_trials(
    arm: Arm, log: RunLog, protocol: Protocol, model: ToolModel | None = None
) -> OpenLoopTrials | None:
    """Judge an open-loop log as trials; None if its holds are too short."""
    recording, targets = _recording(log)
    found = measure(arm, recording, targets[None], protocol, Key(DEFAULT, "hold", ((0, 0),)), model=model, both=True)
    if not np.isfinite(found.columns["settled"]).all():
        return None
    return OpenLoopTrials(
        targets=targets, driven=replace(found, source=SOURCE), log=replace(log, label=found.key.label)
    )


def _recording(log: RunLog) -> tuple[Recording, Array]:
    """Log as a recording, and its targets (K, 3) [m]."""
    known = np.isfinite(log.target).all(axis=1)
    rows = np.flatnonzero(known)
    target, time = log.target[rows], log.time[rows]
    index = np.concatenate([[0], np.cumsum((target[1:] != target[:-1]).any(axis=1))])
    first = np.searchsorted(index, np.arange(index[-1] + 1))
    begun = time[np.maximum(first - 1, 0)]  # a target comes into force after the last row of the one before
    state = JointState(time=time, position=log.position[rows], age=np.zeros(len(rows)))
    cycles = cycle_at_rest(state, log.true_tcp[rows], log.command[rows])
    cycles = replace(cycles, target=target, aim=target, target_index=index, since_target=time - begun[index])
    return Recording(
        arm=log.arm,
        joint_names=log.joint_names,
        robot=log.robot,
        controller=DEFAULT,
        tripped=np.zeros(1, dtype=np.uint16),
        **{name: values[:, None].copy() for name, values in vars(cycles).items()},
    ), target[first]


SOURCE = "the diagnosis"
"""Source of the default controller's results"""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Compared(Readable):
    """Result of a comparison."""

    comparison: Comparison
    """a row for each controller, with intervals"""
    recommendation: Recommendation
    logs: dict[str, RunLog] = field(default_factory=dict)
    """one per controller and protocol, such as ``hold-policy-0-0``"""


SETS, REPETITIONS = 10, 6
"""Default target sets and repetitions (Park et al. 2024: six repetitions)"""

THREADS = 2
"""of emulated arms; no effect on results"""

ONE_ARM_SETS = 1
"""Target sets on one arm; chosen: those of the diagnosis"""

ONE_ARM_PROTOCOL = Protocol(hold=DWELL)
"""On one arm, with the holds of the diagnosis"""


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """Size of a comparison."""

    sets: int | None = None
    """drawn target sets; default: 10, on one arm 1"""
    repetitions: int | None = None
    """of each set by each controller; default: 6, on one arm 1"""
    protocol: Protocol | None = None
    """thresholds [m] and times [s]; default: Park et al. 2024, holds of 8 s, on one arm 5 s"""
    full: bool = False
    """on a real arm, eliminate only after three targets missed in a row"""


def compare(
    robot: RobotLike,
    controllers: Controllers = (),
    targets: Targets | None = None,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    plan: TrialPlan | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Compared:
    """Try controllers on the same arm, with the same targets, from the same start, and recommend one.

    Emulated arms run side by side. On a real one, controllers take turns in blocks of targets; after three misses in a
    row, or if significantly worse, they are eliminated. The run's diagnosis counts as trials of ``default``. The same
    call resumes after the last finished trial.

    Parameters
    ----------
    robot
        robot or its address
    controllers
        baselines (``default``, ``integrator``, ``feedforward``), ``shelf``, ``predictive``, policies, their files, or
        your own; a mapping names them. Default: baselines, ``shelf`` (a real arm: only without a policy), the run's
        policy, with a twin ``predictive``; after a search for servo gains these two under the gains found, and
        ``servo-gains``
    targets
        (K, 3) or (S, K, 3) [m], `Pose` objects, or a CSV file in mm (``x,y,z``, and orientations for baselines);
        default: ten drawn, on one arm first those of the diagnosis
    run
        run, or its folder, for policy, twin and results; default: nothing is written
    arm
        arm, name or file, if neither run nor address tells
    plan
        sets, repetitions, protocol, elimination
    settings
        twin, calibration, payload, period, seed
    observer
        receives messages, progress, and each trial

    Returns
    -------
    Compared
        ``recommendation``, ``comparison``, logs

    Raises
    ------
    InputError, ContractError
        if controller, period or targets do not fit; nothing has moved
    GuardTripError, RobotError
        if a real arm's motion was ended
    UnsavedError
        if writing failed; the error holds the result

    Examples
    --------
    >>> found = rejoint.compare("emulated:worn", ["integrator", policy])
    >>> print(found.recommendation.controller, *found.recommendation.why)
    >>> print(found.comparison.row("integrator").settled.mean.value)  # metres
    """
    with (
        pacing(observer) as update,
        ArmSession(robot, run=run, arm=arm, settings=settings, observer=observer) as session,
    ):
        runner, before = _trials(session, controllers, targets, plan or TrialPlan())
        runner.on_progress, about = update, session.run
        if about is not None:
            require_space(about.path)
            runner.ledger = Ledger(about.folder.trials, _digest(session, about, runner))
        result, logs = _drive(session, runner, before)
        result = replace(
            result,
            robot=session.address,
            arm=session.arm.name,
            targets_file=str(targets) if isinstance(targets, Path | str) else "",
            period=session.settings.period,
            calibration="" if session.calibration is None else session.calibration.date,
        )
        found = Compared(comparison=result, recommendation=recommend(result), logs=logs)
        if about is not None:
            with saving(found):
                set_aside(about.folder.comparison)
                write_json(about.folder.comparison, result)
                runner.ledger.close()
                summarise(about)
        return found


def _trials(
    session: ArmSession, controllers: Controllers, targets: Targets | None, plan: TrialPlan
) -> tuple[TrialRunner, OpenLoopTrials | None]:
    """Assemble and validate the trials of a comparison, and those of the diagnosis that it takes over."""
    arm, run, twin = session.arm, session.run, session.twin
    robot = session.robot if session.settings.dry_run or session.given is None else session.given
    real = not is_batchable(robot)
    block = BLOCK if real and not plan.full else 0
    sets = (ONE_ARM_SETS if block else SETS) if plan.sets is None else plan.sets
    points, turns = as_targets(targets, arm, sets=sets, seed=session.seed)
    say_heavy(arm, twin, points, session.observer.message, turns)
    settings = TrialSettings(
        repetitions=(1 if block else REPETITIONS) if plan.repetitions is None else plan.repetitions,
        seed=session.seed,
        batched=not real,
        protocol=plan.protocol or (ONE_ARM_PROTOCOL if block else Protocol()),
        leave_out=not controllers,
        block=block,
    )
    model, before = session.calibration, None
    if block and run is not None and not isinstance(arm, LoadedArm) and turns is None and session.address == run.robot:
        path = run.folder.log("targets")  # of the diagnosis
        before = open_loop_trials(run.arm, RunLog.load(path), settings.protocol, model) if path.exists() else None
    if before is not None and targets is None:
        points[0] = before.targets
    maker = ControllerMaker(arm, session.period, run, twin)
    factories = maker.factories(controllers, real=real, posed=turns is not None)
    if before is not None and not (DEFAULT in factories and np.array_equal(points[0], before.targets)):
        before = None

    def opened(count: int, seed: int) -> Robot:
        found: Robot = (
            open_robot(robot, arm=arm, seed=seed, count=count, period=session.settings.period, threads=THREADS)
            if isinstance(robot, str)
            else Borrowed(robot)
        )
        return session.observer.watch(found, twin=twin, within=settings.protocol.threshold)

    runner = TrialRunner(
        opened,
        factories,
        points,
        settings,
        turns=turns,
        limits=guard_limits(run, arm, session.address),
        stance=stance_of(twin, run),
        correction=correction_of(model, arm, points),
        model=model,
        measured=None if before is None else before.driven,
    )
    return runner, before


def _drive(
    session: ArmSession, runner: TrialRunner, before: OpenLoopTrials | None
) -> tuple[Comparison, dict[str, RunLog]]:
    """Compare; the run keeps logs, and finished trials also after an error."""
    logs: dict[str, RunLog] = {}

    def keep(label: str, log: RunLog) -> None:
        logs[label.replace("/", "-")] = log  # as `Run.logs` calls it
        if session.run is not None:
            set_aside(session.run.folder.log(label))
            log.save(session.run.folder.log(label))

    def see(driven: Driven, recording: Recording) -> None:
        if (driven.key.places[0], driven.key.first) == ((0, 0), 0):  # one of each suffices for the figures
            keep(driven.key.label, recording.log(0, driven.key.label))

    opened = runner.open_robot
    try:
        with noted(), staged(session.run, "compare") as watch:
            runner.open_robot, runner.on_trial = lambda *about: watch(opened(*about)), see
            result = _beside(runner, before)
        if before is not None and session.run is not None:
            keep(before.log.label, before.log)
    except BaseException as error:
        if session.run is not None and (done := len(runner.ledger.done)):
            error.add_note(f"What was tried until then is kept ({done} runs): the same command goes on.")
        raise
    return result, logs


def _beside(runner: TrialRunner, before: OpenLoopTrials | None) -> Comparison:
    """Compare, and see what the uncorrected arm does where it is to be corrected."""
    result = runner.compare()
    if runner.correction is None or runner.turns is not None or DEFAULT not in runner.controllers:
        return result
    try:
        return replace(result, as_found=TargetErrors.of(before.driven.columns) if before else runner.as_found())
    except GuardTripError as error:  # it is not worth a comparison that is decided
        told = f"What is driven beside a comparison was ended early, and the rest of it left out: {error}."
        return replace(result, left_out=(*result.left_out, told))


def _digest(session: ArmSession, run: Run, runner: TrialRunner) -> str:
    """Digest of all that the finished trials of a comparison depend on."""
    folder, turns = run.folder, runner.turns
    files = [digest(path.read_bytes()) for path in (folder.policy, folder.twin, folder.gains) if path.exists()]
    turned = turns and [part.tolist() for part in (turns.rotation, turns.whole, turns.weight)]
    options = session.settings.period, runner.correction, runner.measured is None, turned
    about = session.arm, runner.settings, list(runner.controllers), runner.targets.tolist(), files, options
    return digest(repr((__version__, session.address, about)).encode()).decode()
