"""The stages of a repair, each from files to files, and the run folder that ties them together.

A stage reads what the stages before it wrote, writes its own files whole or not at all, and so can be
repeated, resumed, replaced, or run on another machine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rejoint import __version__
from rejoint.arms import Arm, Array
from rejoint.comparison.compare import Settings, Trial, compare
from rejoint.comparison.ledger import Ledger
from rejoint.comparison.recommend import Recommendation, recommend
from rejoint.comparison.result import Comparison, Protocol
from rejoint.comparison.targets import draw_targets, read_targets
from rejoint.control.catalogue import BASELINES, make_controller
from rejoint.control.contract import check_period
from rejoint.control.controller import Controller
from rejoint.control.following import sticking
from rejoint.control.guard import GuardLimits
from rejoint.control.lines import servo_lines
from rejoint.control.policy import PolicyController
from rejoint.control.recording import Cycle, recording_of
from rejoint.control.robot import JointState, Robot
from rejoint.control.start import check_stance
from rejoint.deployment import Deployed, Deployment, deploy, deployed_of
from rejoint.errors import FileError, InputError, saving
from rejoint.files import digest, read_json, require_space, set_aside, write_json
from rejoint.journal import Journal
from rejoint.opening import Run, alone, begin, forget
from rejoint.robots import default_period, open_robot
from rejoint.runlog import RunLog, read_log, write_log
from rejoint.runs import LOGS, RunFolder
from rejoint.stopping import noted

if TYPE_CHECKING:  # these need the simulator, which a Raspberry Pi does not have
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.diagnosis.healthy import HealthyReference
    from rejoint.training.train import TrainingResult
    from rejoint.twin.fromlogs import LogIdentification
    from rejoint.twin.judge import Candidate
    from rejoint.twin.twin import Twin

OnProgress = Callable[[float, float, str], None]
"""Called with (done, total, what is being done)."""

Period = tuple[float, float]


def silent(done: float, total: float, text: str) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True, kw_only=True)
class Trials:
    """How much a comparison tries."""

    controllers: tuple[str, ...] = ()
    """names; empty: all baselines, and the policy where there is one"""
    sets: int = 2
    repetitions: int = 2
    file: Path | None = None
    """targets in mm instead of drawn ones"""
    protocol: Protocol = field(default_factory=Protocol)


@alone
def diagnose_stage(
    run: Run, *, period: Period | None = None, good: Path | None = None, on_progress: OnProgress = silent
) -> Diagnosis:
    """Excite the robot and write run logs and diagnosis; ``good`` is the run of an arm known to be good."""
    from rejoint.diagnosis.diagnosis import diagnose

    healthy = _healthy(run.arm, good)
    with noted(), closing(_connect(run, period)) as robot:
        require_space(run.folder.path)
        journal = _journal(run, "diagnosis", robot, "diagnosis")
        try:
            diagnosis, logs = diagnose(
                robot, healthy, seed=run.info.seed, on_cycle=journal.see,
                on_progress=lambda what, share: on_progress(share, 1.0, what),
            )  # fmt: skip
        except BaseException as error:
            error.add_note(journal.rescue())
            raise
        journal.close()
    with saving(diagnosis):
        for earlier in (run.folder.log("targets"), run.folder.log("excitation"), run.folder.diagnosis):
            set_aside(earlier)
        write_log(run.folder.log("targets"), logs.targets)
        write_log(run.folder.log("excitation"), logs.excitation)
        write_json(run.folder.diagnosis, diagnosis)
    journal.discard()
    return diagnosis


@alone
def identify_stage(run: Run, *, on_progress: OnProgress = silent) -> Twin:
    """Fit a twin to the excitation log and write it."""
    from rejoint.twin.file import write_twin
    from rejoint.twin.identify import IdentifySettings, identify

    if not run.folder.log("excitation").exists():
        robot, logs = run.info.robot, run.info.robot.removeprefix(LOGS)
        given = f"identify --logs {logs} --arm {run.arm.name}" if robot.startswith(LOGS) else f"diagnose {robot}"
        raise FileError(run.folder.log("excitation"), "no such file", f"run: rejoint {given} --run {run.folder.path}")
    log = read_log(run.folder.log("excitation"))
    twin = identify(
        run.arm, [log], IdentifySettings(seed=run.info.seed), lambda what, share: on_progress(share, 1.0, what)
    )
    run.folder.judgement.unlink(missing_ok=True)  # it was of another twin
    write_twin(run.folder.twin, twin)
    return twin


def _healthy(arm: Arm, good: Path | None) -> HealthyReference | None:
    """Take the reference of an arm from the run of one known to be good, else the emulated one of its kind."""
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.diagnosis.healthy import healthy_reference
    from rejoint.diagnosis.knowngood import reference_by

    return (
        healthy_reference(arm) if good is None else reference_by(arm, read_json(RunFolder(good).diagnosis, Diagnosis))
    )


@alone
def diagnose_logs_stage(
    run: Run, logs: Sequence[RunLog], *, good: Path | None = None, on_progress: OnProgress = silent
) -> Diagnosis:
    """Judge an arm by logs of any motion and write the diagnosis into a run folder; ``good`` as in `diagnose_stage`."""
    from rejoint.diagnosis.fromlogs import diagnose_logs

    diagnosis = diagnose_logs(
        run.arm, logs, _healthy(run.arm, good), source=run.info.robot,
        on_progress=lambda what, share: on_progress(share, 1.0, what),
    )  # fmt: skip
    begin(run.folder.path, run.info.robot, run.arm, run.info.seed)
    write_json(run.folder.diagnosis, diagnosis)
    return diagnosis


@alone
def identify_logs_stage(
    run: Run, logs: Sequence[RunLog], beside: Sequence[Candidate] = (), *, on_progress: OnProgress = silent
) -> LogIdentification:
    """Fit a twin to logs of any motion; write it, and how it and those ``beside`` it predict, into a run folder."""
    from rejoint.twin.file import write_twin
    from rejoint.twin.fromlogs import identify_logs

    found = identify_logs(run.arm, logs, on_progress=lambda what, share: on_progress(share, 1.0, what), beside=beside)
    begin(run.folder.path, run.info.robot, run.arm, run.info.seed)
    run.folder.judgement.unlink(missing_ok=True)  # it was of another twin
    write_twin(run.folder.twin, found.twin)
    write_json(run.folder.judgement, found.judgement)
    return found


@alone
def train_stage(
    run: Run, *, preset: str = "default", learner: str = "ppo", resume: bool = True, on_progress: OnProgress = silent
) -> TrainingResult:
    """Train a policy on the twin (or, without one, on broad ranges); ``learner`` is ppo, sac, td3 or ddpg."""
    from rejoint.training.train import TrainingOptions, train

    if learner != "ppo":
        if preset != "default":
            raise InputError(f"--preset {preset} is a recipe of PPO; {learner} trains on the default one: leave it out")
        from rejoint.training.offpolicy import OffPolicySettings, algorithm, train_offpolicy

        settings = OffPolicySettings(algorithm=algorithm(learner), seed=run.info.seed)
        return train_offpolicy(run.arm, _twin(run), out=run.folder.path, settings=settings, on_progress=on_progress)
    options = TrainingOptions(preset=preset, seed=run.info.seed, resume=resume)
    return train(run.arm, _twin(run), out=run.folder.path, options=options, on_progress=on_progress)


@alone
def compare_stage(
    run: Run,
    robot: str,
    trials: Trials,
    *,
    period: Period | None = None,
    on_progress: OnProgress = silent,
) -> tuple[Comparison, Recommendation]:
    """Try every controller on ``robot`` and write what came out; returns it, the recommendation and why."""
    targets = (
        draw_targets(run.arm, sets=trials.sets, seed=run.info.seed)
        if trials.file is None
        else read_targets(trials.file, run.arm)[None]
    )

    def connect(count: int, seed: int) -> Robot:
        return open_robot(robot, arm=run.arm, seed=seed, count=count, period=period, threads=2)

    require_space(run.folder.path)
    settings = Settings(
        repetitions=trials.repetitions, seed=run.info.seed, batched=robot.startswith("emulated:"),
        protocol=trials.protocol, leave_out=not trials.controllers,
    )  # fmt: skip
    factories = _factories(run, trials.controllers, period or default_period(robot))
    ledger = Ledger.begin(run.folder.trials, _comparison_name(run, robot, targets, settings, tuple(factories), period))
    earlier = [] if ledger.done else list(run.folder.trial_logs())

    def keep(trial: Trial) -> None:
        while earlier:  # logs of another comparison make room for the first of this one
            set_aside(earlier.pop())
        if (trial.target_set, trial.repetition) == (0, 0):  # one of each suffices for the figures
            write_log(run.folder.log(trial.label), trial.log())

    try:
        with noted():
            result = compare(
                connect,
                factories,
                targets,
                settings,
                on_progress=on_progress,
                on_trial=keep,
                ledger=ledger,
                limits=_limits(run, robot),
            )
    except BaseException as error:
        if ledger.done:
            error.add_note(f"What was tried until then is kept ({len(ledger.done)} runs): the same command goes on.")
        else:
            ledger.close()
        raise
    file = "" if trials.file is None else str(trials.file)
    result = replace(result, targets_file=file, period=period)
    found = result, recommend(result)
    with saving(found):
        set_aside(run.folder.comparison)
        write_json(run.folder.comparison, result)
        ledger.close()
    return found


def _comparison_name(
    run: Run, robot: str, targets: Array, settings: Settings, names: tuple[str, ...], period: Period | None
) -> str:
    """Digest of all that decides what a comparison finds."""
    files = [digest(path.read_bytes()).decode() for path in (run.folder.policy, run.folder.twin) if path.exists()]
    about = (__version__, robot, repr(run.arm), repr(settings), names, period, files, targets.tolist())
    return digest(repr(about).encode()).decode()


@alone
def deploy_stage(
    run: Run,
    robot: str,
    job: Deployment,
    period: Period | None = None,
    *,
    on_progress: OnProgress = silent,
    on_end: Callable[[Deployed], object] = lambda _: None,
) -> Deployed:
    """Drive a robot to its rest posture and through the targets of ``job``; returns what became of each.

    Where something ends it early, ``on_end`` is told what was done until then, and what was recorded is kept, also
    where it is ``kill -9``. UnsavedError with the result where the log cannot be written.
    """
    twin, limits = _twin(run), _limits(run, robot)
    controller = _factories(run, (job.controller,), period or default_period(robot))[job.controller](run.arm)
    require_space(run.folder.path)
    label, total = f"deploy/{job.controller}", len(job.targets)
    rows = int(total * job.dwell / min(period or default_period(robot)))

    def expected(state: JointState, sent: Array) -> None:
        if twin is not None:
            check_stance(run.arm, state, sent, twin.parameters.stiffness, twin.parameters.offset)

    with noted(), closing(open_robot(robot, arm=run.arm, seed=run.info.seed, period=period)) as connection:
        journal = _journal(run, "deploy", connection, label, rows)

        def watch(cycle: Cycle) -> None:
            journal.see(cycle)
            target, share = int(cycle.target_index[0]), float(cycle.since_target[0]) / job.dwell
            on_progress(target + min(share, 1.0), total, f"target {target + 1} of {total}")

        try:
            recording, found = deploy(connection, controller, job, limits=limits, on_start=expected, on_cycle=watch)
        except BaseException as error:
            partial, done = recording_of(error), deployed_of(error, run.arm, job)
            if partial is not None and len(partial.time):
                error.add_note(journal.keep(partial.log(0, f"{label}/stopped")))
            else:
                journal.discard()
            if done is not None:
                on_end(done)
            raise
    with saving(found):
        journal.finish(recording.log(0, label))
    return found


@alone
def report_stage(run: Run) -> Path:
    """Write the report of all that a run folder holds; returns the page's path."""
    from rejoint.report.page import write_report

    return write_report(run.folder.path)


