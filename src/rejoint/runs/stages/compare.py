"""Comparison: every controller on the same arm, with the same targets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from secrets import token_hex
from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.inertia import LoadedArm
from rejoint.arms.postures import find_postures
from rejoint.control.comparison.compare import BLOCK, Ledger, TrialRunner
from rejoint.control.comparison.compare import Settings as TrialSettings
from rejoint.control.comparison.protocols import measure
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison, Driven, Key, Protocol, TargetErrors
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.controllers.policy import Policy
from rejoint.control.correction import ToolModel
from rejoint.control.recording import Observer, Recording, cycle_at_rest, pacing
from rejoint.control.robot import JointState, Robot
from rejoint.control.targets import in_mm
from rejoint.logs.history import setup_of
from rejoint.logs.runlog import RunLog
from rejoint.robots import is_virtual, open_robot
from rejoint.runs.history import summarise
from rejoint.runs.run import Run, staged
from rejoint.session.context import (
    ControllerMaker,
    Controllers,
    believed_motors,
    correction_of,
    guard_limits,
    is_name,
    named,
    stance_of,
)
from rejoint.session.inputs import (
    ArmLike,
    Borrowed,
    ControllerLike,
    Period,
    RobotLike,
    RunLike,
    Settings,
    Targets,
    address_of,
    as_targets,
)
from rejoint.session.session import Session
from rejoint.system.files import digest, require_space, saving, set_aside, write_json
from rejoint.system.progress import Progress
from rejoint.system.records import Readable, as_options, entity
from rejoint.system.shell import __version__
from rejoint.system.stopping import noted

DEFAULT = DefaultController.name


class OpenLoopTrials(NamedTuple):
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
    known = log.rows(np.flatnonzero(np.isfinite(log.target).all(axis=1)))
    target, time, visits = known.target, known.time, known.visits()
    index = np.repeat(np.arange(len(visits)), list(map(len, visits)))
    first = np.array([rows[0] for rows in visits])
    begun = time[np.maximum(first - 1, 0)]  # a target comes into force after the last row of the one before
    state = JointState(time=time, position=known.position, age=np.zeros(len(known)))
    cycles = cycle_at_rest(state, known.true_tcp, known.command)
    cycles = replace(cycles, target=target, aim=target, target_index=index, since_target=time - begun[index])
    recording = Recording(
        arm=log.arm,
        joint_names=log.joint_names,
        robot=log.robot,
        controller=DEFAULT,
        tripped=np.zeros(1, dtype=np.uint16),
        **vars(cycles.at(slice(None), None)),
    )
    targets, key = target[first], Key(DEFAULT, "hold", ((0, 0),))
    found = measure(arm, recording, targets[None], protocol, key, model=model)
    if not np.isfinite(found.columns["settled"]).all():
        return None
    return OpenLoopTrials(
        targets=targets, driven=replace(found, source=SOURCE), log=replace(log, label=found.key.label)
    )


SOURCE = "the diagnosis"
"""Source of the default controller's results"""


@entity
class Compared(Readable):
    """Result of a comparison."""

    comparison: Comparison
    """a row for each controller, with intervals"""
    recommendation: Recommendation
    logs: dict[str, RunLog] = field(default_factory=dict)
    """one per controller and protocol, such as ``hold-policy-0-0``"""


