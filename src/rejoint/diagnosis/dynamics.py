"""What fast motions say about a joint: inertia over stiffness, damping, delay, and the torque it really has.

All of it rests on the law of `rejoint.diagnosis.metrics`. Slow motions cannot tell a delay from a lag,
nor, on a stiff joint, from inertia over stiffness; the first moments of a step can, since a delayed
joint does not move at all. So every delay gets its own fit of the multisine, and the one whose fit
also starts the steps on time is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.arms.size import length_size, torque_size
from rejoint.diagnosis.metrics import nuisance, sweep_fit
from rejoint.diagnosis.modulation import Averages, window_averages
from rejoint.diagnosis.regression import LinearFit, fit_trimmed, mean_of
from rejoint.diagnosis.segments import ExcitationLog
from rejoint.system.statistics import Estimate

DELAYS = np.arange(0.005, 0.0801, 0.005)
"""[s] delays that are tried: from an idle wire to two periods of a slow one."""

_WINDOW = 0.4
"""[s] a period of the highest line of the multisine (chosen)."""

_TORQUE_WINDOW = 0.2
"""[s] (chosen: half of the shortest time that a weak joint stays at its limit)"""

_MIN_WINDOWS = 40
"""Windows of multisine that a fit needs: about 4 s (chosen)."""

_ONSET = 0.12
"""[s] of a step that decide about the delay (chosen: until a 0.2 rad step has been sent)."""

_STEP = 0.0025
"""[s] of the simulation of a step's beginning (chosen: a tenth of a usual period)."""

_NOMINAL_DELAY = 0.02
"""[s] with which friction is measured before the delay is known; it hardly matters there (chosen)."""

_EXCESS = 0.15
"""[N m] of a myCobot 280 that a demand exceeds what was given by chance (chosen; goes with the load of the arm)."""

_MIN_SHARE = 0.006
"""Share of the steady time that a joint must be behind (chosen: on emulated arms it is 0 without saturation and
0.02 at a torque limit that only the heaviest postures reach)."""

_STEADY = 1.5
"""[rad/s^2] up to which acceleration takes no torque worth counting: 0.05 N m of a joint of 0.03 kg m^2 (chosen; a
longer arm has more inertia for its load, so it goes with one over the reach)."""

_STANDING = 0.2
"""[rad/s] from which a joint that is behind and does not accelerate is on its way at its top speed (chosen: half of the
25 deg/s of a servo at a sixth of its speed; one whose load takes all of its torque stands, or creeps)"""

_MIN_RATIO = 5e-5
"""[s^2] J/k below which a fit is not believed: an oscillation at 22 Hz, stiffer than such a servo is (chosen)."""


def fit_dynamics(data: ExcitationLog, joint: int, delay: float) -> LinearFit:
    """Fit the multisine of a joint: coefficients (J/k [s^2], d/k [s], F/k [rad], 1/k [rad/(N m)], offset [rad])."""
    averages = _multisine(data, joint, np.array([delay]))
    return fit_trimmed(_design(data, averages), averages.error[0], averages.cluster)


def arm_delay(data: ExcitationLog) -> float:
    """Time [s] that commands and answers need on their way: the lower quartile over the joints.

    Joints with much friction or play start late for reasons of their own, hardly ever early.
    """
    found = []
    for joint in range(data.arm.joints):
        averages = _multisine(data, joint, DELAYS)
        fits = np.asarray(
            np.linalg.lstsq(_design(data, averages), averages.error.T, rcond=None)[0][:2].T, dtype=np.float64
        )
        sweep = sweep_fit(data, joint, _NOMINAL_DELAY)
        if sweep is None:  # a joint that does not move has no time of its own
            continue
        half_width = max(float(sweep.coefficients[1]), 0.0)
        found.append(_lowest(_onset_costs(data, joint, fits, half_width)))
    return float(np.quantile(found, 0.25)) if found else _NOMINAL_DELAY


def _multisine(data: ExcitationLog, joint: int, delays: Array) -> Averages:
    segments = data.of_kind("multisine", joint)
    averages = window_averages(data, segments, joint, length=_WINDOW, delays=delays, cut=float(DELAYS[-1]))
    data.require(len(averages.speed) >= _MIN_WINDOWS, "seconds of multisine", joint)
    return averages


def _design(data: ExcitationLog, averages: Averages) -> Array:
    return np.stack([averages.acceleration, averages.speed, averages.direction, *nuisance(data, averages)], axis=1)


def _lowest(cost: Array) -> float:
    """Delay [s] at the minimum of the parabola through the lowest cost (D,) and its neighbours."""
    i = int(np.argmin(cost))
    if 0 < i < len(cost) - 1 and np.isfinite(cost[i - 1 : i + 2]).all():
        before, here, after = cost[i - 1 : i + 2]
        bend = before - 2 * here + after
        return (
            float(DELAYS[i] + (DELAYS[1] - DELAYS[0]) * 0.5 * (before - after) / bend) if bend > 0 else float(DELAYS[i])
        )
    return float(DELAYS[i])


