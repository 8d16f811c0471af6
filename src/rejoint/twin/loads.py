"""What servos that report their load say of their torques.

Positions alone tell a joint's torques up to a common scale, which gravity and the links' inertia fix: badly where
little of either is felt, as about a vertical axis or near the flange. A load is a share of the servo's largest torque.
So the line of load over error, read where the joint stands (`servo_lines`), is stiffness over largest torque,
within some percent; and motors of one type have nearly the same largest torque. What the weight of the arm says of one
joint's torques holds for the others by that. The scale of all of them stays that of the masses: a load in N m would
need the motor's own constant, and data sheets and benches differ in it by more than masses do (an STS3215's stall
torque: 2.9 to 6 N m).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.monitor import servo_lines
from rejoint.logs.runlog import RunLog
from rejoint.twin.parameters import UNKNOWN_PARAMETERS, Layout, Prior, prior

COMMON = 1.0
"""Standard deviation of the common logarithm of the largest torques of one type (chosen: a factor of three)"""
OWN = 0.3
"""The same of a single motor beside it (chosen: those of emulated worn arms differ by 0.3)"""
ANY = 3.0
"""The same of a stiffness whose line is known, which comes by the largest torque alone (chosen: a factor of twenty)"""
OPEN = tuple(replace(p, alike=None) for p in UNKNOWN_PARAMETERS)
"""The table of parameters: wide, and the likeness of motors comes in by `OWN`"""


def prior_by_loads(arm: Arm, logs: Sequence[RunLog]) -> Prior | None:
    """Return the prior of an arm of which ``logs`` report loads; None where they say nothing.

    That needs lines of load over error, and two servos of one type (`Arm.servos`).
    """
    groups = [np.flatnonzero(np.array(arm.servos) == name) for name in sorted(set(arm.servos)) if name]
    alike = [group for group in groups if len(group) > 1]
    lines = servo_lines(arm, logs) if alike else None
    if lines is None:
        return None
    belief, layout = prior(arm, OPEN), Layout(arm.joints)
    limits, gains = layout.at("torque_limit"), layout.at("stiffness")
    mean, covariance = belief.mean.copy(), np.diag(belief.sigma**2)
    for group in alike:
        place = np.arange(limits.start, limits.stop)[group]
        mean[place] = mean[place].mean()
        covariance[np.ix_(place, place)] = COMMON**2 + OWN**2 * np.eye(len(group))
    within = np.broadcast_to(lines.within, arm.joints)
    for joint in [joint for joint in np.concatenate(alike) if np.isfinite(within[joint])]:
        covariance[gains.start + joint, gains.start + joint] = ANY**2
        row = np.zeros(len(mean))
        row[gains.start + joint], row[limits.start + joint] = 1.0, -1.0
        mean, covariance = _seen(mean, covariance, row, float(np.log(lines.gain[joint])), float(within[joint]))
    sigma = np.sqrt(np.diag(covariance))
    return replace(
        belief, mean=np.clip(mean, belief.lower, belief.upper), sigma=sigma,
        correlation=covariance / np.outer(sigma, sigma),
    )  # fmt: skip


def _seen(mean: Array, covariance: Array, row: Array, value: float, error: float) -> tuple[Array, Array]:
    """Mean (k,) and covariance (k, k) after ``row`` (k,) times the parameters was seen to be ``value``."""
    reach = covariance @ row
    share = reach / (row @ reach + error**2)
    return mean + share * (value - row @ mean), covariance - np.outer(share, reach)
