"""What links of other masses than those assumed would do to an estimate.

Masses and centres of mass of an arm come from a data sheet or a drawing, and a fit takes them as they are; yet they are
what the common scale of a joint's torques rests on. So the covariance of an estimate gets a part for them: how far the
estimate would move, times how uncertain they are ("consider" covariance; Schmidt 1966, as in Bierman, Factorization
Methods for Discrete Sequential Estimation, 1977, chapter 8).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.twin.fit import Fit, Problem, influence
from rejoint.twin.parameters import unpack
from rejoint.twin.replay import Replay

COMMON, OWN = 0.10, 0.10
"""Standard deviation of the logarithm of all masses together, and of each by itself (chosen: 10 to 20 % together, as
printed parts, cables and screws make it)"""
CENTRE = 0.15
"""The same of the distance of a link's centre of mass from its joint (chosen likewise)"""
STEP = 0.1
"""Finite-difference step of the logarithms (chosen: as far as the uncertainty goes)"""


def mass_covariance(problem: Problem, fit: Fit, residual: Array, jacobian: Array, curvature: Array) -> Array:
    """Covariance (k, k) that an estimate has since its links are not known exactly.

    ``residual`` (rows, n) and ``jacobian`` (rows, n, q) are those at the estimate, ``curvature`` (k, k) is that of the
    data and the prior together.
    """
    moved, replay = [], problem.replay
    for arm, sigma in _other_arms(replay.arm):
        other = Replay(
            arm, replay.logs, replay.windows, replay.timestep, replay.threads, replay.stiction,
            acceleration=replay.acceleration,
        )  # fmt: skip
        path = np.concatenate(other.predict(unpack(fit.vector[None], problem.joints)), axis=1)[0]
        change = (path - problem.measured - residual) * (sigma / STEP)
        pull = np.zeros(len(fit.vector))
        for joint in range(problem.joints):
            weight = fit.weights.precision[:, joint] * influence(residual[:, joint])
            pull[problem.columns(joint)] += jacobian[:, joint].T @ (weight * change[:, joint])
        moved.append(np.where(problem.frozen | fit.at_bound, 0.0, pull))
    by = np.linalg.solve(curvature, np.array(moved).T)
    return np.asarray(by @ by.T)


def _other_arms(arm: Arm) -> Iterator[tuple[Arm, float]]:
    """Yield arms that differ by `STEP` in one way, and how uncertain that is."""
    every = np.ones(arm.joints)
    for factor, sigma in ((every, COMMON), *((row, OWN) for row in np.eye(arm.joints))):
        change = np.exp(STEP * factor)
        yield replace(arm, mass=arm.mass * change, inertia=arm.inertia * change[:, None, None]), sigma
    for row in np.eye(arm.joints):
        yield replace(arm, com=arm.com * np.exp(STEP * row)[:, None]), CENTRE
