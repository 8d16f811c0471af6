"""What is fitted to an arm: its twin, with replay of motion, a policy on copies of the twin, and its servos' gains."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.arms import Array
from rejoint.control.controllers.policy import Policy
from rejoint.control.recording import Observer, pacing
from rejoint.control.servogains import GEARED, RIVALS, GainsFound, ServoGains, differing, search, tunable
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.segments import of_diagnosis
from rejoint.logs.consistency import remarks_on, require_commands
from rejoint.logs.exclusions import answered, powered
from rejoint.logs.runlog import RunLog
from rejoint.runs.run import Run, exclusive, mark, staged
from rejoint.session.context import ControllerMaker, twin_under
from rejoint.session.inputs import (
    ArmLike,
    LogsLike,
    RobotLike,
    RunLike,
    Settings,
    TwinLike,
    arm_of,
    arm_of_twin,
    as_logs,
    as_twin,
    kept,
    opened,
    run_of_logs,
)
from rejoint.session.session import Session
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import saving, set_aside, write_json
from rejoint.system.numbers import as_positive, as_seed
from rejoint.system.records import Readable, as_options, entity
from rejoint.system.stopping import noted

if TYPE_CHECKING:
    from rejoint.training.task import Preset
    from rejoint.training.train import Trainer, TrainingResult
    from rejoint.twin.judge import Candidate
    from rejoint.twin.twin import Judgement, Twin


@dataclass(frozen=True, kw_only=True)
class LogPlan:
    """Options for logs of any motion, by label."""

    beside: Sequence[Candidate] = ()
    """other twins to judge"""
    hold_out: Sequence[str] | None = None
    """motions to hold out; empty: none; default: a quarter of all, or of each of a few"""
    gain: Mapping[str, float] = field(default_factory=dict)
    """P gain of the servos in motions; all others have 1; the twin has the largest"""


def identify(
    logs: LogsLike | None = None,
    *,
    arm: ArmLike | None = None,
    run: RunLike | None = None,
    plan: LogPlan | None = None,
    seed: int | None = None,
    observer: Observer | None = None,
) -> Twin:
    """Fit a digital twin to an arm's motion: stiffness, damping, friction, inertia, torque limit, offset, delay.

    The two logs of a diagnosis are best. In others, contacts and stops are left out, whole motions held out.

    Parameters
    ----------
    logs
        run logs, their files or folder; default: the diagnosis of ``run``
    arm
        arm, name or file; default: that of run or logs
    run
        run, or its folder, for ``twin.toml``; default: nothing is written
    plan
        other twins, held-out motions, gains and pauses
    seed
        default: that of the run, else 0
    observer
        receives progress

    Returns
    -------
    Twin
        ``parameters``, ``interval`` (95 %), ``held_out`` errors; for any logs ``judgement``

    Raises
    ------
    InputError
        for too little motion, or logs of another arm
    FileError
        if a log is missing or damaged

    Examples
    --------
    >>> found = rejoint.diagnose("emulated:worn")
    >>> twin = rejoint.identify([found.excitation, found.targets])
    >>> print(twin.parameters.stiffness, twin.held_out.twin.tcp)
    """
    from rejoint.twin.identify import LogSettings, identify_logs
    from rejoint.twin.identify import identify as fit
    from rejoint.twin.judge import predict_logs

    what = as_options(plan, LogPlan)
    with pacing(observer) as update, ExitStack() as stack:
        if logs is not None:
            about, chosen = run_of_logs(run, logs, arm)
            stack.enter_context(exclusive(about))
            predict_logs(chosen, what.beside, [])  # twins of one name are refused now, and not after the fit
            motions = _at_gains(as_logs(logs), what.gain)
            require_commands(motions, "identification")
        elif run is not None:
            about = opened(run, arm)
            stack.enter_context(exclusive(about))
            chosen, path, targets = about.arm, about.folder.log("excitation"), about.folder.log("targets")
            if not path.exists():
                source = about.info.from_logs
                given = f"identify --logs {source}" if source else f"diagnose {about.robot}"
                raise FileError(path, "no such file", f"run: rejoint {given} --run {about.path}")
            motions = [RunLog.load(one) for one in (path, targets) if one.exists()]
        else:
            raise InputError("identification: neither logs nor a run is given")
        stack.enter_context(staged(about, "identify"))
        chosen = kept(about).laden(chosen)
        drawn = about.seed if seed is None and about is not None else as_seed(seed)
        if logs is None or (about is None and of_diagnosis(motions)):
            told = about and about.diagnosis
            twin = fit(chosen, motions, update, told.doubt if told else "")
        else:
            hold_out = None if what.hold_out is None else tuple(what.hold_out)
            how = LogSettings(hold_out=hold_out, seed=drawn)
            twin = identify_logs(chosen, motions, how, update, what.beside)
            twin = replace(twin, notes=(*twin.notes, *remarks_on(motions)))
        if about is not None:
            about.begin().folder.judgement.unlink(missing_ok=True)
            twin.save(about.folder.twin)
            if twin.judgement is not None:
                write_json(about.folder.judgement, twin.judgement)
        return twin


def _at_gains(logs: list[RunLog], gain: Mapping[str, float]) -> list[RunLog]:
    names = [log.label for log in logs]
    if unknown := sorted(set(gain) - set(names)):
        raise InputError(f"gain: there is no motion {', '.join(unknown)}; there are {', '.join(names)}")
    if not gain:
        return logs
    if recorded := [log.label for log in logs if log.gain is not None]:
        raise InputError(f"gain: {', '.join(recorded)} records its own; leave yours out")
    known = {name: as_positive(f"gain of {name}", one, "a number above zero") for name, one in gain.items()}
    return [replace(x, gain=np.full_like(x.position, known.get(x.label, 1.0))) for x in logs]


TWIN = "twin"
"""Name among the predictions"""


@entity
class Replayed(Readable):
    """A twin's prediction and its errors."""

    logs: tuple[RunLog, ...]
    positions: tuple[Array, ...]
    """(T, n) [rad] for each log, open loop from its first measured position"""
    judgement: Judgement
    """errors by motion and twin, free and in contact"""
    page: Path | None = None
    """with figures, if asked for"""


