"""Torques from servos that report their load.

Positions give a joint's torques up to a common scale, which gravity and link inertia fix, except for a vertical axis or
near the flange. A load is a share of the largest torque, so the slope of load over error at rest (`servo_lines`) is
stiffness over largest torque, within some percent. Equal motors share a scale. Stall torques in data sheets differ too
much to replace the masses (an STS3215: 2.9 to 6 N m).
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
"""Sigma of the common log largest torque of one type; chosen"""
OWN = 0.3
"""The same of a single motor beside it; chosen"""
ANY = 3.0
"""The same of a stiffness with a known line; chosen"""
OPEN = tuple(replace(p, alike=None) for p in UNKNOWN_PARAMETERS)
"""Wide parameters, without ``alike``: `OWN` replaces it"""


def prior_by_loads(arm: Arm, logs: Sequence[RunLog]) -> Prior | None:
    """Prior of an arm by the loads in its ``logs``; None without load lines or equal servos (`Arm.servos`)."""
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
        belief,
        mean=np.clip(mean, belief.lower, belief.upper),
        sigma=sigma,
        correlation=covariance / np.outer(sigma, sigma),
    )


def _seen(mean: Array, covariance: Array, row: Array, value: float, error: float) -> tuple[Array, Array]:
    """Mean (k,) and covariance (k, k) given ``value`` of ``row`` (k,) times the parameters."""
    reach = covariance @ row
    share = reach / (row @ reach + error**2)
    return mean + share * (value - row @ mean), covariance - np.outer(share, reach)
