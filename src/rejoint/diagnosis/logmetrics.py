"""What logs of any motion say about a joint: the law of `rejoint.diagnosis.metrics`, fitted to slow free motion.

An excitation shows every term of that law where nothing else disturbs it. Logs from elsewhere do not, so
all terms are fitted at once to every moment in which a joint moves, in either direction, and whole motions count as
one observation of what they share. What such a fit leaves open stays open: a joint that gravity does not load has
no stiffness here, one that moves in one direction only no friction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.size import torque_size
from rejoint.diagnosis import metrics
from rejoint.diagnosis.measurement import JointMetrics, friction_torque, scaled
from rejoint.diagnosis.modulation import Averages, window_averages
from rejoint.diagnosis.regression import LinearFit, fit_trimmed, reciprocal
from rejoint.diagnosis.segments import ExcitationLog
from rejoint.diagnosis.spans import FREE, STEP, STILL, log_of
from rejoint.system.statistics import Estimate

_WINDOW = 0.3
"""[s] of a window (chosen: of the half seconds that a hobby arm needs for a reversal)"""

COARSEST = 0.1
"""[s] between readings above which a window holds too few (chosen: three; at 0.2 s a healthy SO-101 looks sticky)"""

_SETTLING = 0.2
"""[s] of a free stretch that are left out at its beginning (chosen)"""

SLOW = 0.6
"""[rad/s] of a joint above which its motion is left out: limits of the servo show beyond (chosen)"""

MAX_ACCELERATION = 5.0
"""[rad/s^2] of a joint above which its motion is left out (chosen likewise)"""

BOTH_WAYS = 0.1
"""Least share of the moving windows in either direction: friction is half of what differs between the two (chosen)"""

MANY_LOGS = 8
"""From as many logs on, logs count as independent observations, below stretches of 8 s (chosen: a covariance of
fewer clusters is mostly noise)"""

FEWEST = 8
"""Independent observations below which nothing is said: five coefficients, and a spread (chosen)"""

LOADED = 0.05
"""[N m] of a myCobot 280 by which gravity's torque has to vary for a joint's stiffness to show (chosen; goes with the
load of the arm)"""

KNOWN_WITHIN = 4.0
"""Ratio of an interval's ends up to which a stiffness is given (chosen: a factor of two to either side)"""

FEWEST_STEPS, FEWEST_RESTS = 3, 4
"""Steps and rests below which nothing is said about overshoot, unrest and noise (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Slow:
    """The law of one joint as its free slow motion shows it."""

    fit: LinearFit
    """coefficients (lag [s], F/k [rad], J/k [s^2], 1/k [rad/(N m)], offset of the error [rad])"""
    gravity_range: float
    """[N m] variation of gravity's torque"""
    residual: float
    """[rad] exceeded by one window in 200"""


def measure_joint(data: ExcitationLog, joint: int) -> JointMetrics:
    """Measure one joint from joined logs; what they do not tell is None."""
    slow = slow_motion(data, joint)
    k = None if slow is None else _stiffness(data, slow)
    half = None if slow is None else slow.fit.estimate(1)
    friction = None if k is None or half is None else friction_torque(k, half)
    load = float(np.quantile(np.abs(data.gravity[:, joint]), 0.995))
    return JointMetrics(
        joint=data.arm.joint_names[joint],
        stiffness_nm_per_rad=k,
        stiffness_source="none" if k is None else "gravity",
        hysteresis_rad=None if half is None else scaled(half, 2.0),
        coulomb_nm=friction,
        lag_s=None if slow is None else slow.fit.estimate(0),
        damping_ratio=None,
        overshoot=metrics.overshoot(data, joint) if len(data.of_kind(STEP, joint)) >= FEWEST_STEPS else None,
        hunting_rad=metrics.hunting(data, joint),
        noise_rad=metrics.noise(data, joint) if len(data.of_kind(STILL)) >= FEWEST_RESTS else None,
        torque_limit_nm=None,
        torque_seen_nm=load + (0.0 if friction is None else friction.value),
        saturated_share=0.0,
        motor_inertia_kg_m2=None,
        sweep_gain=_gain(data, joint),
        stuck_rad=0.0 if slow is None else slow.residual,
        offset_rad=None if slow is None else scaled(slow.fit.estimate(4), -1.0),
    )


def slow_motion(data: ExcitationLog, joint: int) -> Slow | None:
    """Fit the law to the free slow motion of a joint; None where there is too little, or in one direction only.

    None as well where readings are further apart than `COARSEST`.
    """
    if float(np.median(np.diff(data.log.time))) > COARSEST:
        return None
    segments = data.of_kind(FREE)
    averages = window_averages(data, segments, joint, length=_WINDOW, delays=np.array([0.0]), cut=_SETTLING)
    chosen = np.abs(averages.direction) > metrics.MOVING
    chosen &= (np.abs(averages.speed) < SLOW) & (np.abs(averages.acceleration) < MAX_ACCELERATION)
    cluster = _observations(averages, np.array([log_of(segment) for segment in segments], dtype=np.intp))[chosen]
    forward = averages.direction[chosen] > 0
    ways = [len(np.unique(cluster[way])) for way in (forward, ~forward)]
    if min(ways) < FEWEST or not BOTH_WAYS < forward.mean() < 1.0 - BOTH_WAYS:
        return None
    sign, one = np.where(forward, 1.0, -1.0), np.ones(len(forward))
    design = np.stack(
        [averages.speed[chosen], sign, averages.acceleration[chosen], averages.gravity[chosen], one], axis=1
    )
    error = averages.error[0, chosen]
    fit = fit_trimmed(design, error, cluster)
    return Slow(
        fit=fit,
        gravity_range=float(np.ptp(averages.gravity[chosen])),
        residual=float(np.quantile(np.abs(error - design @ fit.coefficients), 0.995)),
    )


def _observations(averages: Averages, logs: NDArray[np.intp]) -> NDArray[np.intp]:
    """Tell the windows (N,) apart by what counts as independent: their log, or in few logs a stretch of 8 s."""
    segment, piece = np.divmod(averages.cluster, 1000)  # pieces of 2 s, see `rejoint.diagnosis.modulation`
    if len(np.unique(logs)) >= MANY_LOGS:
        return np.asarray(logs[segment], dtype=np.intp)
    return np.asarray(1000 * segment + piece // 4, dtype=np.intp)


def _stiffness(data: ExcitationLog, slow: Slow) -> Estimate | None:
    if slow.gravity_range < LOADED * torque_size(data.arm) or slow.fit.coefficients[3] <= 0:
        return None
    k = reciprocal(slow.fit.estimate(3))
    return None if k.low is None or k.high is None or k.high > KNOWN_WITHIN * k.low else k


def _gain(data: ExcitationLog, joint: int) -> float | None:
    """Share of the commands' range that the joint covers, in all rows; None where it was hardly told to move."""
    asked = float(np.ptp(data.log.command[:, joint]))
    return float(np.ptp(data.log.position[:, joint])) / asked if asked > metrics.MIN_SWEEP else None