@entity
class ComparisonJob:
    """Inputs of a comparison."""

    robot: RobotLike
    arm: Arm
    trials: TrialRunner
    run: Run | None = None
    period: Period | None = None
    before: OpenLoopTrials | None = None
    """the diagnosis's trials of the first set, if used"""
    calibration: str = ""
    """date of the calibration, if any"""
    given: dict[str, str] = field(default_factory=dict)
    """what tells each given controller from others of its name"""

    def drive(self, on_progress: Progress) -> Compared:
        """Compare; in a run, resume and write."""
        run = self.run
        if run is None:
            return self._drive(Ledger(), on_progress)
        require_space(run.path)
        ledger = Ledger(run.folder.trials, self.fingerprint(run))
        try:
            found = self._drive(ledger, on_progress)
        except BaseException as error:
            if ledger.done:
                kept = f"{len(ledger.done)} finished trials are kept. The same command continues"
                error.add_note(f"{kept}, unless controllers of your own take part.")
            raise
        with saving(found):
            write_json(set_aside(run.folder.comparison), found.comparison)
            ledger.close()
            summarise(run)
        return found

    def _drive(self, ledger: Ledger, on_progress: Progress) -> Compared:
        logs, before, trials = {}, self.before, self.trials

        def keep(label: str, log: RunLog) -> None:
            logs[label.replace("/", "-")] = log  # as `Run.logs` calls it
            if self.run is not None:
                log.save(set_aside(self.run.folder.log(label)))

        def see(driven: Driven, recording: Recording) -> None:
            if (driven.key.places[0], driven.key.first) == ((0, 0), 0):  # one of each suffices for the figures
                keep(driven.key.label, recording.log(0, driven.key.label))

        with noted(), staged(self.run, "compare") as watch:
            runner = replace(
                trials,
                open_robot=lambda count, seed: watch(trials.open_robot(count, seed)),
                on_progress=on_progress,
                on_trial=see,
                ledger=ledger,
            )
            found = None  # of the uncorrected arm, where it is to be corrected
            if trials.correction is not None and trials.turns is None and DEFAULT in trials.controllers:
                found = TargetErrors.of(before.driven.columns) if before else runner.as_found()
            result = runner.compare()
        if before is not None and self.run is not None:
            keep(before.log.label, before.log)
        result = replace(
            result,
            as_found=found,
            robot=address_of(self.robot),
            arm=self.arm.name,
            period=self.period,
            calibration=self.calibration,
        )
        return Compared(comparison=result, recommendation=recommend(result), logs=logs)

    def fingerprint(self, run: Run) -> str:
        """Return what the trials depend on: those of another one are driven again."""
        used = run.folder.policy, run.folder.twin, run.folder.gains
        files = [digest(path.read_bytes()) for path in used if path.exists()]
        trials, turns = self.trials, self.trials.turns
        turned = turns and [part.tolist() for part in (turns.rotation, turns.whole, turns.weight)]
        options = self.period, trials.correction, self.before is None, turned
        tried = list(trials.controllers), self.given
        about = setup_of(self.arm), trials.settings, tried, trials.targets.tolist(), files, options
        return digest(repr((__version__, address_of(self.robot), about)).encode())


def _identity(given: ControllerLike) -> str:
    """Return what tells a controller from others of its name; nothing tells an own object."""
    if is_name(given):
        return given
    policy = Policy.load(given) if isinstance(given, Path | str) else given
    return digest(policy.content) if isinstance(policy, Policy) else token_hex()


SETS, REPETITIONS = 10, 6
"""Default target sets and repetitions (Park et al. 2024: six repetitions)"""

ONE_ARM_SETS = 1
"""Target sets on one arm; chosen: those of the diagnosis"""

