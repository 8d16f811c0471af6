"""The check: two and a half minutes that show how an arm stands against its own beginning."""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.arms import CATALOGUE, Arm, Array
from rejoint.control.robot import Robot
from rejoint.logs.history.identity import hours_of, name_of, plain_name, setup_of
from rejoint.logs.history.index import CHECKS, find_rows
from rejoint.logs.history.rows import SUMMARY, HistoryRow, utc_now, write_rows
from rejoint.logs.journal import Journal, journal_path, recover
from rejoint.logs.runlog import RunLog
from rejoint.runs.given import (
    FIRST_ROBOT,
    ArmLike,
    Live,
    Period,
    RobotLike,
    address_of,
    arm_of,
    opened,
    shown,
)
from rejoint.runs.history.checks import MOVED, SET_UP, past_of, rows_of, with_outlook
from rejoint.runs.run import RUNS
from rejoint.system.errors import AddressError, FileError, InputError
from rejoint.system.files import require_space, saving
from rejoint.system.progress import Progress, no_progress, paced, part
from rejoint.system.stopping import noted

if TYPE_CHECKING:
    from rejoint.diagnosis.monitoring.judge import Outlook
    from rejoint.diagnosis.monitoring.measures import CheckMeasures

BETWEEN = timedelta(minutes=4)
"""By which the dates of checks in a row lie apart where the date was given (chosen: little more than one takes)"""
LOG = "check.parquet"
"""Name of the run log of a check"""
QUIET = 30.0
"""[s] without a row after which the journal of a check is that of a killed one (chosen: one that goes on is written
four times a second)"""

_LOGGER = logging.getLogger("rejoint")


@dataclass(frozen=True, kw_only=True, eq=False)
class Checked:
    """What a check found, and how the arm stands by all of its checks."""

    arm: str
    """name in the history"""
    robot: str
    """address"""
    line: str
    """one line for the owner: cause, millimetres, date, what to do"""
    outlook: Outlook
    """every quantity of every joint against the beginning, and when the tolerance will be reached"""
    measures: CheckMeasures
    """the newest check alone"""
    folder: Path
    """where its log and its rows are"""
    unread: tuple[str, ...] = ()
    """rows of earlier checks or runs that could not be read, and so did not count"""


@paced
def check(
    robot: RobotLike = FIRST_ROBOT,
    *,
    history: Path | str = RUNS,
    name: str | None = None,
    arm: ArmLike | None = None,
    tolerance_mm: float | None = None,
    used_h: float | None = None,
    when: datetime | None = None,
    moved: bool = False,
    repeat: int = 1,
    period: Period | None = None,
    seed: int | None = None,
    on_progress: Progress = no_progress,
    live: Live | None = None,
) -> Checked:
    """Move an arm through a fixed routine of two and a half minutes, and compare it with its own earlier checks.

    The first checks after a repair are what later ones are compared with; at least five are needed, and may follow one
    another at once. A repair in the same history, ``moved``, or another description of the arm begin anew. While the
    arm moves, Ctrl-C and SIGTERM first bring it to a hold; then `Interrupted` is raised, a KeyboardInterrupt.

    Parameters
    ----------
    robot
        robot or its address; by default a worn arm emulated in this process. ``emulated:worn?hours=500`` has aged
    history
        folder below which all runs and checks are; rows are looked for in all of it
    name
        of the arm in the history; by default made of its address
    arm
        arm, name or file; by default what the address names
    tolerance_mm
        [mm] error of the tool that the owner can bear; by default that of the last check
    used_h
        [h] for which the arm has been used so far, if somebody counts; by default an emulated arm's ``hours``
    when
        date of the check, UTC; by default now. For trying years in minutes
    moved
        the arm was moved, or its zeros set anew, since the last check: begin anew
    repeat
        checks in a row
    period
        [s] interval of the control periods; by default what the robot suits
    seed
        of an emulated arm's noise; by default another one at each check
    on_progress
        called with the share that is done and what is being done
    live
        shows the arm meanwhile: a `LiveView`

    Returns
    -------
    Checked
        one line for the owner, and what it rests on

    Raises
    ------
    AddressError, NotReadyError
        if no robot answers, or it had better not be moved
    GuardTripError, RobotError
        if the motion had to be ended, or a joint did not follow at all; the arm holds, nothing is added to the history
    FileError, UnsavedError
        if nothing can be written; the result is in the error where there is one

    Examples
    --------
    >>> for month in range(24):
    ...     date = datetime(2027, 1, 1) + timedelta(days=30 * month)
    ...     found = rejoint.check(f"emulated:healthy?hours={6 * month}", when=date, tolerance_mm=6.0)
    ...     print(found.line)
    """
    if repeat < 1:
        raise InputError(f"check: repeat is 1 or more, got {repeat}")
    if tolerance_mm is not None and not 0.0 < tolerance_mm < math.inf:
        raise InputError(f"check: the tolerance is a positive number of millimetres, got {tolerance_mm}")
    if used_h is not None and not 0.0 <= used_h < math.inf:
        raise InputError(f"check: the hours of use are a finite number from 0, got {used_h}")
    if name is not None and not any(map(str.isalnum, name)):  # a variable of a script that is not set, say
        raise InputError(f"check: the name of an arm has letters or digits, got {name!r}; leave it out or give one")
    address, chosen = address_of(robot), arm_of(robot, arm)
    key = name_of(address, chosen.name)
    head = HistoryRow(
        time=utc_now() if when is None else _utc(when), kind="check", arm=key if name is None else plain_name(name),
        robot=address, model=chosen.name, setup=setup_of(chosen), tolerance_mm=tolerance_mm,
        used_h=hours_of(address) if used_h is None else used_h,
    )  # fmt: skip
    home = Path(history)
    for number in range(repeat):
        if number:
            head = replace(head, time=utc_now() if when is None else head.time + BETWEEN, tolerance_mm=tolerance_mm)
        progress = part(on_progress, number / repeat, (number + 1) / repeat)
        found = _once(robot, chosen, head, key, home, moved=moved and not number, period=period, seed=seed,
                      on_progress=progress, live=live)  # fmt: skip
    return found


