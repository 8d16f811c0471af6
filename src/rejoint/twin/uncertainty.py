"""How well a fit knows its parameters.

Method: the jackknife over clusters, each left out in turn by one Newton step (CR3 of Bell and McCaffrey 2002; advised
for few and unequal clusters by Cameron and Miller 2015), with Student's quantile. Clusters are the motions of logs, and
stretches of an excitation longer than the memory of its residuals. What is built on the curvature and the scores alone
(Huber 1967; Liang and Zeger 1986) is far too narrow even where the twin's structure is the arm's: by `python -m
benchmarks truth` a third of its 95 % intervals held the truth.

Where stick-slip makes differences of two simulations noisy, their squares pass for curvature: in directions that the
data hardly fix up to eight times as much as there is (measured). So the curvature of each such direction is taken from
the loss itself, two standard deviations to either side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.system.statistics import NORMAL95, student95
from rejoint.twin.fit import SCALES, STIFFNESS, Fit, Problem, influence, loss
from rejoint.twin.masses import mass_covariance
from rejoint.twin.parameters import Prior, number

CLUSTER = 3.0
"""[s] longer than a stick-slip cycle and than the slowest oscillation of a worn arm (chosen)"""

TORQUE_LIMIT = number("torque_limit")
"""Column of the sensitivities that is the torque limit's"""

REACH = 2.0
"""Standard deviations to either side from which the loss's own curvature is taken (chosen: the ends of an interval)"""
LEAST_SHARE = 0.01
"""Least share of the curvature that is left of a direction along which the loss does not grow (chosen)"""
SCALE_STEP = float(np.log(SCALES[-2]))
"""Step of the ladder `rejoint.twin.fit.SCALES`, taken as half a 95 % interval: fits to disjoint halves of a real arm's
motions stop as far apart, and only 4 of 5 intervals agree without it (measured)"""

