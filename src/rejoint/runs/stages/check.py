"""The check: a fixed motion, compared with earlier checks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

from rejoint.arms import CATALOGUE
from rejoint.control.recording import Observer, pacing
from rejoint.control.robot import Robot
from rejoint.diagnosis.monitoring.judge import Outlook, PastCheck, outlook, say
from rejoint.diagnosis.monitoring.measures import LABEL, CheckMeasures, measure_check, record_check, require_followed
from rejoint.logs.history import (
    CHECKS,
    SUMMARY,
    HistoryRow,
    find_rows,
    hours_of,
    name_of,
    plain_name,
    setup_of,
    utc_now,
    write_rows,
)
from rejoint.logs.journal import recover
from rejoint.logs.runfolder import RUNS
from rejoint.runs.history import MOVED, REPAIR, SET_UP, counted, owners, past_of, rows_of
from rejoint.runs.run import staged
from rejoint.session.inputs import FIRST_ROBOT, ArmLike, RobotLike, Settings, address_of, arm_of, to_keep
from rejoint.session.session import Session
from rejoint.system.errors import LOGGER, InputError
from rejoint.system.files import require_space, saving
from rejoint.system.numbers import as_positive
from rejoint.system.records import Readable, as_options, entity
from rejoint.system.shell import command
from rejoint.system.stopping import noted

BETWEEN = timedelta(minutes=4)
"""Between checks in a row with a given date; chosen"""
LOG = "check.parquet"
"""Run log of a check"""


@entity
class Checked(Readable):
    """Result of a check."""

    arm: str
    """in the history"""
    robot: str
    line: str
    """result and advice in one line"""
    outlook: Outlook
    """all quantities against the baseline, and the remaining time"""
    measures: CheckMeasures
    """of this check"""
    folder: Path
    unread: tuple[str, ...] = ()
    """unreadable rows of earlier checks or runs"""


@dataclass(frozen=True, kw_only=True)
class CheckNotes:
    """The user's notes on a check."""

    used_h: float | None = None
    """use so far; default: an emulated arm's ``hours``"""
    when: datetime | None = None
    """UTC; default: now"""
    moved: bool = False
    """the arm was moved or homed since: a new baseline"""
    repair: str = ""
    """command that repairs the arm; default: by its address and ``arm``"""