def _onset_costs(data: ExcitationLog, joint: int, fits: Array, half_width: float) -> Array:
    """Sum of squared errors (D,) of simulated step beginnings, one simulation per delay and step."""
    log, steps = data.log, data.of_kind("step", joint)
    data.require(len(steps) >= 2, "steps", joint)
    offsets = np.arange(0.0, _ONSET, _STEP)
    time = np.array([s.start for s in steps])[:, None] + offsets  # (S, K)
    before = np.maximum(np.searchsorted(log.time, time[:, 0]) - 1, 0)
    start = log.position[before, joint]
    drive = data.commanded(joint, time - DELAYS[:, None, None]) - log.command[before, joint][:, None]  # (D, S, K)
    ratio, lag = np.maximum(fits[:, :1], _MIN_RATIO), np.maximum(fits[:, 1:], 0.0)
    way, speed = np.zeros(drive.shape[:2]), np.zeros(drive.shape[:2])
    cost = np.zeros(len(DELAYS))
    answers = [np.interp(t, log.time, log.position[:, joint]) for t in time]
    moved = np.array(answers) - start[:, None]
    for k in range(len(offsets)):
        push = drive[..., k] - way
        sticks = (np.abs(speed) < 1e-3) & (np.abs(push) < half_width)
        against = np.where(np.abs(speed) < 1e-3, np.sign(push), np.sign(speed))
        # implicit in the lag term: a stiff joint's lag is shorter than the step
        speed = (speed + _STEP * (push - half_width * against) / ratio) / (1 + _STEP * lag / ratio)
        speed = np.where(sticks, 0.0, speed)
        way = way + _STEP * speed
        cost += ((way - moved[:, k]) ** 2).sum(axis=1)
    return np.where(fits[:, 0] > _MIN_RATIO, cost, np.inf)


@dataclass(frozen=True, kw_only=True, eq=False)
class Law:
    """Coefficients of the law of one joint, as `rejoint.diagnosis.metrics` writes it."""

    stiffness: float
    """k [N m/rad]"""
    lag: float
    """d/k [s]"""
    half_width: float
    """F/k [rad]"""
    delay: float
    """[s]"""
    offset: float = 0.0
    """[rad] of the error where nothing loads the joint"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Torque:
    """How much torque a joint was asked for and gave."""

    limit: Estimate | None
    """[N m] that reached the load where the joint stayed behind its command: the motor's limit, less the friction that
    held it; None where that never happened"""
    seen: float
    """[N m] largest that it gave: the limit is not lower than this"""
    saturated_share: float
    """share of the excitation's time that the joint spent at its limit"""


def torque_given(data: ExcitationLog, joint: int, law: Law) -> Torque:
    """Compare what a joint's law asks for with what its load shows that it gave, while it hardly accelerates.

    A joint counts as behind where it hardly turns and the demand is more than twice what it gave, and exceeds it by
    more than twice its friction, `_EXCESS`, and what 10 ms of wrong timing make of a moving command. It is at its
    limit if that happens in `_MIN_SHARE` of the time, and with near the largest torque that it ever gave.
    """
    segments = [s for s in data.segments if s.kind in ("sweep", "step", "multisine", "hold")]
    averages = window_averages(data, segments, joint, length=_TORQUE_WINDOW, delays=np.array([law.delay]))
    steady = np.abs(averages.acceleration) < _STEADY / length_size(data.arm)
    data.require(int(steady.sum()) >= _MIN_WINDOWS, "steady moments", joint)
    demand = (law.stiffness * (averages.error[0] - law.offset - law.lag * averages.speed))[steady]
    given = (averages.gravity + law.stiffness * law.half_width * averages.direction)[steady]
    margin = 2 * law.half_width + 0.010 * np.abs(averages.command_speed[steady])
    excess = np.abs(demand) - np.abs(given)
    behind = (
        (excess > np.abs(given))
        & (demand * given > 0)
        & (excess > law.stiffness * margin + _EXCESS * torque_size(data.arm))
        & (np.abs(averages.speed[steady]) < _STANDING)
    )
    cluster = averages.cluster[steady]
    seen = float(np.quantile(np.abs(given), 0.995))
    share = float(behind.mean())
    if share < _MIN_SHARE:
        return Torque(limit=None, seen=seen, saturated_share=0.0)
    clusters = np.unique(cluster[behind])
    limits = [float(np.median(np.abs(given[behind & (cluster == c)]))) for c in clusters]
    limit = mean_of(np.array(limits))
    if limit.value < 0.5 * seen:  # it could give more than this, and something else held it back
        return Torque(limit=None, seen=seen, saturated_share=0.0)
    return Torque(limit=limit, seen=seen, saturated_share=share)
