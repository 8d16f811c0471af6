"""An arm that is repaired again: twin and policy of its last repair are kept where it still moves as that twin says."""

from __future__ import annotations

import logging
import shutil
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.logs.runfolder.kept import Kept
from rejoint.logs.runlog import RunLog, read_log
from rejoint.runs.run import Run, is_finished
from rejoint.system.errors import FileError
from rejoint.system.files import read_json, write_json, write_whole

if TYPE_CHECKING:
    from rejoint.twin.twin import Twin

WORSE = 2.0
"""times the error that it had when it was fitted, up to which a twin still holds (chosen: with other noise, arms that
have not changed come to 1.0 to 1.8, after 400 hours of hard work to 2.9 to 13: `python -m benchmarks again`)"""
WINDOW = 6.0
"""[s] of motion that is predicted at a time (as in an identification)"""

_LOGGER = logging.getLogger("rejoint")


def keep_what_holds(run: Run, preset: str) -> Kept | None:
    """Take twin and policy of the last repair over into ``run``, freshly diagnosed, where they still hold.

    None where they do not, where there is nothing to take over, or no policy of that ``preset``; a damaged folder
    counts as none.
    """
    if run.folder.twin.exists() or not run.folder.log("excitation").exists():
        return None
    try:
        last = last_repair(run)
        why = None if last is None else still_holds(run, last, preset)
    except FileError as error:
        _LOGGER.warning("nothing is kept of the last repair: %s", error)
        return None
    if last is not None and why is not None:
        _take_over(run, last, why)
    return why


def last_repair(run: Run) -> Run | None:
    """Return the newest finished repair of the same robot and arm beside ``run``; None where there is none."""
    found = []
    for path in run.path.parent.glob("*/run.json"):
        folder = RunFolder(path.parent)
        files = (folder.diagnosis, folder.twin, folder.policy, folder.outputs.curves)
        if folder.path == run.path or folder.quick.exists() or not all(file.exists() for file in files):
            continue
        other = Run.open(folder.path)
        if other.is_of(run.robot, run.arm) and is_finished(folder):
            found.append(other)
    return max(found, key=lambda other: other.info.created, default=None)


def still_holds(run: Run, last: Run, preset: str) -> Kept | None:
    """Tell what the twin of ``last`` makes of the excitation of ``run``; None where the arm has changed since.

    So it is too where servos have other gains than then, or the policy is of another ``preset``.
    """
    twin, policy, now, before = last.twin, last.policy, run.diagnosis, last.diagnosis
    if twin is None or policy is None or now is None or before is None:
        return None
    if now.servo_gains != before.servo_gains or policy.contract.preset != preset:
        return None
    error, fitted = twin_error(run.arm, twin, read_log(run.folder.log("excitation"))), twin.held_out.twin.tcp
    if error > WORSE * fitted:
        return None
    since = read_json(last.folder.kept, Kept).since if last.folder.kept.exists() else last.info.created
    return Kept(run=str(last.path), since=since, error=error, fitted=fitted)


def twin_error(arm: Arm, twin: Twin, log: RunLog) -> float:
    """Root mean square error [m] of the tool that the twin predicts for a log."""
    from rejoint.twin.prediction import prediction_error
    from rejoint.twin.replay import Replay, cut

    replay = Replay(arm, [log], cut([log], WINDOW), stiction=twin.stiction, acceleration=twin.acceleration)
    predicted = np.concatenate(replay.predict(twin.parameters.repeat(1)), axis=1)[0]
    return prediction_error(arm, predicted, np.concatenate(replay.measured())).tcp


def _take_over(run: Run, last: Run, why: Kept) -> None:
    """Copy training, twin, gains and policy, in this order: what is missing is made anew from those before it."""
    shutil.copytree(last.folder.outputs.folder, run.folder.outputs.folder, dirs_exist_ok=True)
    write_json(run.folder.kept, why)
    ours, theirs = run.folder, last.folder
    for source, target in ((theirs.twin, ours.twin), (theirs.gains, ours.gains), (theirs.policy, ours.policy)):
        if source.exists():
            write_whole(target, partial(shutil.copyfile, source))
