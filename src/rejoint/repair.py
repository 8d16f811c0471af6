"""The stages of a repair, each from files to files, and the run folder that ties them together.

A stage reads what the stages before it wrote, writes its own files whole or not at all, and so can be
repeated, resumed, replaced, or run on another machine.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rejoint import __version__
from rejoint.arms import Arm, Array, load_arm, tcp_position
from rejoint.comparison.compare import Settings, Trial, compare
from rejoint.comparison.recommend import Recommendation, recommend
from rejoint.comparison.result import Comparison, Protocol
from rejoint.comparison.targets import draw_targets, read_targets
from rejoint.control.catalogue import BASELINES, make_controller
from rejoint.control.controller import Controller
from rejoint.control.loop import Schedule, run
from rejoint.control.robot import Robot
from rejoint.errors import FileError, InputError
from rejoint.robots import open_robot
from rejoint.runs import RunFolder, RunInfo, read_json, read_log, write_json, write_log

if TYPE_CHECKING:  # these need the simulator, which a Raspberry Pi does not have
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.training.train import TrainingResult
    from rejoint.twin.twin import Twin

OnProgress = Callable[[float, float, str], None]
"""Called with (done, total, what is being done)."""

Period = tuple[float, float]

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


def begin(path: Path, robot: str, arm: str, seed: int) -> RunFolder:
    """Open the run folder at ``path``, or make it; InputError if it belongs to another robot."""
    folder = RunFolder(path)
    wanted = RunInfo(
        robot=robot, arm=arm, seed=seed, version=__version__, created=datetime.now().isoformat(timespec="seconds")
    )
    if not folder.info.exists():
        if path.is_dir() and any(path.iterdir()):
            raise InputError(f"{path} is not a run folder and not empty; give another --run")
        write_json(folder.info, wanted)
        return folder
    found = read_json(folder.info, RunInfo)
    if (found.robot, found.arm, found.seed) != (robot, arm, seed):
        raise InputError(
            f"{path} is a run of {found.robot} ({found.arm}, seed {found.seed}), "
            f"expected {robot} ({arm}, seed {seed}); give another --run"
        )
    return folder


def open_run(path: Path) -> tuple[RunFolder, RunInfo, Arm]:
    """Open an existing run folder; FileError if it is none."""
    folder = RunFolder(path)
    if not folder.info.exists():
        raise FileError(path, "no run folder (it holds no run.json)", "start with: rejoint diagnose ROBOT --run FOLDER")
    info = read_json(folder.info, RunInfo)
    return folder, info, load_arm(info.arm)


def newest_or_new(robot: str, seed: int) -> tuple[Path, bool]:
    """Default run folder of a robot: the newest one if it was interrupted, else a new one.

    Returns the path and whether it is to be resumed.
    """
    home = RUNS / re.sub(r"[^\w.-]+", "-", f"{robot}-seed{seed}").strip("-")
    numbers = sorted(int(p.name) for p in home.glob("*") if p.name.isdecimal()) if home.is_dir() else []
    if numbers and not RunFolder(home / f"{numbers[-1]:03}").report.exists():
        return home / f"{numbers[-1]:03}", True
    return home / f"{(numbers[-1] if numbers else 0) + 1:03}", False


def diagnose_stage(
    folder: RunFolder, info: RunInfo, *, period: Period | None = None, on_progress: OnProgress = silent
) -> Diagnosis:
    """Excite the robot and write run logs and diagnosis."""
    from rejoint.diagnosis.diagnosis import diagnose
    from rejoint.diagnosis.healthy import load_healthy

    arm = load_arm(info.arm)
    robot = open_robot(info.robot, arm=arm, seed=info.seed, period=period)
    try:
        diagnosis, logs = diagnose(
            robot,
            load_healthy(arm),
            seed=info.seed,
            on_progress=lambda what, share: on_progress(share, 1.0, what),
        )
    finally:
        robot.close()
    write_log(folder.log("targets"), logs.targets)
    write_log(folder.log("excitation"), logs.excitation)
    write_json(folder.diagnosis, diagnosis)
    return diagnosis


def identify_stage(folder: RunFolder, info: RunInfo, *, on_progress: OnProgress = silent) -> Twin:
    """Fit a twin to the excitation log and write it."""
    from rejoint.twin.file import write_twin
    from rejoint.twin.identify import IdentifySettings, identify

    if not folder.log("excitation").exists():
        raise FileError(folder.log("excitation"), "no such file", f"run first: rejoint diagnose {info.robot}")
    log = read_log(folder.log("excitation"))
    twin = identify(
        load_arm(info.arm), [log], IdentifySettings(seed=info.seed), lambda what, share: on_progress(share, 1.0, what)
    )
    write_twin(folder.twin, twin)
    return twin


def train_stage(
    folder: RunFolder, info: RunInfo, *, preset: str = "default", resume: bool = True, on_progress: OnProgress = silent
) -> TrainingResult:
    """Train a policy on the twin (or, without one, on broad ranges) and write it."""
    from rejoint.training.train import TrainingOptions, train

    options = TrainingOptions(preset=preset, seed=info.seed, resume=resume)
    return train(load_arm(info.arm), _twin(folder, info), out=folder.path, options=options, on_progress=on_progress)


def compare_stage(
    folder: RunFolder,
    info: RunInfo,
    robot: str,
    trials: Trials,
    *,
    period: Period | None = None,
    on_progress: OnProgress = silent,
) -> tuple[Comparison, Recommendation]:
    """Try every controller on ``robot`` and write what came out; returns it, the recommendation and why."""
    arm = load_arm(info.arm)
    targets = (
        draw_targets(arm, sets=trials.sets, seed=info.seed)
        if trials.file is None
        else read_targets(trials.file, arm)[None]
    )

    def connect(count: int, seed: int) -> Robot:
        return open_robot(robot, arm=arm, seed=seed, count=count, period=period, threads=2)

    def keep(trial: Trial) -> None:
        if (trial.target_set, trial.repetition) == (0, 0):  # one of each suffices for the figures
            write_log(folder.log(trial.label), trial.log())

    settings = Settings(
        repetitions=trials.repetitions, seed=info.seed, batched=robot.startswith("emulated:"), protocol=trials.protocol
    )
    result = compare(
        connect, _factories(folder, info, arm, trials.controllers), targets, settings,
        on_progress=on_progress, on_trial=keep,
    )  # fmt: skip
    write_json(folder.comparison, result)
    return result, recommend(result)


def deploy_stage(folder: RunFolder, info: RunInfo, robot: str, job: Deployment, period: Period | None = None) -> Array:
    """Drive a robot through the targets of ``job``; returns the encoder error (K,) [m] at the end of each."""
    arm = load_arm(info.arm)
    controller = _factories(folder, info, arm, (job.controller,))[job.controller](arm)
    connection = open_robot(robot, arm=arm, seed=info.seed, period=period)
    try:
        recording = run(connection, controller, job.targets[None], Schedule(dwell=job.dwell))
    finally:
        connection.close()
    write_log(folder.log(f"deploy-{datetime.now():%Y%m%d-%H%M%S}"), recording.log(0, f"deploy/{job.controller}"))
    error = np.linalg.norm(recording.target[:, 0] - tcp_position(arm, recording.position[:, 0]), axis=-1)
    return np.array([error[recording.target_index[:, 0] == k][-1] for k in range(len(job.targets))])


def _twin(folder: RunFolder, info: RunInfo) -> Twin | None:
    if not folder.twin.exists():
        return None
    from rejoint.twin.file import read_twin

    return read_twin(folder.twin, load_arm(info.arm))


def _factories(
    folder: RunFolder, info: RunInfo, arm: Arm, names: tuple[str, ...]
) -> Mapping[str, Callable[[Arm], Controller]]:
    """Make controllers by name; the feed-forward believes the twin's stiffness where there is a twin."""
    policy = folder.policy if folder.policy.exists() else None
    names = names or (*BASELINES, *(("policy",) if policy else ()))
    twin = _twin(folder, info)
    known = {} if twin is None else {"stiffness": twin.parameters.stiffness}

    def factory(name: str) -> Callable[[Arm], Controller]:
        return lambda arm: make_controller(name, arm, policy=policy, **known)

    for name in names:
        factory(name)(arm)  # a name or a policy file that does not fit is refused before anything moves
    return {name: factory(name) for name in names}
