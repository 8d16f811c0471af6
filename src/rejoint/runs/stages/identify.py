"""Identification: a twin of an arm from its motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from rejoint.arms import Arm
from rejoint.diagnosis.segments import is_excitation
from rejoint.logs.bare import require_commands
from rejoint.logs.doubts import forced_remarks
from rejoint.logs.runfolder.folder import LOGS
from rejoint.logs.runlog import RunLog, read_log
from rejoint.runs.given import ArmLike, LogsLike, RunLike, as_logs, as_run, run_of_logs
from rejoint.runs.run import Run, exclusive, mark_quick
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import write_json
from rejoint.system.numbers import as_seed
from rejoint.system.progress import Progress, no_progress, paced
from rejoint.twin.conditions import GAIN, TORQUE_OFF, declare

if TYPE_CHECKING:
    from rejoint.twin.judge import Candidate
    from rejoint.twin.twin import Twin

NOTHING: Mapping[str, str] = {}


@paced
def identify(
    logs: LogsLike | None = None,
    *,
    arm: ArmLike | None = None,
    run: RunLike | None = None,
    beside: Sequence[Candidate] = (),
    hold_out: Sequence[str] | None = None,
    gain: Mapping[str, str] = NOTHING,
    torque_off: Mapping[str, str] = NOTHING,
    seed: int | None = None,
    quick: bool = False,
    on_progress: Progress = no_progress,
) -> Twin:
    """Fit a digital twin to an arm's motion: stiffness, damping, friction, inertia, torque limit, offset and delay.

    Logs of an excitation (`Diagnosed.excitation`) tell most. From logs of any other motion, contacts and stops are
    left out, and whole motions are kept from the fit to judge it by. Ctrl-C is a KeyboardInterrupt, as always.

    Parameters
    ----------
    logs
        run logs, a file of one, or a folder of them; without any, the excitation of ``run``
    arm
        arm, name or file; by default that of the run, or the one of the catalogue that the logs name
    run
        run, or its folder, into which ``twin.toml`` is written; without one nothing is written
    beside
        other twins, such as published ones, to judge beside the fitted one on logs of any motion
    hold_out
        labels of the motions to keep from the fit and judge it by; empty to judge it on the motions it has seen; by
        default a quarter of the motions is drawn, of few motions the end of each is taken. Once judged, the twin is
        fitted to all motions
    gain, torque_off
        of motions, by their labels: the servos' position gain over that which the twin is to have (``"0.5"``, or one
        number for each joint), and seconds without torque since the start (``"3-7.5 12-14"``)
    seed
        of the search, and of what is held out; by default that of the run, else 0
    quick
        search less, for a first try: the fit is worse
    on_progress
        called with the share that is done and what is being done

    Returns
    -------
    Twin
        ``parameters`` with ``interval`` (95 %) in SI units; ``held_out`` says how well it predicts motion that the fit
        has not seen, and, for logs of any motion, ``judgement`` how well each motion

    Raises
    ------
    InputError
        if there is too little motion, or the logs are of another arm
    FileError
        if the run has no excitation log, or a log is damaged

    Examples
    --------
    >>> found = rejoint.diagnose("emulated:worn")
    >>> twin = rejoint.identify(found.excitation)
    >>> print(twin.parameters.stiffness, twin.held_out.twin.tcp)
    """
    if logs is None:
        if run is None:
            raise InputError("identification: neither logs nor a run is given")
        found = as_run(run).seeded(seed)
        with exclusive(found):
            mark_quick(found, quick=quick)
            twin = _from_excitation(found.arm, [_excitation(found)], found.seed, on_progress, quick=quick)
            _write(found, twin)
        return twin
    about, chosen = run_of_logs(run, logs, arm)
    with exclusive(about):
        motions = declare(declare(as_logs(logs), GAIN, gain), TORQUE_OFF, torque_off)
        require_commands(motions, "identification")
        if about is None and all(is_excitation(log) for log in motions):
            return _from_excitation(chosen, motions, as_seed(seed), on_progress, quick=quick)
        drawn = about.seed if seed is None and about is not None else as_seed(seed)
        twin = _from_any_motion(chosen, motions, beside, hold_out, drawn, on_progress, quick=quick)
        if about is not None:
            _write(about.begin(), twin)
            mark_quick(about, quick=quick)
    return twin


def _from_excitation(arm: Arm, logs: Sequence[RunLog], seed: int, on_progress: Progress, *, quick: bool) -> Twin:
    from rejoint.twin.identify import IdentifySettings
    from rejoint.twin.identify import identify as fit

    settings = IdentifySettings(seed=seed)
    if quick:
        settings = replace(settings, starts=2, iterations=2, timestep=2 * settings.timestep)
    return fit(arm, logs, settings, on_progress)


def _from_any_motion(
    arm: Arm,
    logs: Sequence[RunLog],
    beside: Sequence[Candidate],
    hold_out: Sequence[str] | None,
    seed: int,
    on_progress: Progress,
    *,
    quick: bool,
) -> Twin:
    from rejoint.twin.fromlogs import identify_logs
    from rejoint.twin.holdout import HoldOut
    from rejoint.twin.motionfit import LogSettings

    settings = LogSettings(hold_out=HoldOut(names=None if hold_out is None else tuple(hold_out), seed=seed))
    if quick:
        settings = replace(settings, coarse_seconds=20.0, fit_seconds=20.0, fast_seconds=5.0, contact_seconds=20.0)
    found = identify_logs(arm, logs, settings, on_progress, beside)
    notes = (*found.twin.notes, *forced_remarks(logs))
    return replace(found.twin, judgement=found.judgement, fitted=found.fitted, notes=notes)


def _excitation(run: Run) -> RunLog:
    """Read the excitation of a run; FileError says how to come to one."""
    path = run.folder.log("excitation")
    if not path.exists():
        logs = run.robot.removeprefix(LOGS)
        given = f"identify --logs {logs}" if run.robot.startswith(LOGS) else f"diagnose {logs}"
        raise FileError(path, "no such file", f"run: rejoint {given} --run {run.path}")
    return read_log(path)


def _write(run: Run, twin: Twin) -> None:
    """Write a twin into its run, in place of another and of how that one was judged."""
    from rejoint.twin.file import write_twin

    for of_another in (run.folder.judgement, run.folder.kept):
        of_another.unlink(missing_ok=True)
    write_twin(run.folder.twin, twin)
    if twin.judgement is not None:
        write_json(run.folder.judgement, twin.judgement)
