"""The stages of a repair, each from files to files, and the run folder that ties them together.

A stage reads what the stages before it wrote, writes its own files whole or not at all, and so can be
repeated, resumed, replaced, or run on another machine.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

import numpy as np

from rejoint import __version__
from rejoint.arms import CATALOGUE, Arm, Array, load_arm, tcp_position, write_arm_toml
from rejoint.comparison.compare import Settings, Trial, compare
from rejoint.comparison.recommend import Recommendation, recommend
from rejoint.comparison.result import Comparison, Protocol
from rejoint.comparison.targets import draw_targets, read_targets
from rejoint.control.catalogue import BASELINES, make_controller
from rejoint.control.contract import check_period
from rejoint.control.controller import Controller
from rejoint.control.loop import Schedule
from rejoint.control.loop import run as drive
from rejoint.control.policy import PolicyController
from rejoint.control.recording import recording_of
from rejoint.control.robot import Robot
from rejoint.errors import FileError, InputError
from rejoint.robots import default_period, open_robot
from rejoint.runs import LOGS, RunFolder, RunInfo, RunLog, alone, read_json, read_log, set_aside, write_json, write_log

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
Given = ParamSpec("Given")
Result = TypeVar("Result")

RUNS = Path("runs")
"""Where run folders are made, in the folder one stands in."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Deployment:
    """What an arm is to do."""

    controller: str
    targets: Array
    """(K, 3) [m]"""
    dwell: float
    """[s] per target"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One repair: where its files are and what it is about."""

    folder: RunFolder
    info: RunInfo
    arm: Arm


def begin(path: Path, robot: str, arm: Arm, seed: int) -> Run:
    """Open the run folder at ``path``, or make it; InputError if it belongs to another robot."""
    run = prepare(path, robot, arm, seed)
    if not run.folder.info.exists():
        if arm.name not in CATALOGUE:
            write_arm_toml(path / "arm.toml", arm)
        write_json(run.folder.info, run.info)
    return run


def prepare(path: Path, robot: str, arm: Arm, seed: int) -> Run:
    """Open the run folder at ``path``, or say what `begin` will make of it, without writing; errors as there."""
    folder = RunFolder(path)
    if folder.info.exists():
        run = open_run(path)
        if (run.info.robot, run.arm.name, run.info.seed) != (robot, arm.name, seed):
            raise InputError(
                f"{path} is a run of {run.info.robot} ({run.arm.name}, seed {run.info.seed}), "
                f"expected {robot} ({arm.name}, seed {seed}); give another --run"
            )
        return run
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path} is not a run folder and not empty; give another --run")
    created = datetime.now().isoformat(timespec="seconds")
    info = RunInfo(robot=robot, arm=arm.name, seed=seed, version=__version__, created=created)
    return Run(folder=folder, info=info, arm=arm)


def open_run(path: Path) -> Run:
    """Open an existing run folder; FileError if it is none."""
    folder = RunFolder(path)
    if not folder.info.exists():
        within = sorted(p.parent.name for p in path.glob("*/run.json"))
        begin = "start with: rejoint diagnose ROBOT --run FOLDER"
        hint = f"it holds runs, name one of: {', '.join(within)}" if within else begin
        raise FileError(path, "no run folder (it holds no run.json)", hint)
    info = read_json(folder.info, RunInfo)
    return Run(folder=folder, info=info, arm=load_arm(folder.arm(info.arm)))


def newest_or_new(robot: str, arm: Arm, seed: int) -> tuple[Path, bool]:
    """Default run folder of a robot: the newest one if it was interrupted, else a new one.

    Returns the path and whether it is to be resumed.
    """
    home = RUNS / re.sub(r"[^\w.-]+", "-", f"{arm.name}-{robot}-seed{seed}").strip("-")
    numbers = sorted(int(p.name) for p in home.glob("*") if p.name.isdecimal()) if home.is_dir() else []
    if numbers and not RunFolder(home / f"{numbers[-1]:03}").report.exists():
        return home / f"{numbers[-1]:03}", True
    return home / f"{(numbers[-1] if numbers else 0) + 1:03}", False


