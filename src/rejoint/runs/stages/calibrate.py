"""Measuring the tool in many postures of an arm."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import cast

from rejoint.arms import Arm
from rejoint.arms.camera.rig import write_rig
from rejoint.control.observer import Observer, pacing
from rejoint.control.robot import Robot
from rejoint.diagnosis.calibration.calibration import Calibration, write_calibration
from rejoint.diagnosis.calibration.camera.film import POSTURES as POSTURES_FILE
from rejoint.diagnosis.calibration.camera.film import Film, read_film, write_film, write_postures
from rejoint.diagnosis.calibration.camera.filming import POSTURES, CameraGauge, FilmDrive, Picture, UnseenBoardError
from rejoint.diagnosis.calibration.camera.fit import Filmed, fit_film
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurementfile import read_interrupted, read_measurements, write_measurements
from rejoint.diagnosis.calibration.measurements import Measurements, MeasuringSession
from rejoint.diagnosis.calibration.postures import suggest
from rejoint.diagnosis.calibration.preload import Preload, preload
from rejoint.diagnosis.calibration.procedure import EmulatedGauge, Gauge, measure, reversals
from rejoint.runs.run import Run
from rejoint.session.context import stance_of
from rejoint.session.inputs import ArmLike, RobotLike, RunLike, Settings, as_calibration
from rejoint.session.recorder import kept_if_stopped
from rejoint.session.session import ArmSession
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import saving, set_aside, write_whole
from rejoint.system.progress import Progress, part
from rejoint.system.stopping import noted

_LOGGER = logging.getLogger("rejoint")


def measured_of(
    session: ArmSession,
    robot: Robot,
    gauge: Gauge,
    prior: Calibration | None,
    count: int,
    visits: int,
    on_progress: Progress,
    *,
    fresh: bool = False,
) -> tuple[Measurements, Calibration | None]:
    """Measure a session's open robot; resume unless ``fresh``. Also returns the ``prior``."""
    run, begun = session.run, None
    if run is not None and not fresh and run.folder.measurements.exists():
        begun = read_interrupted(run.folder.measurements, run.arm)
        fresh = begun is not None and begun[1].fresh
    prior = None if fresh else prior
    plan = suggest(robot.arm, count * visits, visits=visits, sigma=gauge.sigma, prior=prior)
    if run is not None and begun is not None:
        before, earlier = begun
        if (earlier.plan, before.source, before.frame) != (plan.digest, gauge.source, gauge.frame):
            raise _another(run.folder.measurements, "another number of postures or sides, gauge, --noise or --frame")
        _log_resumed(run.folder.measurements, f"{earlier.answered} of {len(plan.posture)} postures are done")
    elif run is not None:
        set_aside(run.folder.measurements)

    def keep(measured: Measurements, answered: int) -> None:
        if run is not None:
            session = MeasuringSession(plan=plan.digest, answered=answered, fresh=fresh)
            write_measurements(run.folder.measurements, robot.arm, measured, session)

    with _noting(None if run is None else run.folder.measurements, fresh=fresh):
        found = measure(
            robot,
            gauge,
            plan,
            on_progress=on_progress,
            on_measured=keep,
            begun=begun,
            limits=session.limits,
            stance=stance_of(session.twin_now, run),
        )
    return found, prior


@contextmanager
def _noting(file: Path | None, *, fresh: bool) -> Iterator[None]:
    """Let an error say where an interrupted session is kept, and what goes on with it."""
    try:
        yield
    except BaseException as error:
        if file is not None and file.exists():
            again = "the same command" + " without --fresh" * fresh
            error.add_note(f"What was measured until then is kept ({file}); {again} goes on there.")
        raise


def _another(file: Path, what: str) -> InputError:
    return InputError(f"{file}: an interrupted session with {what}; give the same again, or begin again with --fresh")


def _log_resumed(file: Path, done: str) -> None:
    written = datetime.fromtimestamp(file.stat().st_mtime)
    _LOGGER.warning(
        "Going on with what was interrupted at %s: %s (%s). Where arm or gauge were moved since, begin again: --fresh.",
        f"{written:%Y-%m-%d %H:%M}",
        done,
        file,
    )


QUALITY = 92
"""JPEG quality of stored pictures; chosen"""


def film_of(
    session: ArmSession,
    robot: Robot,
    gauge: CameraGauge,
    count: int,
    visits: int,
    on_progress: Progress,
    *,
    fresh: bool = False,
) -> Film:
    """Take a session's image sequence; resume unless ``fresh``."""
    arm, run = robot.arm, session.run
    begun = None if run is None or fresh else _begun_film(run, gauge)
    film = begun or Film(board=gauge.board, carried=gauge.carried, fresh=fresh)
    if begun is None:
        _set_aside(run)
    elif run is not None:
        _log_resumed(run.folder.views, f"{len(film)} pictures are there")

    def keep(film: Film, name: str, picture: Picture) -> None:
        if run is not None:
            write_picture(run.folder.pictures / name, picture)
            write_film(run.folder.views, arm, film)

    with gauge.camera(robot) as camera, _noting(None if run is None else run.folder.views, fresh=film.fresh):
        drive = FilmDrive(
            robot=robot,
            camera=camera,
            film=film,
            limits=session.limits,
            stance=stance_of(session.twin_now, run),
            on_shot=keep,
            on_progress=on_progress,
        )
        try:
            return drive.take(count, visits)
        except UnseenBoardError:  # camera or board will be moved, so nothing of this belongs to what comes
            _set_aside(run)
            raise


def _set_aside(run: Run | None) -> None:
    if run is not None:
        set_aside(run.folder.views)
        set_aside(run.folder.pictures)