IDENTIFIED = 0.5
"""A parameter counts as identified when the data at least halve its prior standard deviation (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Uncertainty:
    """Covariance of an estimate over the parameter vector of length k."""

    covariance: Array
    """(k, k) of the posterior: what the data do not say, the prior does"""
    narrowing: Array
    """(k,) standard deviation by the data over that of the prior"""
    identified: NDArray[np.bool_]
    """(k,)"""


def uncertainty(problem: Problem, fit: Fit, clusters: NDArray[np.integer]) -> Uncertainty:
    """Estimate the covariance of a fit from central differences and clustered scores.

    ``clusters`` (rows,) number the stretches of motion taken as independent, such as the motions of logs. What is not
    known of the links' masses is counted too.
    """
    prior = problem.prior
    residual, jacobian = _central_differences(problem, fit.vector)
    covariance = jackknife(prior, *_by_cluster(problem, fit, residual, jacobian, clusters))
    jacobian = _steadied(problem, fit, jacobian, covariance)
    curvatures, scores = _by_cluster(problem, fit, residual, jacobian, clusters)
    covariance = jackknife(prior, curvatures, scores) + _resolution(problem, fit.vector)
    covariance += mass_covariance(problem, fit, residual, jacobian, curvatures.sum(axis=0) + prior.precision)
    narrowing = np.sqrt(np.diag(covariance)) / prior.sigma
    identified = (narrowing < IDENTIFIED) & ~fit.at_bound & ~problem.frozen
    return Uncertainty(covariance=0.5 * (covariance + covariance.T), narrowing=narrowing, identified=identified)


def _resolution(problem: Problem, x: Array) -> Array:
    """Covariance (k, k) of the common scale of each joint, which a fit to logs takes from a ladder."""
    up, down = problem.rescaled(x, (np.exp(0.5 * SCALE_STEP), np.exp(-0.5 * SCALE_STEP)))
    step = (up - down) / NORMAL95
    return np.outer(step, step) * (problem.owner[:, None] == problem.owner)


def jackknife(prior: Prior, curvatures: Array, scores: Array) -> Array:
    """Covariance (k, k) of a posterior from what each of g clusters and its n joints say: (g, k, k) and (g, n, k).

    Spread of the estimates without each cluster, plus the inverse curvature: each alone is too small where the
    twin's structure is not the arm's. Scaled so that intervals of a normal distribution are as wide as Student's.
    """
    count, precision = len(scores), prior.precision
    whole = curvatures.sum(axis=0)
    without = np.linalg.solve(whole - curvatures + precision, scores.sum(axis=1)[..., None])[..., 0]
    inverse = np.linalg.inv(whole + precision)
    factor = (student95(max(count - 1, 1)) / NORMAL95) ** 2
    return np.asarray(factor * (count - 1) / count * without.T @ without + factor * inverse @ whole @ inverse
                      + inverse @ precision @ inverse)  # fmt: skip


def _by_cluster(
    problem: Problem, fit: Fit, residual: Array, jacobian: Array, clusters: NDArray[np.integer]
) -> tuple[Array, Array]:
    """Curvature (g, k, k) of each cluster, and score (g, n, k) of each of its joints."""
    count, k = int(clusters.max()) + 1, len(fit.vector)
    curvatures, scores = np.zeros((count, k, k)), np.zeros((count, problem.joints, k))
    rows = [np.flatnonzero(clusters == g) for g in range(count)]
    for joint in range(problem.joints):
        place = problem.columns(joint)
        weight = fit.weights.precision[:, joint] * influence(residual[:, joint])
        pull = weight * residual[:, joint]
        for g, own in enumerate(rows):
            slopes = jacobian[own, joint]
            curvatures[g][np.ix_(place, place)] += slopes.T @ (slopes * weight[own, None])
            scores[g, joint, place] = slopes.T @ pull[own]
    return curvatures, scores


def _steadied(problem: Problem, fit: Fit, jacobian: Array, covariance: Array) -> Array:
    """Scale sensitivities (rows, n, q) down to the curvature that the loss itself shows.

    Along the principal directions of each joint's own parameters, moved for all joints at once, `REACH` standard
    deviations of ``covariance`` (k, k) to either side.
    """
    prior, n = problem.prior, problem.joints
    own = [np.flatnonzero((problem.owner == joint) & ~problem.frozen) for joint in range(n)]
    moves = np.zeros((len(own[0]), len(fit.vector)))
    axes, sizes = [], []
    for joint, place in enumerate(own):
        columns = np.searchsorted(problem.columns(joint), place)
        scaled = jacobian[:, joint][:, columns] * prior.sigma[place]
        weight = fit.weights.precision[:, joint]
        _, vectors = np.linalg.eigh(scaled.T @ (scaled * weight[:, None]))
        spread = covariance[np.ix_(place, place)] / np.outer(prior.sigma[place], prior.sigma[place])
        size = np.minimum(REACH * np.sqrt(np.einsum("ai,ab,bi->i", vectors, spread, vectors)), 1.0)
        moves[:, place] = (vectors * size).T * prior.sigma[place]
        axes.append(vectors)
        sizes.append(size)
    tried = np.clip(np.vstack([fit.vector, fit.vector + moves, fit.vector - moves]), prior.lower, prior.upper)
    residuals = problem.residuals(tried)
    losses = (loss(residuals) * fit.weights.precision).sum(axis=1)
    shown = losses[1 : 1 + len(moves)] + losses[1 + len(moves) :] - 2.0 * losses[0]
    steady = jacobian.copy()
    for joint, (place, vectors, size) in enumerate(zip(own, axes, sizes, strict=True)):
        columns = np.searchsorted(problem.columns(joint), place)
        along = (jacobian[:, joint][:, columns] * prior.sigma[place]) @ vectors * size
        weight = fit.weights.precision[:, joint] * influence(residuals[0][:, joint])
        claimed = np.maximum((along**2 * weight[:, None]).sum(axis=0), 1e-12)
        share = np.sqrt(np.clip(shown[:, joint] / claimed, LEAST_SHARE, 1.0))
        steady[:, joint, columns] = (along / size * share) @ vectors.T / prior.sigma[place]
    return steady


def _central_differences(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Residual (rows, n) at ``x`` and sensitivities (rows, n, q), one-sided where a bound is near.

    The torque limit's is upward: of a limit that was never reached, the data only say that it is not lower.
    """
    ones = np.ones(len(x))
    up, down = problem.inward(x, ones), problem.inward(x, -ones)
    residuals = problem.residuals(np.vstack([x, problem.perturbations(x, up), problem.perturbations(x, down)]))
    base, count = residuals[0], (len(residuals) - 1) // 2
    forward = problem.jacobian(base, residuals[1 : 1 + count], up)
    backward = problem.jacobian(base, residuals[1 + count :], down)
    central = 0.5 * (forward + backward)
    lost = central[..., TORQUE_LIMIT] - forward[..., TORQUE_LIMIT]
    central[..., TORQUE_LIMIT] -= lost
    central[..., STIFFNESS] += lost  # the slope along the common scale stays what was simulated
    return base, central
