"""The uncertainty of a fit.

The jackknife over clusters, each left out by one Newton step (CR3 of Bell and McCaffrey 2002; Cameron and Miller 2015),
with Student's quantile; clusters are motions, or stretches of an excitation. Curvature and scores alone (Huber 1967)
are too narrow.

What a fit holds fixed widens it too ("consider" covariance, Schmidt 1966; Bierman 1977, chapter 8). A torque
limit that explains no motion shows nothing, nor does that of a joint whose motion is not explained: the prior remains.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rejoint.arms import Array, Index, Mask
from rejoint.diagnosis.measurement import CENTRE, MASS
from rejoint.system.statistics import NORMAL95, student95
from rejoint.twin.fit import SCALES, STIFFNESS, Fit, Problem, explained, influence, loss
from rejoint.twin.parameters import Prior, number, unpack
from rejoint.twin.replay import Replay
from rejoint.twin.structure import LIMIT_GAIN

CLUSTER = 3.0
"""[s]; chosen: longer than stick-slip and the slowest oscillation"""

TORQUE_LIMIT = number("torque_limit")
SCALE_STEP = SCALES[-2]
"""Step of `SCALES`; measured: without it only 4 of 5 intervals agree"""


def uncertainty(problem: Problem, fit: Fit, clusters: Index) -> Array:
    """Covariance (k, k) of an estimate from the scores of ``clusters`` (rows,) and what it holds fixed."""
    prior = problem.prior
    residual, jacobian = _central_differences(problem, fit.vector)
    weight = fit.weights.precision * influence(residual)
    rows = np.arange(clusters.max() + 1)[:, None] == clusters
    parts = [problem.system(jacobian[own], weight[own], residual[own]) for own in rows]
    curvatures, scores = map(np.stack, zip(*parts, strict=True))
    covariance = jackknife(prior, curvatures, scores) + _scale(problem, fit.vector)
    covariance += fixed_covariance(problem, fit, residual, jacobian, weight, curvatures.sum(axis=0) + prior.precision)
    covariance += np.diag(problem.layout.has("beside") ** 2)
    return 0.5 * (covariance + covariance.T)


def _scale(problem: Problem, x: Array) -> Array:
    """Covariance (k, k) of each joint's common scale, by the ladder and by the prior's gravity."""
    owner, sigma = problem.owner, problem.prior.sigma[problem.layout.at("compensation")]
    up, down = problem.rescaled(x, (SCALE_STEP**0.5, SCALE_STEP**-0.5))
    steps = np.stack([(up - down) / NORMAL95, np.where(problem.layout.is_log & (owner >= 0), sigma[owner], 0.0)])
    return steps.T @ steps * (owner[:, None] == owner)


def jackknife(prior: Prior, curvatures: Array, scores: Array) -> Array:
    """Covariance (k, k) of a posterior from the curvatures (g, k, k) and scores (g, k) of g clusters."""
    count, precision = len(scores), prior.precision
    whole = curvatures.sum(axis=0)
    without = np.linalg.solve(whole - curvatures + precision, scores[..., None])[..., 0]
    inverse = np.linalg.inv(whole + precision)
    factor = (student95(max(count - 1, 1)) / NORMAL95) ** 2
    return (
        factor * (count - 1) / count * without.T @ without
        + factor * inverse @ whole @ inverse
        + inverse @ precision @ inverse
    )


def _central_differences(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Residual (rows, n) at ``x`` and sensitivities (rows, n, q), one-sided near a bound."""
    ones = np.ones(len(x))
    up, down = problem.inward(x, ones), problem.inward(x, -ones)
    residuals = problem.residuals(np.vstack([x, problem.perturbations(x, up), problem.perturbations(x, down)]))
    base, count = residuals[0], (len(residuals) - 1) // 2
    forward = problem.jacobian(base, residuals[1 : 1 + count], up)
    backward = problem.jacobian(base, residuals[1 + count :], down)
    central = 0.5 * (forward + backward)
    shown = limiting(problem, x)
    lost = central[..., TORQUE_LIMIT] - np.where(shown, forward[..., TORQUE_LIMIT], 0.0)
    central[..., TORQUE_LIMIT] -= lost
    central[..., STIFFNESS] += lost  # the slope along the common scale stays what was simulated
    return base, central


def limiting(problem: Problem, x: Array) -> Mask:
    """(n,) whether each joint's motion is explained, and worse without its torque limit in ``x`` (k,)."""
    unlimited = np.where(problem.layout.kind == TORQUE_LIMIT, problem.prior.upper, x)
    residuals = problem.residuals(np.array([x, unlimited]))
    losses = loss(residuals).sum(axis=1)
    return explained(residuals[0]) & (losses[0] < (1.0 - LIMIT_GAIN) * losses[1])


COMMON = 0.10
"""Sigma of the log mass of all links; chosen"""
STEP = 0.05
"""Finite-difference step of the logarithms; chosen"""


def fixed_covariance(
    problem: Problem, fit: Fit, residual: Array, jacobian: Array, weight: Array, curvature: Array
) -> Array:
    """Covariance (k, k) of an estimate by what it holds fixed.

    ``residual`` (rows, n), ``jacobian`` (rows, n, q), ``weight`` (rows, n) and ``curvature`` (k, k), with
    the prior, at the estimate.
    """
    moved = []
    for other, sigma in others(problem.replay):
        path = np.concatenate(other.predict(unpack(fit.vector[None], problem.joints)), axis=1)[0]
        change = (path - problem.measured - residual) * (sigma / STEP)
        pull = problem.system(jacobian, weight, change)[1]
        moved.append(np.where(problem.frozen | fit.at_bound, 0.0, pull))
    by = np.linalg.solve(curvature, np.array(moved).T)
    return by @ by.T


def others(replay: Replay) -> Iterator[tuple[Replay, float]]:
    """Replays with one thing changed by `STEP` that a fit holds fixed, and its sigma."""
    arm, every = replay.arm, np.ones(replay.arm.joints)
    for factor, sigma in ((every, COMMON), *((row, MASS) for row in np.eye(arm.joints))):
        change = np.exp(STEP * factor)
        heavier = replace(arm, mass=arm.mass * change, inertia=arm.inertia * change[:, None, None])
        yield replace(replay, arm=heavier), sigma
    for row in np.eye(arm.joints):
        yield replace(replay, arm=replace(arm, com=arm.com * np.exp(STEP * row)[:, None])), CENTRE
