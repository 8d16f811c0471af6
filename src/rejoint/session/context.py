"""What a run knows of its arm and servos: limits, rest posture, twin, gains, correction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.correction import Modelled
from rejoint.control.guard import GuardLimits
from rejoint.control.monitor import servo_lines, standing_bands
from rejoint.control.robot import Robot
from rejoint.control.servogains import GainsFound, ServoGains, differing, gains_in_force, stiffness_under
from rejoint.control.start import Stance
from rejoint.logs.runlog import read_log
from rejoint.robots import place_of
from rejoint.runs.run import Run
from rejoint.session.inputs import CalibrationLike, as_calibration
from rejoint.session.payload import Say, silent
from rejoint.session.settings import laden
from rejoint.system.errors import AddressError
from rejoint.system.files import read_json

if TYPE_CHECKING:
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.twin.twin import Twin


def guard_limits(run: Run | None, arm: Arm, robot: str) -> GuardLimits:
    """Guard's limits, with friction bands and load lines if ``robot`` is the run's own.

    No load lines where a servo reports its gains: its loads are of its loop and fit any reading.
    """
    limits = GuardLimits.of(arm)
    paths = [] if run is None else [run.folder.log(name) for name in ("excitation", "targets")]
    if run is None or not _is_own(run, robot) or not all(path.exists() for path in paths):
        return limits
    logs = [read_log(path) for path in paths]
    arm, told = laden(run), run.diagnosis
    gains = None if told is None else told.servo_gains
    lines = servo_lines(arm, logs) if gains is None else None  # else the load is the loop's, and fits any reading
    return replace(limits, bands=standing_bands(arm, logs), servos=lines, gains=gains)


def _is_own(run: Run, robot: str) -> bool:
    try:
        own, here = place_of(run.robot), place_of(robot)
    except AddressError:  # a robot that was opened by other means
        return robot == run.robot
    return own.unloaded == here.unloaded or not (own.virtual or here.virtual)


def stance_of(twin: Twin | None, run: Run | None) -> Stance | None:
    """Return the expected rest posture, as far off as in the diagnosis of ``run``; None without a twin."""
    if twin is None:
        return None
    stance = _expected(twin)
    path = None if run is None else run.folder.log("targets")
    if run is None or path is None or not path.exists():
        return stance
    log, then = read_log(path), _expected(run.twin or twin)  # its servos had the gains of the diagnosis
    rests = np.append(np.flatnonzero((log.target[1:] != log.target[:-1]).any(axis=-1)), len(log) - 1)
    return replace(stance, off=then.away(laden(run), log.position[rests], log.command[rests]).max(axis=0))


def _expected(twin: Twin) -> Stance:
    return Stance(stiffness=twin.parameters.stiffness, offset=twin.parameters.offset)


def twin_in_force(run: Run, robot: Robot) -> Twin | None:
    """Return a run's twin, as stiff as the gains of ``robot`` make it now."""
    twin, diagnosis = run.twin, run.diagnosis
    if twin is None or diagnosis is None:
        return twin
    return twin_under(twin, diagnosis.servo_gains, gains_in_force(robot))


def twin_under(twin: Twin, before: ServoGains | None, now: ServoGains | None) -> Twin:
    """Return a ``twin`` fitted under the gains ``before``, made as stiff as ``now``."""
    stiffness = stiffness_under(twin.parameters.stiffness, before, now)
    return replace(twin, parameters=replace(twin.parameters, stiffness=stiffness))


def tuned_gains(run: Run | None) -> GainsFound | None:
    """Gains that the run's search found."""
    if run is None or not run.folder.gains.exists():
        return None
    return read_json(run.folder.gains, GainsFound)


def trained_for_tuned(run: Run | None) -> bool:
    """Whether the policy of a run was trained for its tuned gains."""
    found, policy = tuned_gains(run), None if run is None else run.policy
    gains = None if policy is None else policy.contract.servo_gains
    return found is not None and gains is not None and not differing(gains, found.under)


def corrected_by(calibration: Calibration | None, arm: Arm) -> Modelled | None:
    """Correction of a calibration, or None; InputError as below."""
    if calibration is None:
        return None
    require_correctable(calibration, arm, tcp_position(arm, arm.rest)[None])
    return Modelled(arm, calibration.displacement)


def require_correctable(calibration: Calibration | None, arm: Arm, targets: Array) -> None:
    """Raise InputError where a calibration shifts ``targets`` (..., 3) [m] too far."""
    if calibration is not None:
        places = targets.reshape(-1, 3)
        rest = np.broadcast_to(arm.rest, (len(places), arm.joints))
        Modelled(arm, calibration.displacement).aim(places, rest, np.ones(len(places), dtype=bool))


def correction_of(
    given: CalibrationLike | None, run: Run | None, arm: Arm, robot: str, targets: Array | None = None
) -> Callable[[Arm], Modelled] | None:
    """Return what makes a correction for each motion, or None; errors as above."""
    calibration = calibration_of(given, run, arm, robot)
    if calibration is None:
        return None
    require_correctable(calibration, arm, tcp_position(arm, arm.rest) if targets is None else targets)
    return partial(Modelled, displacement=calibration.displacement)


def calibration_of(
    given: CalibrationLike | None, run: Run | None, arm: Arm, robot: str, say: Say = silent
) -> Calibration | None:
    """Calibration given, or that of the run for its own robot, where it helps; ``say`` receives why not.

    ContractError for another arm.
    """
    found = as_calibration(given, run, arm)
    if found is None:
        return None
    own = given is not None or run is None or _is_own(run, robot)
    if own and found.used:
        return found
    why = "it did not clearly help" if own else f"it is not of {robot}"
    name = given if isinstance(given, str | Path) else "the calibration" if run is None else run.folder.calibration
    say(f"Not corrected: {name} is not applied; {why}.")
    return None