def _connect(run: Run, period: Period | None) -> Robot:
    """Open the robot of a run; one that does not answer leaves no folder behind."""
    try:
        return open_robot(run.info.robot, arm=run.arm, seed=run.info.seed, period=period)
    except InputError:
        forget(run)
        raise


def _journal(run: Run, name: str, robot: Robot, label: str, rows: int = 0) -> Journal:
    """Begin the journal of a run log whose name ends with the time."""
    path = run.folder.log(f"{name}-{datetime.now():%Y%m%d-%H%M%S}")
    return Journal.begin(
        path, arm=run.arm.name, joint_names=run.arm.joint_names, robot=robot.address, label=label, rows=rows
    )


def _limits(run: Run, robot: str) -> GuardLimits:
    """Return what the guard allows, and, if ``robot`` is the run's own, what its diagnosis tells of its joints.

    That is how far they stick, and the lines of load over error of servos that tell loads.
    """
    limits, paths = GuardLimits.of(run.arm), [run.folder.log(name) for name in ("excitation", "targets")]
    if not _is_own(run, robot) or not all(path.exists() for path in paths):
        return limits
    logs = [read_log(path) for path in paths]
    sticks = np.max([sticking(run.arm, log) for log in logs], axis=0)
    return replace(limits, sticks=sticks, servos=servo_lines(run.arm, logs))


