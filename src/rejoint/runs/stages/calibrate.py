"""Measuring the tool in many postures of an arm."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from rejoint.arms import Arm
from rejoint.control.recording import Observer, pacing
from rejoint.diagnosis.calibration.calibration import Calibration, Preload, preload, write_calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import (
    Measurements,
    MeasuringSession,
    read_interrupted,
    read_measurements,
    write_measurements,
)
from rejoint.diagnosis.calibration.procedure import (
    EmulatedGauge,
    FilmingGauge,
    Gauge,
    StandingDrive,
    kept,
    log_resumed,
    measure,
    reversals,
    suggest,
)
from rejoint.logs.runfolder import RunFolder
from rejoint.runs.run import Run
from rejoint.session.context import stance_of, zeros_of
from rejoint.session.inputs import ArmLike, RobotLike, RunLike, Settings, as_calibration
from rejoint.session.session import Session
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import saving, set_aside
from rejoint.system.numbers import as_whole
from rejoint.system.progress import Progress, part
from rejoint.system.records import Readable, as_options, entity
from rejoint.system.shell import command
from rejoint.system.stopping import check, noted

if TYPE_CHECKING:
    from rejoint.camera.film import Film, Filmed


def _measured(
    drive: StandingDrive,
    gauge: Gauge,
    run: Run | None,
    prior: Calibration | None,
    count: int,
    visits: int,
    on_progress: Progress,
    *,
    begins: str,
) -> tuple[Measurements, Calibration | None]:
    robot, file, fresh = drive.robot, run.folder.measurements if run else None, begins == "none"
    found, session = None, MeasuringSession(plan="", answered=0, fresh=fresh)
    if file and file.exists() and not fresh:
        try:
            found, session = read_interrupted(file, robot.arm) or (None, session)
        except FileError as error:
            error.add_note("To measure again in spite of it: rejoint calibrate ROBOT RUN --fresh")
            raise
    prior = None if session.fresh else prior
    plan = suggest(robot.arm, count * visits, visits=visits, sigma=gauge.sigma, prior=prior)
    if file is not None and found is not None:
        if (session.plan, found.source, found.frame) != (plan.digest, gauge.source, gauge.frame):
            raise InputError(
                f"{file}: an interrupted session with another number of postures or sides, by something "
                "else, or with another --noise or --frame; give the same again, or begin again: "
                "rejoint calibrate ROBOT RUN --fresh"
            )
        log_resumed(file, f"{session.answered} of {len(plan.posture)} measurements are done")
    again = ["--fresh"] if session.fresh else ["--calibration", begins] if begins else []
    fits = command("calibrate", robot.address, run and run.path, "--measure", f"points={file}", *again)
    with kept(lambda: file if found else None, fresh=session.fresh, more=f", and this ends it with a fit: {fits}"):
        for measured, answered in measure(drive, gauge, plan, found, session.answered, on_progress):
            if file and measured is not None:
                place = file if found else set_aside(file)
                write_measurements(place, robot.arm, measured, replace(session, plan=plan.digest, answered=answered))
            found = measured
        drive.rest()
        if found is None:
            raise InputError("calibration: nothing was measured; type x, y and z of the tool at each stop")
    return found, prior


POINTS = 10
"""Default number of postures (docs/true-accuracy.md)"""


@entity
class Calibrated(Readable):
    """Result of a calibration."""

    calibration: Calibration
    """displacement of the tool; ``used``: it helps"""
    measurements: Measurements
    reversal: tuple[float, ...]
    """[m] reversal value (ISO 230-2) of each posture with two approaches"""
    filmed: Filmed | None = None
    """fit of a camera's pictures"""

    @property
    def before(self) -> float:
        """[m] mean true error by encoders at points left out."""
        return self.calibration.before

    @property
    def after(self) -> float:
        """[m] the same by calibrations without these points."""
        return self.calibration.after

    @cached_property
    def preload(self) -> Preload:
        """Effect of a wedge on floating joints at the measured postures."""
        return preload(self.calibration, self.measurements.position)


