"""What a run knows of its arm and of the servos that it drives: limits, stance, twin, gains and correction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.loaded import bare
from rejoint.control.bands import standing_bands
from rejoint.control.correction import Modelled
from rejoint.control.gainsearch import GainsFound
from rejoint.control.guard import GuardLimits
from rejoint.control.lines import servo_lines
from rejoint.control.robot import Robot
from rejoint.control.servogains import ServoGains, differing, gains_in_force, stiffness_under
from rejoint.control.start import Stance
from rejoint.logs.runlog import read_log
from rejoint.robots import place_of
from rejoint.robots.own import unloaded
from rejoint.runs.given import CalibrationLike, as_calibration
from rejoint.runs.run import Run
from rejoint.system.errors import AddressError
from rejoint.system.files import read_json

if TYPE_CHECKING:
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.twin.twin import Twin


def guard_limits(run: Run | None, arm: Arm, robot: str) -> GuardLimits:
    """Return what the guard allows, and, if ``robot`` is the run's own, what its diagnosis tells of its joints.

    That is at which pushes they stand, and the lines of load over error of servos that tell loads. One that tells the
    gains of its own loop tells as load what that loop makes of its reading: from a dead encoder as from a live one.
    """
    limits, arm = GuardLimits.of(arm), bare(arm)  # the logs are of an empty hand
    paths = [] if run is None else [run.folder.log(name) for name in ("excitation", "targets")]
    if run is None or not _is_own(run, robot) or not all(path.exists() for path in paths):
        return limits
    logs = [read_log(path) for path in paths]
    told = run.diagnosis
    gains = None if told is None else told.servo_gains
    lines = servo_lines(arm, logs) if gains is None else None  # else the load is the loop's, and fits any reading
    return replace(limits, bands=standing_bands(arm, logs), servos=lines, gains=gains)


def _is_own(run: Run, robot: str) -> bool:
    """Whether ``robot`` may be the arm that a run measured: a real one has many addresses, a virtual one has one."""
    if unloaded(robot) == unloaded(run.robot):
        return True
    try:
        return not any(place_of(address).virtual for address in (run.robot, robot))
    except AddressError:  # a robot that was opened by other means
        return False


def stance_of(twin: Twin | None, run: Run | None) -> Stance | None:
    """Return where an arm is expected to stand at rest, as far off as in the diagnosis of its ``run``.

    None without a twin.
    """
    if twin is None:
        return None
    stance = _expected(twin)
    path = None if run is None else run.folder.log("targets")
    if run is None or path is None or not path.exists():
        return stance
    log, then = read_log(path), _expected(run.twin or twin)  # its servos had the gains of the diagnosis
    rests = np.append(np.flatnonzero((log.target[1:] != log.target[:-1]).any(axis=-1)), len(log) - 1)
    return replace(stance, off=then.away(bare(run.arm), log.position[rests], log.command[rests]).max(axis=0))


def _expected(twin: Twin) -> Stance:
    return Stance(stiffness=twin.parameters.stiffness, offset=twin.parameters.offset)


def twin_in_force(run: Run, robot: Robot) -> Twin | None:
    """Return the twin of a run, its servos as stiff as they are under the gains that those of ``robot`` have now."""
    twin, diagnosis = run.twin, run.diagnosis
    if twin is None or diagnosis is None:
        return twin
    return twin_under(twin, diagnosis.servo_gains, gains_in_force(robot))


def twin_under(twin: Twin, before: ServoGains | None, now: ServoGains | None) -> Twin:
    """Return a ``twin`` that was fitted under the gains ``before``, its servos as stiff as under those ``now``.

    The rest of a servo is left as it is: damping is its motor's back-EMF and D, friction what its startup force leaves.
    """
    stiffness = stiffness_under(twin.parameters.stiffness, before, now)
    return replace(twin, parameters=replace(twin.parameters, stiffness=stiffness))


def tuned_gains(run: Run | None) -> GainsFound | None:
    """Return what the search for better gains of a run found; None where there was none."""
    if run is None or not run.folder.gains.exists():
        return None
    return read_json(run.folder.gains, GainsFound)


def trained_for_tuned(run: Run | None) -> bool:
    """Whether the policy of a run was trained for the gains that its search found."""
    found, policy = tuned_gains(run), None if run is None else run.policy
    gains = None if policy is None else policy.contract.servo_gains
    return found is not None and gains is not None and not differing(gains, found.under)


def correction_of(
    given: CalibrationLike | None, run: Run | None, arm: Arm, robot: str, targets: Array | None = None
) -> Callable[[Arm], Modelled] | None:
    """Return what makes the correction of each motion; None where nothing is to be corrected.

    That is what is ``given``, or, if ``robot`` is the run's own, what its calibration says. ContractError where that is
    of another arm; InputError where it shifts the tool at rest, or one of the ``targets`` (..., 3) [m], by more than
    lies behind any worn arm's encoders: better known before the arm moves than when it is aimed.
    """
    calibration = calibration_of(given, run, arm, robot)
    if calibration is None:
        return None
    places = tcp_position(arm, arm.rest)[None]
    if targets is not None:
        places = np.concatenate([places, targets.reshape(-1, 3)])
    rest, every = np.broadcast_to(arm.rest, (len(places), arm.joints)), np.ones(len(places), dtype=bool)
    Modelled(arm, calibration.displacement).aim(places, rest, every)
    return partial(Modelled, displacement=calibration.displacement)


def calibration_of(given: CalibrationLike | None, run: Run | None, arm: Arm, robot: str) -> Calibration | None:
    """Return the calibration that `correction_of` corrects by; None where nothing is to be corrected."""
    found = as_calibration(given, run if run is not None and _is_own(run, robot) else None, arm)
    return found if found is not None and found.used else None
