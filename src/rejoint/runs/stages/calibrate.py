"""Calibration: where the tool really is, measured from outside, and a correction where that helps."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.camera.film import Film
from rejoint.diagnosis.calibration.camera.filming import POSTURES, CameraGauge
from rejoint.diagnosis.calibration.camera.fit import Filmed, fit_film
from rejoint.diagnosis.calibration.file import write_calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.gauges import EmulatedGauge, Gauge
from rejoint.diagnosis.calibration.measurementfile import read_measurements, write_measurements
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.preload import Preload, preload
from rejoint.diagnosis.calibration.procedure import reversals
from rejoint.runs.given import (
    ArmLike,
    CalibrationLike,
    Live,
    Period,
    RobotLike,
    RunLike,
    TwinLike,
    arm_of,
    as_calibration,
    as_run,
    as_twin,
    opened,
    shown,
)
from rejoint.runs.metering import metered
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.filming import film_of, write_filmed
from rejoint.runs.stages.keeping import kept_if_stopped
from rejoint.runs.stages.measuring import measured_of
from rejoint.system.errors import InputError
from rejoint.system.files import require_space, saving, set_aside
from rejoint.system.numbers import as_seed
from rejoint.system.progress import Progress, no_progress, part

if TYPE_CHECKING:
    from rejoint.arms import Arm
    from rejoint.diagnosis.calibration.camera.adjustment import Tip

POINTS = 10
"""Postures that are measured where nobody says how many (docs/true-accuracy.md: from five to ten the error falls by a
tenth, from ten to twenty by another)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibrated:
    """What a calibration found."""

    calibration: Calibration
    """where the tool is behind the encoders; ``used`` says whether correcting by it clearly helped"""
    measurements: Measurements
    """what it was found from"""
    reversal: tuple[float, ...]
    """[m] reversal value at the tool (ISO 230-2) of each posture that was come to from two sides"""
    filmed: Filmed | None = None
    """what a camera's pictures told besides: lens, camera, board, how well each picture fits; None without a camera"""

    @property
    def before(self) -> float:
        """[m] mean true error at points left out, as the encoders have it."""
        return self.calibration.before

    @property
    def after(self) -> float:
        """[m] the same by the calibration that had not seen them."""
        return self.calibration.after

    @cached_property
    def preload(self) -> Preload:
        """What would press joints that float to one side of their play, at the postures that were measured."""
        return preload(self.calibration, self.measurements.position)