def _alone(stage: Callable[Concatenate[Run, Given], Result]) -> Callable[Concatenate[Run, Given], Result]:
    """Let no other process work in the run folder during a stage."""

    @wraps(stage)
    def working(run: Run, /, *arguments: Given.args, **options: Given.kwargs) -> Result:
        with alone(run.folder):
            return stage(run, *arguments, **options)

    return working


@_alone
def diagnose_stage(
    run: Run, *, period: Period | None = None, good: Path | None = None, on_progress: OnProgress = silent
) -> Diagnosis:
    """Excite the robot and write run logs and diagnosis; ``good`` is the run of an arm known to be good."""
    from rejoint.diagnosis.diagnosis import diagnose

    healthy = _healthy(run.arm, good)
    robot = open_robot(run.info.robot, arm=run.arm, seed=run.info.seed, period=period)
    try:
        diagnosis, logs = diagnose(
            robot,
            healthy,
            seed=run.info.seed,
            on_progress=lambda what, share: on_progress(share, 1.0, what),
        )
    finally:
        robot.close()
    write_log(run.folder.log("targets"), logs.targets)
    write_log(run.folder.log("excitation"), logs.excitation)
    write_json(run.folder.diagnosis, diagnosis)
    return diagnosis


@_alone
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
    write_twin(run.folder.twin, twin)
    run.folder.judgement.unlink(missing_ok=True)  # it was of another twin
    return twin


def _healthy(arm: Arm, good: Path | None) -> HealthyReference | None:
    """Take the reference of an arm from the run of one known to be good, else the emulated one of its kind."""
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.diagnosis.healthy import healthy_reference
    from rejoint.diagnosis.knowngood import reference_by

    return (
        healthy_reference(arm) if good is None else reference_by(arm, read_json(RunFolder(good).diagnosis, Diagnosis))
    )


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


def identify_logs_stage(
    run: Run, logs: Sequence[RunLog], beside: Sequence[Candidate] = (), *, on_progress: OnProgress = silent
) -> LogIdentification:
    """Fit a twin to logs of any motion; write it, and how it and those ``beside`` it predict, into a run folder."""
    from rejoint.twin.file import write_twin
    from rejoint.twin.fromlogs import identify_logs

    found = identify_logs(run.arm, logs, on_progress=lambda what, share: on_progress(share, 1.0, what), beside=beside)
    begin(run.folder.path, run.info.robot, run.arm, run.info.seed)
    write_twin(run.folder.twin, found.twin)
    write_json(run.folder.judgement, found.judgement)
    return found


@_alone
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


@_alone
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

    def keep(trial: Trial) -> None:
        if (trial.target_set, trial.repetition) == (0, 0):  # one of each suffices for the figures
            write_log(run.folder.log(trial.label), trial.log())

    settings = Settings(
        repetitions=trials.repetitions,
        seed=run.info.seed,
        batched=robot.startswith("emulated:"),
        protocol=trials.protocol,
    )
    factories = _factories(run, trials.controllers, period or default_period(robot))
    result = compare(connect, factories, targets, settings, on_progress=on_progress, on_trial=keep)
    set_aside(run.folder.comparison)
    write_json(run.folder.comparison, result)
    return result, recommend(result)


@_alone
def deploy_stage(run: Run, robot: str, job: Deployment, period: Period | None = None) -> Array:
    """Drive a robot through the targets of ``job``; returns the encoder error (K,) [m] at the end of each.

    Where something ends it early, what was recorded until then is kept.
    """
    factories = _factories(run, (job.controller,), period or default_period(robot))
    controller = factories[job.controller](run.arm)
    connection = open_robot(robot, arm=run.arm, seed=run.info.seed, period=period)
    path = run.folder.log(f"deploy-{datetime.now():%Y%m%d-%H%M%S}")
    try:
        recording = drive(connection, controller, job.targets[None], Schedule(dwell=job.dwell))
    except BaseException as error:
        partial = recording_of(error)
        if partial is not None and len(partial.time):
            write_log(path, partial.log(0, f"deploy/{job.controller}/stopped"))
            error.add_note(f"What was recorded until then: {path}")
        raise
    finally:
        connection.close()
    write_log(path, recording.log(0, f"deploy/{job.controller}"))
    apart = np.linalg.norm(recording.target[:, 0] - tcp_position(run.arm, recording.position[:, 0]), axis=-1)
    return np.array([apart[recording.target_index[:, 0] == k][-1] for k in range(len(job.targets))])


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