def replay(
    twin: TwinLike,
    logs: LogsLike,
    *,
    arm: ArmLike | None = None,
    beside: Sequence[Candidate] = (),
    out: Path | str | None = None,
) -> Replayed:
    """Predict every motion open loop with a twin, and compare that with the encoders.

    Parameters
    ----------
    twin
        twin or its file
    logs
        run logs of any motion, their files or folder
    arm
        arm, name or file; default: that of the twin
    beside
        other twins to judge
    out
        folder for a page with figures; default: none

    Returns
    -------
    Replayed
        ``positions``, and their errors as ``judgement``

    Raises
    ------
    ContractError
        if the twin is of another arm
    InputError
        for another arm's log, or without commands

    Examples
    --------
    >>> found = rejoint.replay(twin, log)
    >>> found.positions[0] - log.position  # (T, n) radians
    >>> found.judgement.mean["twin"].free.tcp  # metres
    """
    from rejoint.twin.judge import Candidate, judge, predict_logs

    chosen = arm_of_twin(twin, arm)
    known = as_twin(twin, chosen)
    motions = list(map(answered, powered(chosen, as_logs(logs))))
    require_commands(motions, "replay")
    page = None
    paths = predict_logs(chosen, [Candidate.of(TWIN, known), *beside], motions)
    judgement = judge(chosen, paths, motions)
    if out is not None:
        from rejoint.pages.report.page import write_replay

        named = [str(given) if isinstance(given, Path | str) else "memory" for given in (twin, logs)]
        page = write_replay(Path(out), judgement, *named)
    return Replayed(logs=tuple(motions), positions=tuple(path[TWIN] for path in paths), judgement=judgement, page=page)


QUICK: dict[str, Any] = {"iterations": 3, "agents": 16}
"""Size of a quick training; chosen"""


@entity
class TrainedPolicy(Policy):
    """A trained policy and its training."""

    training: TrainingResult
    """its files exist only in a run"""


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """Options of a training."""

    generic: bool = False
    """without the run's twin, for any worn arm"""
    seed: int | None = None
    """of all random numbers; default: that of the run, else 0"""
    trainer: Trainer | None = None
    """replaces proximal policy optimisation"""