def _begun_film(run: Run, gauge: CameraGauge) -> Film | None:
    """Interrupted image sequence of a run, if any."""
    if not run.folder.views.exists():
        return None
    film, ended = read_film(run.folder.views, run.arm)
    if ended:
        return None
    if film.board != gauge.board or film.carried != gauge.carried:
        raise _another(run.folder.views, "another board, or with the board elsewhere")
    return film.again()


def write_picture(path: Path, picture: Picture) -> None:
    """Write a picture as JPEG; FileError if that fails."""
    import cv2

    good, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not good:
        raise FileError(path, "this picture cannot be written as JPEG", "take another camera")
    write_whole(path, lambda temporary: temporary.write_bytes(data.tobytes()))


POINTS = 10
"""Default number of postures (docs/true-accuracy.md)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibrated:
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
    gauge: Gauge | CameraGauge | Measurements | Film | Path | str | None = None,
    count: int | None = None,
    visits: int = 2,
    arm: ArmLike | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Calibrated:
    """Measure where an arm's tool is, fit its displacement, and store a correction that helps.

    The arm moves slowly to informative postures, from two sides each. In a run, `deploy` and `compare` then use the
    correction, and an interrupted session resumes.

    Parameters
    ----------
    robot
        robot or its address; None for earlier measurements
    run
        run, or its folder, for measurements, calibration and pictures
    gauge
        measuring device: `TouchGauge`, `TrackerGauge`, `CameraGauge`, or your own object with ``measure``;
        default: the emulator's truth with 0.5 mm of noise. Without a robot: measurements, their file, or pictures
    count
        postures; default: 10, with a camera 14 and 12 about rest
    visits
        2: from both sides, which shows play; 1: from one
    arm
        arm, name or file, if neither run nor address tells
    settings
        control period, seed, and ``calibration``: an earlier one to start from (default: the run's); ``none``: no
        prior and no resuming
    observer
        receives progress

    Returns
    -------
    Calibrated
        calibration, measurements, reversal values

    Raises
    ------
    InputError, ContractError
        for unusable measurements, or a calibration of another arm
    NotReadyError, GuardTripError, RobotError
        if the motion is unsafe or was ended; measurements are kept
    UnsavedError
        if writing failed; the error holds the result

    Examples
    --------
    >>> found = rejoint.calibrate("emulated:worn")
    >>> print(found.before, found.after, found.calibration.used)  # metres
    """
    chosen, before = settings or Settings(), gauge if isinstance(gauge, Measurements | Film | Path | str) else None
    if (robot is None) == (before is None):
        raise InputError("calibration: give either a robot or points that were measured before")
    if run is None and robot is None and arm is None:
        raise InputError("calibration: points alone do not tell of which arm they are; name the arm or the run")
    with (
        pacing(observer) as update,
        noted(),
        ArmSession(robot, run=run, arm=arm, settings=chosen, observer=observer) as session,
    ):
        about, prior = session.run, as_calibration(chosen.calibration, session.run, session.arm)
        fresh = isinstance(chosen.calibration, str) and chosen.calibration == "none"
        measured: Measurements | Film
        if isinstance(before, Path | str):
            measured = read_measurements(Path(before), session.arm)
        elif before is not None:
            measured = before
        else:
            by = EmulatedGauge(seed=session.seed) if gauge is None or chosen.dry_run else cast("Gauge", gauge)
            share = part(update, 0.0, 0.95)
            with session.metered("calibrate") as driven, kept_if_stopped(about, "calibrate"):
                session.run = about = about and about.begin()
                if isinstance(by, CameraGauge):
                    measured = film_of(session, driven, by, count or POSTURES, visits, share, fresh=fresh)
                    prior = None if measured.fresh else prior
                else:
                    measured, prior = measured_of(
                        session, driven, by, prior, count or POINTS, visits, share, fresh=fresh
                    )
        update(0.95, "fitting")
        result = _fitted(session.arm, measured, prior, taken=about is not None and before is None)
        if about is not None:
            with saving(result):
                _write(about, measured, result, taken=before is None)
        update(1.0, "fitted")
        return result


def _fitted(arm: Arm, measured: Measurements | Film, prior: Calibration | None, *, taken: bool) -> Calibrated:
    date = f"{datetime.now().astimezone():%Y-%m-%dT%H:%M:%S%z}"
    filmed = None
    try:
        if isinstance(measured, Film):
            filmed = fit_film(arm, measured, prior=prior, date=date)
            found, measured = filmed.calibration, filmed.measurements
        else:
            found = fit(arm, measured, prior=prior, date=date)
    except InputError as error:
        if taken or isinstance(measured, Film):
            error.add_note("What was measured is kept; --fresh measures again.")
        raise
    return Calibrated(
        calibration=found, measurements=measured, reversal=reversals(arm, measured, found.frame), filmed=filmed
    )


def _write(run: Run, measured: Measurements | Film, result: Calibrated, *, taken: bool) -> None:
    run.begin()
    set_aside(run.folder.calibration)
    write_calibration(run.folder.calibration, result.calibration)
    write_measurements(run.folder.measurements, run.arm, result.measurements)  # from then on nothing goes on from them
    found = result.filmed
    if isinstance(measured, Film) and found is not None:
        if taken:
            write_postures(run.folder.pictures / POSTURES_FILE, run.arm, measured)
        else:
            set_aside(run.folder.views)
        write_film(run.folder.views, run.arm, measured, ended=True)
        set_aside(run.folder.camera)
        write_rig(run.folder.camera, run.arm, found.rig, found.rig_sigma, found.calibration.date)