def _is_own(run: Run, robot: str) -> bool:
    """Whether ``robot`` may be the arm that a run measured: a real one has many addresses, an emulated one has one."""
    own = run.info.robot
    return robot == own or not any(address.startswith("emulated:") for address in (own, robot))


def _twin(run: Run) -> Twin | None:
    if not run.folder.twin.exists():
        return None
    from rejoint.twin.file import read_twin

    return read_twin(run.folder.twin, run.arm)


def _factories(run: Run, names: tuple[str, ...], period: Period) -> Mapping[str, Callable[[Arm], Controller]]:
    """Make controllers by name; the feed-forward believes the twin's stiffness where there is a twin.

    A name, a policy file or a control period that does not fit is refused here, before anything moves.
    """
    policy = run.folder.policy if run.folder.policy.exists() else None
    names = names or (*BASELINES, *(("policy",) if policy else ()))
    twin = _twin(run)
    known = {} if twin is None else {"stiffness": twin.parameters.stiffness}

    def factory(name: str) -> Callable[[Arm], Controller]:
        return lambda arm: make_controller(name, arm, policy=policy, **known)

    for name in names:
        controller = factory(name)(run.arm)
        if isinstance(controller, PolicyController):
            check_period(controller.contract, sum(period) / 2)
    return {name: factory(name) for name in names}