def check(
    robot: RobotLike = FIRST_ROBOT,
    *,
    history: Path | str = RUNS,
    name: str | None = None,
    arm: ArmLike | None = None,
    tolerance_mm: float | None = None,
    notes: CheckNotes | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Checked:
    """Move an arm through a fixed routine (2.5 minutes), and compare it with its own earlier checks.

    The first five checks after a repair, also in a row, are the baseline. A repair, a move, or a changed arm begin a
    new one.

    Parameters
    ----------
    robot
        robot or its address; default: an emulated worn arm. ``emulated:worn?hours=500`` has aged
    history
        folder of all runs and checks
    name
        of the arm in the history; default: from its address
    arm
        arm, name or file; default: by the address
    tolerance_mm
        [mm] tolerated tool error; default: that of the last check
    notes
        hours of use, date, whether the arm was moved
    settings
        control period; seed of an emulated arm's noise, new in each check
    observer
        receives progress

    Returns
    -------
    Checked
        result in one line, and details

    Raises
    ------
    AddressError, NotReadyError
        without an answer, or if the motion is unsafe
    GuardTripError, RobotError
        if the motion was ended, or a joint did not follow; the arm holds, the history is unchanged
    FileError, UnsavedError
        if writing failed; the error holds the result, if any

    Examples
    --------
    >>> notes = rejoint.CheckNotes(when=datetime(2027, 1, 1))
    >>> found = rejoint.check("emulated:healthy?hours=6", notes=notes, tolerance_mm=6.0)
    >>> print(found.line)
    """
    said, chosen, home = as_options(notes, CheckNotes), as_options(settings, Settings), Path(history)
    when = as_options(said.when or utc_now(), datetime)
    if when.tzinfo is not None:
        when = when.astimezone(UTC).replace(tzinfo=None)
    if tolerance_mm is not None:
        as_positive("check", tolerance_mm, "a tolerance in millimetres")
    if name is not None and not any(map(str.isalnum, name)):  # a variable of a script that is not set, say
        raise InputError(f"check: the name of an arm has letters or digits, got {name!r}; leave it out or give one")
    address, built = address_of(robot), arm_of(robot, arm)
    head = HistoryRow(
        time=when,
        kind="check",
        arm=name_of(address, built.name) if name is None else plain_name(name),
        robot=address,
        model=built.name,
        setup=setup_of(built),
        tolerance_mm=tolerance_mm,
        used_h=hours_of(address) if said.used_h is None else said.used_h,
    )
    rows, unread = find_rows(home)  # of all arms: their checks tell whose a repair was
    past = past_of([*rows, head], head.arm)
    begins = MOVED if said.moved else SET_UP if past.setup not in ("", head.setup) else ""
    visits, left = () if begins else past.visits, None if begins == SET_UP else past.left_mm
    mine = [row for row in rows if row.arm == head.arm and row.kind == "check" and not row.joint]
    owner = owners([*rows, head])
    last = max((row.time for row in rows if row.kind in ("check", REPAIR) and owner(row) == head.arm), default=None)
    if last and last >= when:
        raise InputError(
            f"check: the history of {head.arm} has a check or repair of {last:%Y-%m-%d %H:%M} already, expected a "
            f"later date than that, got {when:%Y-%m-%d %H:%M} (UTC): set the clock right; if it was wrong then, "
            f"delete the folder of that one in {home}"
        )
    tolerance = mine[-1].tolerance_mm if tolerance_mm is None and mine else tolerance_mm
    if chosen.seed is None:
        chosen = replace(chosen, seed=len(mine))
    named = arm if isinstance(arm, str | Path | None) else built.name if built.name in CATALOGUE else None
    described = () if named is None else ("--arm", named)
    with pacing(observer) as update, ExitStack() as stack:
        if chosen.dry_run:  # what it finds in a simulation is no check of the arm
            home = Path(stack.enter_context(TemporaryDirectory(prefix="rejoint-dry-run-")))
        folder = home / CHECKS / head.arm / f"{head.time:%Y%m%dT%H%M%S}-{os.urandom(2).hex()}"
        with (
            noted(),
            Session(robot, arm=built, settings=chosen, observer=observer) as session,
            _kept(session.robot, folder) as watched,
        ):
            ((log, warm),) = record_check(watched, on_progress=update)
            require_followed(built, log)
            measures = measure_check(built, log, warm)
            found = outlook(
                [*visits, PastCheck(time=head.time, measures=measures, used_h=head.used_h)], tolerance, left_mm=left
            )
            do = command("repair", address, *described, *to_keep(chosen).options(), *counted(Path(history), head.arm))
            line = say(found, said.repair or do)
            if begins == SET_UP:  # by mistake as well: another arm under this name, at each check
                then = mine[-1].model if mine else "another"
                line = (
                    f"A new norm begins, as the arm is described otherwise ({head.model}) than before ({then}). {line}"
                )
            result = Checked(
                arm=head.arm, robot=address, line=line, outlook=found, measures=measures, folder=folder, unread=unread
            )
            with saving(result):
                log.save(folder / LOG)
                write_rows(folder / SUMMARY, rows_of(replace(head, norm=begins), measures, found, line))
            return result


@contextmanager
def _kept(robot: Robot, folder: Path) -> Iterator[Robot]:
    """Wrap an open ``robot``, and recover its cut checks; without a result its log is kept, and no empty ``folder``."""
    for killed in sorted(folder.parent.glob("*")):  # not one that goes on: it has the arm
        for path in recover(killed):
            LOGGER.warning("A check that was cut short counts for nothing; what it recorded is kept: %s", path)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        require_space(folder)
        with staged(None, LABEL, folder / LOG) as watch:
            yield watch(robot)
    finally:
        with suppress(OSError):  # only an empty one goes
            folder.rmdir()
