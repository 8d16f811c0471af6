"""Twins: identification from an arm's motion, and replay of motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rejoint.arms import Array
from rejoint.control.recording import Observer, pacing
from rejoint.diagnosis.segments import of_diagnosis
from rejoint.logs.consistency import forced_remarks, require_commands
from rejoint.logs.runfolder import LOGS, RunFolder, locked
from rejoint.logs.runlog import RunLog
from rejoint.runs.run import Run, exclusive, mark_quick
from rejoint.session.inputs import (
    ArmLike,
    LogsLike,
    RunLike,
    TwinLike,
    arm_of_twin,
    as_arm,
    as_logs,
    as_run,
    as_twin,
    laden,
    run_of_logs,
)
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import write_json
from rejoint.system.numbers import as_seed
from rejoint.system.results import Readable
from rejoint.twin.replay import GAIN, TORQUE_OFF, declare

if TYPE_CHECKING:
    from rejoint.twin.judge import Candidate
    from rejoint.twin.twin import Judgement, Twin


@dataclass(frozen=True, kw_only=True)
class LogPlan:
    """Options for logs of any motion, by label."""

    beside: Sequence[Candidate] = ()
    """other twins to judge"""
    hold_out: Sequence[str] | None = None
    """motions to hold out; empty: none; default: a quarter of all, or of each of a few"""
    gain: Mapping[str, str] = field(default_factory=dict)
    """servos' position gain over the twin's: ``"0.5"``, or one number per joint"""
    torque_off: Mapping[str, str] = field(default_factory=dict)
    """[s] spans without torque: ``"3-7.5 12-14"``"""


def identify(
    logs: LogsLike | None = None,
    *,
    arm: ArmLike | None = None,
    run: RunLike | None = None,
    plan: LogPlan | None = None,
    seed: int | None = None,
    quick: bool = False,
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
    quick
        search less: the fit is worse
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
    from rejoint.twin.identify import identify as fit

    less: dict[str, Any] = {"starts": 2, "iterations": 2} if quick else {}
    with pacing(observer) as update:
        if logs is None:
            if run is None:
                raise InputError("identification: neither logs nor a run is given")
            found = as_run(run).seeded(seed)
            with exclusive(found):
                mark_quick(found, quick=quick)
                twin = fit(laden(found), _motions(found), update, seed=found.seed, **less)
                _write(found, twin)
            return twin
        about, chosen = run_of_logs(run, logs, arm)
        with exclusive(about):
            what = plan or LogPlan()
            motions = declare(declare(as_logs(logs), GAIN, what.gain), TORQUE_OFF, what.torque_off)
            require_commands(motions, "identification")
            if about is None and of_diagnosis(motions):
                return fit(chosen, motions, update, seed=as_seed(seed), **less)
            from rejoint.twin.identify import LogSettings, identify_logs

            drawn = about.seed if seed is None and about is not None else as_seed(seed)
            short: dict[str, Any] = {
                "coarse_seconds": 20.0,
                "fit_seconds": 20.0,
                "fast_seconds": 5.0,
                "contact_seconds": 20.0,
            }
            hold_out = None if what.hold_out is None else tuple(what.hold_out)
            how = LogSettings(hold_out=hold_out, seed=drawn, **(short if quick else {}))
            twin = identify_logs(chosen, motions, how, update, what.beside)
            twin = replace(twin, notes=(*twin.notes, *forced_remarks(motions)))
            if about is not None:
                _write(about.begin(), twin)
                mark_quick(about, quick=quick)
        return twin


def _motions(run: Run) -> list[RunLog]:
    path, targets = run.folder.log("excitation"), run.folder.log("targets")
    if not path.exists():
        logs = run.robot.removeprefix(LOGS)
        given = f"identify --logs {logs}" if run.robot.startswith(LOGS) else f"diagnose {logs}"
        raise FileError(path, "no such file", f"run: rejoint {given} --run {run.path}")
    return [RunLog.load(one) for one in (path, targets) if one.exists()]


def _write(run: Run, twin: Twin) -> None:
    from rejoint.twin.twin import write_twin

    run.folder.judgement.unlink(missing_ok=True)
    write_twin(run.folder.twin, twin)
    if twin.judgement is not None:
        write_json(run.folder.judgement, twin.judgement)


TWIN = "twin"
"""Name among the predictions"""

THREADS = 2
"""of the simulation; no effect on results"""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
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
    from rejoint.twin.judge import Candidate, judge_paths, predict_logs

    known = as_twin(twin)
    chosen = arm_of_twin(twin) if arm is None else as_arm(arm)
    known.require(chosen)
    motions = as_logs(logs)
    require_commands(motions, "replay")
    page = None
    with nullcontext() if out is None else locked(RunFolder(Path(out))):
        paths = predict_logs(chosen, [Candidate.of(TWIN, known), *beside], motions, threads=THREADS)
        judgement = judge_paths(chosen, paths, motions)
        if out is not None:
            from rejoint.pages.report.page import write_replay

            named = [str(given) if isinstance(given, Path | str) else "memory" for given in (twin, logs)]
            page = write_replay(Path(out), judgement, twin=named[0], logs=named[1])
    return Replayed(logs=tuple(motions), positions=tuple(paths[TWIN]), judgement=judgement, page=page)