def calibrate(
    robot: RobotLike | None = None,
    *,
    run: RunLike | None = None,
    gauge: Gauge | FilmingGauge | Measurements | Film | Path | str | None = None,
    count: int | None = None,
    visits: int = 2,
    arm: ArmLike | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Calibrated:
    """Measure where an arm's tool is, fit its displacement, and store a correction that helps.

    The arm moves slowly to informative postures, from two sides each. `deploy` and `compare` in the run then use the
    correction; an interrupted session resumes.

    Parameters
    ----------
    robot
        robot or its address; None for earlier measurements
    run
        run, or its folder, for measurements, calibration and pictures
    gauge
        `TouchGauge`, `TrackerGauge`, `CameraGauge`, or your own object with ``measure``; default: the emulator's truth
        with 0.5 mm of noise. Without a robot: measurements, their file, or pictures
    count
        postures; default: 10, with a camera 14 and 12 about rest
    visits
        2: from both sides, which shows play; 1: from one
    arm
        arm, name or file, if neither run nor address tells
    settings
        control period, seed, ``calibration``: an earlier one as prior (default: the run's), or ``none``, without
        resuming
    observer
        receives progress

    Returns
    -------
    Calibrated
        calibration, measurements, reversal values

    Raises
    ------
    InputError, ContractError
        for unusable measurements or another arm's calibration
    NotReadyError, GuardTripError, RobotError
        if the motion is unsafe or ended; measurements are kept
    UnsavedError
        if writing failed; the error holds the result

    Examples
    --------
    >>> found = rejoint.calibrate("emulated:worn")
    >>> print(found.before, found.after, found.calibration.used)  # metres
    """
    chosen, count = as_options(settings, Settings), None if count is None else as_whole("count", count, 1)
    known = isinstance(gauge, Measurements | Path | str) or hasattr(gauge, "shots")
    before = cast("Measurements | Film | Path | str", gauge) if known else None
    if (robot is None) == (before is None):
        raise InputError("calibration: give either a robot or points that were measured before")
    with (
        pacing(observer) as update,
        noted(),
        Session(robot, run=run, arm=arm, settings=chosen, observer=observer) as session,
    ):
        about, prior = session.run, as_calibration(chosen.calibration, session.run, session.arm)
        begins = str(chosen.calibration) if isinstance(chosen.calibration, str | Path) else ""
        fresh = begins == "none"
        measured: Measurements | Film
        if isinstance(before, Path | str):
            measured = read_measurements(Path(before), session.arm)
        elif before is not None:
            measured = before
        else:
            by = EmulatedGauge(seed=session.seed) if gauge is None or chosen.dry_run else cast("Gauge", gauge)
            share = part(update, 0.0, 0.95)
            with session.metered("calibrate") as driven:
                session.run = about = about and about.begin()
                drive = StandingDrive(driven, session.limits, stance_of(session.twin_now, about))
                if isinstance(by, FilmingGauge):
                    measured = by.film(
                        drive, about.folder if about else None, count or by.postures, visits, share, fresh=fresh
                    )
                else:
                    measured, prior = _measured(drive, by, about, prior, count or POINTS, visits, share, begins=begins)
        update(0.95, "fitting")
        beside = RunFolder(Path(begins).parent) if begins else about and about.folder
        if known and beside and (begins or chosen.calibration is None) and _repeated(beside, session.arm, measured):
            prior = None  # it has seen them
        zeros = zeros_of(session.address or (about.robot if about else ""))
        result = _fitted(session.arm, measured, prior, zeros, taken=about is not None and before is None)
        check()  # what is interrupted changes nothing
        if about is not None:
            with saving(result):
                about.begin()
                write_calibration(set_aside(about.folder.calibration), result.calibration)
                if before is not None or result.filmed is not None:  # else set aside before the first one
                    set_aside(about.folder.measurements)
                # from then on nothing goes on from them
                write_measurements(about.folder.measurements, about.arm, result.measurements)
                if result.filmed is not None:
                    result.filmed.write(about.folder)
        return result


def _repeated(folder: RunFolder, arm: Arm, measured: Measurements | Film) -> bool:
    """Whether one of these postures is of the measurements on which a folder's calibration rests."""
    file, seen = folder.measurements, np.zeros((0, arm.joints))
    with suppress(FileError):
        if file.exists() and read_interrupted(file, arm) is None:
            seen = read_measurements(file, arm).position
    now = measured.position if isinstance(measured, Measurements) else [shot.position for shot in measured.usable]
    return any((seen == position).all(axis=-1).any() for position in now)


def _fitted(
    arm: Arm, measured: Measurements | Film, prior: Calibration | None, zeros: str, *, taken: bool
) -> Calibrated:
    date = f"{datetime.now().astimezone():%Y-%m-%dT%H:%M:%S%z}"
    filmed = None
    try:
        if isinstance(measured, Measurements):
            found = fit(arm, measured, prior=prior, date=date)
        else:
            filmed = measured.fit(arm, prior, date)
            found, measured = filmed.calibration, filmed.measurements
    except InputError as error:
        if taken:
            error.add_note("What was measured is kept; this measures again: rejoint calibrate ROBOT RUN --fresh")
        raise
    return Calibrated(
        calibration=replace(found, zeros=zeros),
        measurements=measured,
        reversal=reversals(found, measured),
        filmed=filmed,
    )