ONE_ARM_PROTOCOL = Protocol(hold=4.0, crossings=False)
"""On one arm (chosen: holds of 4.5 s recommend the same on twelve arms of `python -m benchmarks elimination`)"""


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """Size of a comparison."""

    sets: int | None = None
    """drawn target sets; default: 10, on one arm 1"""
    repetitions: int | None = None
    """of each set by each controller; default: 6, on one arm 1"""
    protocol: Protocol | None = None
    """thresholds [m] and times [s], to which the longest planned way is added; default: Park et al. 2024, and holds of
    8 s; in a repair holds alone, on one arm of 4 s"""
    full: bool = False
    """on a real arm, eliminate only after three targets missed in a row; in a repair, drive crossings too"""


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

    Emulated arms run in parallel. On a real one, controllers take turns in blocks of targets; after three misses in a
    row, or if significantly worse, they are eliminated. The run's diagnosis counts as trials of ``default``. The same
    call resumes after the last finished trial, unless objects of your own take part: they may have changed.

    Parameters
    ----------
    robot
        robot or its address
    controllers
        baselines (``default``, ``integrator``, ``feedforward``), ``shelf``, ``predictive``, policies, their files, or
        your own; a mapping names them. If empty: baselines, ``shelf`` (a real arm: only without a policy), the run's
        policy, with a twin ``predictive``; after a search for servo gains these two under the gains found, and
        ``servo-gains``
    targets
        (K, 3) or (S, K, 3) [m], `Pose` objects, or a CSV file in mm (``x,y,z``, and orientations for baselines);
        on planned ways, whose time counts; default: ten drawn, on one arm first those of the diagnosis
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
        Session(robot, run=run, arm=arm, settings=settings, observer=observer) as session,
    ):
        return comparison_job(session, controllers, targets, as_options(plan, TrialPlan)).drive(update)


def comparison_job(
    session: Session, controllers: Controllers, targets: Targets | None, plan: TrialPlan
) -> ComparisonJob:
    """Assemble and validate a comparison on the arm of a session."""
    arm, run, twin, settings = session.arm, session.run, session.twin, session.settings
    robot = session.robot if settings.dry_run or session.given is None else session.given
    real = not is_virtual(robot)
    block = BLOCK if real and not plan.full else 0
    sets = (ONE_ARM_SETS if block else SETS) if plan.sets is None else plan.sets
    points, turns = as_targets(targets, arm, sets=sets, seed=session.seed)
    protocol, ways, longest = as_options(plan.protocol or (ONE_ARM_PROTOCOL if block else None), Protocol), None, 0.0
    motors = None if twin is None else believed_motors(arm, twin)
    if targets is None:
        places = points.reshape(-1, 3)
        postures = find_postures(arm, places, np.tile(arm.rest, (len(places), 1)), None)
        session.say_heavy(map(in_mm, places), postures, motors)
    else:
        ways = [session.ways(one, turns and turns[k], motors) for k, one in enumerate(points)]
        longest = round(0.05 + max(way.duration for row in ways for way in row), 1)
    sizes = TrialSettings(
        repetitions=(1 if block else REPETITIONS) if plan.repetitions is None else plan.repetitions,
        seed=session.seed,
        batched=not real,
        protocol=replace(
            protocol,
            crossings=protocol.crossings and not block,
            dwell=protocol.dwell + longest,
            hold=protocol.hold + longest,
        ),
        ways=longest,
        leave_out=not controllers,
        block=block,
    )
    model, before = session.calibration, None
    if block and run and targets is None and not isinstance(arm, LoadedArm) and session.address == run.robot:
        path = run.folder.log("targets")  # of the diagnosis
        before = open_loop_trials(run.arm, RunLog.load(path), sizes.protocol, model) if path.exists() else None
        points[0] = points[0] if before is None else before.targets
    factories = ControllerMaker(arm, session.period, run, twin).factories(
        controllers, real=real, posed=turns is not None
    )
    before = before if DEFAULT in factories else None

    def connect(count: int, seed: int) -> Robot:
        opened = (
            open_robot(robot, arm=arm, seed=seed, count=count, period=settings.period)
            if isinstance(robot, str)
            else Borrowed(robot)
        )
        return session.observer.watch(opened, twin=twin, within=sizes.protocol.threshold)

    trials = TrialRunner(
        connect,
        factories,
        points,
        sizes,
        turns=turns,
        ways=ways,
        limits=guard_limits(run, arm, address_of(robot)),
        stance=stance_of(twin, run),
        correction=correction_of(model, arm, points),
        model=model,
        measured=None if before is None else before.driven,
    )
    return ComparisonJob(
        robot=robot,
        arm=arm,
        trials=trials,
        run=run,
        period=settings.period,
        before=before,
        calibration=model.date if model else "",
        given={name: _identity(one) for name, one in named(controllers).items()},
    )