def calibrate(
    robot: RobotLike | None = None,
    *,
    run: RunLike | None = None,
    gauge: Gauge | CameraGauge | None = None,
    points: Measurements | Film | Path | str | None = None,
    count: int | None = None,
    visits: int = 2,
    arm: ArmLike | None = None,
    twin: TwinLike | None = None,
    prior: CalibrationLike | None = None,
    period: Period | None = None,
    seed: int | None = None,
    on_progress: Progress = no_progress,
    live: Live | None = None,
) -> Calibrated:
    """Measure where the tool of an arm really is, fit what lies behind its encoders, and keep it if correcting helps.

    The arm goes slowly, under the guard, to postures that tell most, and stands still at each, come to from two sides.
    In a run, `deploy` and `compare` correct by it from then on, and what was interrupted goes on where it was.

    Parameters
    ----------
    robot
        robot or its address; None where ``points`` were measured before
    run
        run, or its folder, into which ``measurements.parquet`` and ``calibration.toml`` are written; with a camera
        ``views.parquet``, the pictures and ``camera.toml`` as well
    gauge
        what measures the tool: `TouchGauge`, `TrackerGauge`, `CameraGauge`, or an object of your own with a ``measure``
        like theirs; by default an emulated arm's own knowledge, with 0.5 mm of noise
    points
        measurements, a file of them (Parquet or CSV), or a film of a board, instead of a robot
    count
        number of postures; by default 10, with a camera 14 and 12 pictures about the rest posture
    visits
        2: come to each posture from both sides, so that play shows; 1: from one
    arm
        arm, name or file; needed only without a run, where the address does not tell
    twin
        twin that says how far the arm should sag at rest, which is checked; by default that of the run
    prior
        earlier calibration of the same arm to start from, so that few points suffice; ``none``: from nothing, and
        without what was interrupted. By default that of the run
    period
        [s] interval of the control periods; by default what the robot suits
    seed
        of an emulated arm's noise; by default that of the run, else 0
    on_progress
        called with the share that is done and what is being measured
    live
        shows the arm meanwhile: a `LiveView`

    Returns
    -------
    Calibrated
        the calibration, the measurements, and the reversal values

    Raises
    ------
    InputError, ContractError
        if measurements cannot be used, or an earlier calibration is of another arm
    NotReadyError, GuardTripError, RobotError
        if the arm had better not be moved, or its motion had to be ended; what was measured is kept
    UnsavedError
        if the result could not be written; it is in the error

    Examples
    --------
    >>> found = rejoint.calibrate("emulated:worn")
    >>> print(found.before, found.after, found.calibration.used)  # metres
    """
    if (robot is None) == (points is None):
        raise InputError("calibration: give either a robot or points that were measured before")
    about = None if run is None else as_run(run).seeded(seed)
    if about is None and robot is None and arm is None:
        raise InputError("calibration: points alone do not tell of which arm they are; name the arm or the run")
    chosen = about.arm if about is not None else arm_of(robot or "", arm)
    seed = as_seed(seed) if about is None else about.seed
    afresh = isinstance(prior, str) and prior == "none"
    with exclusive(about):
        believed = as_calibration(prior, about, chosen)
        known = as_twin(twin) if twin is not None else None if about is None else about.twin
        measured: Measurements | Film
        if points is not None:
            measured = read_measurements(Path(points), chosen) if isinstance(points, Path | str) else points
        else:
            if about is not None:
                require_space(about.path)
            assert robot is not None  # noqa: S101 - for the type checker; one of the two is given
            with (
                metered(about.folder if about else None, "calibrate") as meter, kept_if_stopped(about, "calibrate"),
                opened(robot, chosen, seed, period) as opening,
            ):  # fmt: skip
                connection = shown(live, meter.watch(opening), twin=known)
                about = about and about.begin()
                share = part(on_progress, 0.0, 0.95)
                if isinstance(gauge, CameraGauge):
                    measured = film_of(connection, gauge, about, known, count or POSTURES, visits, share, afresh=afresh)
                    believed = None if measured.afresh else believed
                else:
                    measured, believed = measured_of(
                        connection, gauge or EmulatedGauge(seed=seed), about, known, believed, count or POINTS, visits,
                        share, afresh=afresh,
                    )  # fmt: skip
        on_progress(0.95, "fitting")
        tip = gauge.tip if isinstance(gauge, CameraGauge) else None
        result = _fitted(chosen, measured, believed, tip, taken=about is not None and points is None)
        if about is not None:
            with saving(result):
                _write(about, measured, result, taken=points is None)
        on_progress(1.0, "fitted")
        return result


def _fitted(
    arm: Arm, measured: Measurements | Film, prior: Calibration | None, tip: Tip | None, *, taken: bool
) -> Calibrated:
    """Fit points, or what a film shows; ``taken`` tells whether they are kept in a run and were made just now."""
    date = f"{datetime.now().astimezone():%Y-%m-%dT%H:%M:%S%z}"
    filmed = None
    if isinstance(measured, Film):
        try:
            filmed = fit_film(arm, measured, prior=prior, tip=tip, date=date)
        except InputError as error:
            error.add_note("The pictures are kept; --afresh takes them anew.")
            raise
        found, measured = filmed.calibration, filmed.measurements
    else:
        try:
            found = fit(arm, measured, prior=prior, date=date)
        except InputError as error:
            if taken:
                error.add_note("What was measured is kept; --afresh measures anew.")
            raise
    return Calibrated(
        calibration=found, measurements=measured, reversal=reversals(arm, measured, found.frame), filmed=filmed
    )


def _write(run: Run, measured: Measurements | Film, result: Calibrated, *, taken: bool) -> None:
    """Keep what was found in the run; ``taken`` tells whether a film was taken just now."""
    run.begin()
    set_aside(run.folder.calibration)
    write_calibration(run.folder.calibration, result.calibration)
    write_measurements(run.folder.measurements, run.arm, result.measurements)  # from then on nothing goes on from them
    if isinstance(measured, Film) and result.filmed is not None:
        write_filmed(run, run.arm, measured, result.filmed, taken=taken)