def train(
    twin: TwinLike | None = None,
    *,
    arm: ArmLike | None = None,
    run: RunLike | None = None,
    preset: str | Preset = "default",
    quick: bool = False,
    settings: TrainSettings | None = None,
    observer: Observer | None = None,
) -> TrainedPolicy:
    """Train a control policy on randomised copies of a twin (proximal policy optimisation).

    The same seed gives the same policy.

    Parameters
    ----------
    twin
        twin or its file; default: the run's; without either: any worn arm of this kind
    arm
        arm, name or file; default: that of run or twin
    run
        run, or its folder, for ``policy.onnx``; or a twin
    preset
        ``default`` (on a twin: from the arm's generic policy), ``scratch``, or your own
    quick
        train for seconds; no result
    settings
        seed
    observer
        receives progress

    Returns
    -------
    TrainedPolicy
        the policy and its ``training``

    Raises
    ------
    InputError
        for run and twin, none of twin, run and arm, or a run without a twin
    ContractError
        if the twin is of another arm

    Examples
    --------
    >>> policy = rejoint.train("twin.toml")
    >>> policy.save("policy.onnx")
    >>> rejoint.train(run="runs/mine")
    """
    how, servo_gains = as_options(settings, TrainSettings), None
    with pacing(observer) as update, ExitStack() as stack:
        if how.trainer is None:
            from rejoint.training.task import load_preset

            preset = load_preset(preset)
        if run is not None:
            if twin is not None:
                raise InputError("training: a run has its own twin; give either a run or a twin")
            found = opened(run, arm).seeded(how.seed)
            stack.enter_context(exclusive(found))
            told, tuned, known = found.diagnosis, found.gains, None if how.generic else found.twin
            if known is None and not how.generic:
                raise InputError(
                    f"{found.path} has no twin.toml; run `rejoint identify {found.path}` first, or ask for a "
                    "policy for any worn arm of this kind with --generic"
                )
            stack.enter_context(staged(found, "train"))
            if quick:
                mark(found.folder.quick)
            servo_gains = tuned.under if tuned is not None else None if told is None else told.servo_gains
            if tuned is not None and known is not None:
                known = twin_under(known, tuned.found, tuned.under)
            chosen, folder, seed = found.arm, found.path, found.seed
        else:
            chosen = arm_of(None, arm) if twin is None else arm_of_twin(twin, arm)
            known = None if twin is None else as_twin(twin, chosen)
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rejoint-training-")))
            seed = as_seed(how.seed)
        if how.trainer is None:
            from rejoint.training.train import TrainingOptions
            from rejoint.training.train import train as learn

            about = {"seed": seed, "servo_gains": servo_gains} | (QUICK if quick else {})
            options = TrainingOptions(preset=preset, **about)
            result = learn(chosen, known, out=folder, options=options, on_progress=update)
        else:
            result = how.trainer(chosen, known, folder, update, servo_gains)
        return TrainedPolicy(**vars(Policy.load(result.policy)), training=result)


TARGETS = 4
"""per round; chosen: two sides and two heights"""


def gains(
    robot: RobotLike, run: RunLike, *, settings: Settings | None = None, observer: Observer | None = None
) -> GainsFound:
    """Search for better gains of the servos' own position loops, on the arm itself (about three minutes).

    The arm repeats four targets with other P, dead zone, startup force and I; each joint keeps what brings it nearer
    without noise. Afterwards the gains are as before; `compare` tries the best.

    Parameters
    ----------
    robot
        robot or its address: an SO-101, or an emulated one
    run
        run, or its folder, for ``gains.json``
    settings
        control period
    observer
        receives progress and trials

    Returns
    -------
    GainsFound
        gains per joint, before and best, and errors

    Raises
    ------
    InputError
        if the robot reports no gains; nothing has moved
    NotReadyError
        if the motion is unsafe
    GuardTripError, RobotError
        if the motion was ended; the arm holds, gains as before
    UnsavedError
        if writing failed; the error holds the result

    Examples
    --------
    >>> found = rejoint.gains("feetech:///dev/ttyACM0", "runs/mine")
    >>> print(found.alone["p"], 1e3 * found.with_alone.tool)
    """
    with (
        pacing(observer) as update,
        noted(),
        Session(robot, run=run, settings=settings, observer=observer) as session,
    ):
        told, now = session.run and session.run.diagnosis, tunable(session.robot)[1]
        if told and (others := {name for name, _ in differing(told.servo_gains or {}, now)}):
            session.observer.message(
                f"The servos have another {', '.join(sorted(others))} than in the diagnosis, and the search begins "
                "there. If a search was cut short, switch the arm off and on before the next."
            )
        points = draw_targets(session.arm, sets=1, count=TARGETS, seed=session.seed)[0]
        with session.metered("gains") as tried:
            found = search(tried, points, limits=session.limits, on_progress=update)
            if session.run is not None:
                with saving(found):
                    write_json(set_aside(session.run.folder.gains), found)
    return found


def gains_to_keep(run: Run) -> ServoGains:
    """Recommended controller's gains; without a comparison those for the servos alone.

    FileError without a search, InputError if nothing else is recommended.
    """
    found = run.gains
    if found is None:
        raise FileError(run.folder.gains, "no such file", f"run `rejoint gains ROBOT {run.path}` first")
    best = ControllerMaker(run.arm, run=run).choice()[0] if run.folder.comparison.exists() else GEARED
    if best not in RIVALS:
        raise InputError(f"{run.path} recommends {best}, under the gains that the servos had; there is nothing to keep")
    return found.alone if best == GEARED else found.under