def _once(
    robot: RobotLike, arm: Arm, head: HistoryRow, key: str, home: Path, *, moved: bool, period: Period | None,
    seed: int | None, on_progress: Progress, live: Live | None,
) -> Checked:  # fmt: skip
    """Make one check, and leave its log and its rows."""
    from rejoint.diagnosis.monitoring.judge import PastCheck, outlook
    from rejoint.diagnosis.monitoring.measures import measure_check, require_followed
    from rejoint.diagnosis.monitoring.words import say

    rows, unread = find_rows(home, head.arm)
    if any(row.kind == "repair" for row in rows):  # whose it was is told by the checks of all arms
        rows, unread = find_rows(home)
    past = past_of(rows, head.arm, key)
    begins = MOVED if moved else SET_UP if past.setup not in ("", head.setup) else ""
    visits, left = () if begins else past.visits, None if begins == SET_UP else past.left_mm
    mine = [row for row in rows if row.arm == head.arm and row.kind == "check" and not row.joint]
    if mine and mine[-1].time >= head.time:
        raise InputError(
            f"check: the history of {head.arm} has a check of {mine[-1].time:%Y-%m-%d %H:%M} already, expected a later "
            f"date than that, got {head.time:%Y-%m-%d %H:%M} (UTC): set the clock right; if it was wrong then, delete "
            f"that check in {home / CHECKS / head.arm}"
        )
    tolerance = head.tolerance_mm if head.tolerance_mm is not None or not mine else mine[-1].tolerance_mm
    _keep_killed(home / CHECKS / head.arm)
    folder = home / CHECKS / head.arm / f"{head.time:%Y%m%dT%H%M%S}-{os.urandom(2).hex()}"
    with noted(), opened(robot, arm, len(mine) if seed is None else seed, period) as connection:
        log, warm = _drive(shown(live, connection), folder, on_progress)
    require_followed(arm, log)
    measures = measure_check(arm, log, warm)
    now = PastCheck(time=head.time, measures=measures, used_h=head.used_h)
    found = outlook([*visits, now], tolerance, left_mm=left)
    line = say(found, head.robot, _described(head.robot, arm))
    if begins == SET_UP:  # by mistake as well: another arm under this name, at each check
        then = mine[-1].model if mine else "another"
        line = f"A new norm begins, as the arm is described otherwise ({head.model}) than before ({then}). {line}"
    result = Checked(
        arm=head.arm, robot=head.robot, line=line, outlook=found, measures=measures, folder=folder, unread=unread
    )
    with saving(result):
        write_rows(folder / SUMMARY, with_outlook(rows_of(replace(head, norm=begins), measures), found, line))
    return result


def _drive(robot: Robot, folder: Path, on_progress: Progress) -> tuple[RunLog, Array | None]:
    """Drive the robot through the check; what it did until an error is kept."""
    from rejoint.diagnosis.monitoring.record import LABEL, record_check

    if robot.count != 1:
        raise InputError(f"a check is of one arm, {robot.address} has {robot.count}; use `record_check` for a batch")
    folder.mkdir(parents=True, exist_ok=True)
    require_space(folder)
    path, names = folder / LOG, robot.arm.joint_names
    journal = Journal.begin(path, arm=robot.arm.name, joint_names=names, robot=robot.address, label=LABEL)
    try:
        ((log, warm),) = record_check(robot, on_cycle=journal.see, on_progress=on_progress)
    except BaseException as error:
        error.add_note(journal.rescue())
        _remove_if_empty(folder)
        raise
    journal.finish(log)
    return log, warm


def _keep_killed(place: Path) -> None:
    """Make run logs of what killed checks of an arm recorded below ``place``; each check has a folder of its own."""
    for folder in sorted(file.parent for file in place.glob(f"*/{journal_path(Path(LOG)).name}")):
        try:
            for log in recover(folder, quiet=QUIET):
                _LOGGER.warning("A check that was cut short counts for nothing; what it recorded is kept: %s", log)
            _remove_if_empty(folder)
        except (FileError, OSError) as error:  # of somebody else, say: no reason to check nothing
            _LOGGER.warning("A check was cut short, and nothing is made of what it recorded: %s", error)


def _described(address: str, arm: Arm) -> str:
    """Return what `rejoint repair` has to be told of an arm that is not the one its address names."""
    try:
        usual = arm_of(address, None).name
    except AddressError:  # a robot of the caller's own
        usual = arm.name
    if arm.name == usual:
        return ""
    return f" --arm {arm.name}" if arm.name in CATALOGUE else " with the same --arm"


def _remove_if_empty(folder: Path) -> None:
    """Remove the folder of a check in which nothing has moved."""
    if not any(folder.iterdir()):
        folder.rmdir()


def _utc(when: datetime) -> datetime:
    """Return a date in UTC without its zone."""
    return when if when.tzinfo is None else when.astimezone(UTC).replace(tzinfo=None)
