"""Measuring: the tool in many postures of an arm, by whatever tells where it is, kept as it comes."""

from __future__ import annotations

import logging
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.control.robot import Robot
from rejoint.control.servogains import limits_under
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.gauges import EmulatedGauge, Gauge
from rejoint.diagnosis.calibration.measurementfile import read_interrupted, write_measurements
from rejoint.diagnosis.calibration.measurements import Measurements, MeasuringSession
from rejoint.diagnosis.calibration.postures import Suggestion, suggest
from rejoint.diagnosis.calibration.procedure import measure
from rejoint.runs.run import Run
from rejoint.runs.stages.known import guard_limits, stance_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import set_aside
from rejoint.system.progress import Progress
from rejoint.system.shell import command

if TYPE_CHECKING:
    from rejoint.twin.twin import Twin

_LOGGER = logging.getLogger("rejoint")


def measured_of(
    robot: Robot, gauge: Gauge, run: Run | None, twin: Twin | None, prior: Calibration | None, count: int, visits: int,
    on_progress: Progress, *, afresh: bool = False,
) -> tuple[Measurements, Calibration | None]:  # fmt: skip
    """Measure an open robot; in a run, go on with what was interrupted there, unless ``afresh``.

    Returns the measurements, and the ``prior`` that is to be believed with them: none where they were begun afresh.
    """
    begun = None if run is None or afresh else interrupted(run, gauge)
    afresh = afresh or (begun is not None and begun[1].afresh)
    prior = None if afresh else prior
    plan = suggest(robot.arm, count * visits, visits=visits, sigma=gauge.sigma, prior=prior)
    if run is not None and begun is None:
        set_aside(run.folder.measurements)
    elif run is not None and begun is not None:
        _require_same(run, gauge, plan, *begun)
        log_resumed(run.folder.measurements, f"{begun[1].answered} of {len(plan.posture)} postures are done")

    def keep(measured: Measurements, answered: int) -> None:
        if run is not None:
            session = MeasuringSession(plan=plan.digest, answered=answered, afresh=afresh)
            write_measurements(run.folder.measurements, robot.arm, measured, session)

    try:
        found = measure(
            robot, gauge, plan, on_progress=on_progress, on_measured=keep, begun=begun,
            limits=limits_under(guard_limits(run, robot.arm, robot.address), robot, None), stance=stance_of(twin, run),
        )  # fmt: skip
    except BaseException as error:
        if run is not None and run.folder.measurements.exists():
            error.add_note(_kept(run, robot.address, gauge, afresh=afresh))
        raise
    return found, prior


def interrupted(run: Run, gauge: Gauge) -> tuple[Measurements, MeasuringSession] | None:
    """Return what was measured in a run that was interrupted, and how far it had come; None where a new one begins.

    What an emulator tells is measured anew: it takes nobody's time, and the same seed is to give the same again.
    """
    if isinstance(gauge, EmulatedGauge) or not run.folder.measurements.exists():
        return None
    try:
        return read_interrupted(run.folder.measurements, run.arm)
    except FileError as error:
        error.add_note("To measure anew in spite of it: --afresh")
        raise


def _require_same(run: Run, gauge: Gauge, plan: Suggestion, measured: Measurements, session: MeasuringSession) -> None:
    """Raise InputError where what was interrupted was measured in other postures, or by something else."""
    if (session.plan, measured.source, measured.frame) != (plan.digest, gauge.source, gauge.frame):
        raise InputError(
            f"{run.folder.measurements}: an interrupted session with another number of postures or sides, by something "
            "else, or with another --noise or --frame; give the same again, or begin anew with --afresh"
        )


def _kept(run: Run, robot: str, gauge: Gauge, *, afresh: bool) -> str:
    """Say where what was measured is, and what can be done with it."""
    file = run.folder.measurements
    fits = command("calibrate", robot, run.path, "--points", file, *(["--afresh"] if afresh else []))
    if isinstance(gauge, EmulatedGauge):
        return f"What was measured until then: {file}; what fits it: {fits}"
    return (
        f"What was measured until then is kept ({file}); {same(afresh=afresh)} goes on there, and this fits it: {fits}"
    )


def same(*, afresh: bool) -> str:
    """Name what goes on with a session that was interrupted, and was begun ``afresh`` or not."""
    return "the same command without --afresh" if afresh else "the same command"


def log_resumed(file: Path, done: str) -> None:
    """Tell that an interrupted session goes on, whose ``file`` is the newest of it, and how it would not."""
    written = datetime.fromtimestamp(file.stat().st_mtime)
    _LOGGER.warning(
        "Going on with what was interrupted at %s: %s (%s). Where arm or gauge were moved since, begin anew: --afresh.",
        f"{written:%Y-%m-%d %H:%M}", done, file,
    )  # fmt: skip
