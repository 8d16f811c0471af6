"""Replay and report."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.arms import Array
from rejoint.logs.consistency import require_commands
from rejoint.logs.runfolder import RunFolder, locked
from rejoint.logs.runlog import RunLog
from rejoint.runs.history import summarise
from rejoint.runs.run import exclusive, finish
from rejoint.session.inputs import ArmLike, LogsLike, RunLike, TwinLike, arm_of_twin, as_arm, as_logs, as_run, as_twin

if TYPE_CHECKING:
    from rejoint.twin.judge import Candidate
    from rejoint.twin.judgement import Judgement


TWIN = "twin"
"""Name among the predictions"""

THREADS = 2
"""of the simulation; no effect on results"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replayed:
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

    Motions of the fit flatter the twin.

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
        folder for a page with figures; default: nothing is written

    Returns
    -------
    Replayed
        ``positions``, and their errors as ``judgement``

    Raises
    ------
    ContractError
        if the twin is of another arm
    InputError
        for a log of another arm, or without commands

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
    with nullcontext() if out is None else locked(RunFolder(Path(out))):
        paths = predict_logs(chosen, [Candidate.of(TWIN, known), *beside], motions, threads=THREADS)
        judgement = judge_paths(chosen, paths, motions)
        page = None if out is None else _write(Path(out), judgement, twin, logs)
    return Replayed(logs=tuple(motions), positions=tuple(paths[TWIN]), judgement=judgement, page=page)


def _write(out: Path, judgement: Judgement, twin: TwinLike, logs: LogsLike) -> Path:
    from rejoint.pages.report.page import write_replay

    named = [str(given) if isinstance(given, Path | str) else "memory" for given in (twin, logs)]
    return write_replay(out, judgement, twin=named[0], logs=named[1])


def report(run: RunLike) -> Path:
    """Write the report of a run: one self-contained page, and its figures as PNG files.

    Parameters
    ----------
    run
        run, or its folder

    Returns
    -------
    Path
        of ``report.html``

    Raises
    ------
    FileError
        if the run is empty, or a file damaged

    Examples
    --------
    >>> page = rejoint.report("runs/mine")
    >>> webbrowser.open(page.resolve().as_uri())
    """
    from rejoint.pages.report.page import write_report

    found = as_run(run)
    with exclusive(found):
        page = write_report(found.path)
        finish(found)
        summarise(found)
        return page
