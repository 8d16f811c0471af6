"""How well a fit knows its parameters.

Method: the sandwich covariance of an M-estimator with clustered scores (Huber 1967; Liang and Zeger
1986), clusters being stretches of motion longer than the memory of the residuals. The plain inverse
curvature is 3 to 20 times too narrow on a real arm's logs (measured there). Few clusters make the
scores' covariance noisy, so it is averaged with the curvature, which it equals in expectation when
the model is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.twin.fit import STIFFNESS, Fit, Problem, influence
from rejoint.twin.parameters import JOINT_PARAMETERS

CLUSTER = 3.0
"""[s] longer than a stick-slip cycle and than the slowest oscillation of a worn arm (chosen)"""

TORQUE_LIMIT = next(i for i, p in enumerate(JOINT_PARAMETERS) if p.name == "torque_limit")
"""Place of the torque limit among a joint's parameters"""

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


def uncertainty(problem: Problem, fit: Fit, clusters: NDArray[np.integer] | None = None) -> Uncertainty:
    """Estimate the covariance of a fit from central differences and clustered scores.

    ``clusters`` (rows,) number the stretches of motion taken as independent, by default of `CLUSTER` seconds.
    Where they are given, such as the motions of logs from elsewhere, the scores' covariance and the curvature are
    added, not averaged: each alone is too small where the twin's structure is not the arm's.
    """
    prior, k, share = problem.prior, len(fit.vector), 0.5 if clusters is None else 1.0
    residual, jacobian = _central_differences(problem, fit.vector)
    curvature, _ = problem.system(jacobian, residual, fit.weights)
    scores, clusters = np.zeros((k, k)), problem.clusters(CLUSTER) if clusters is None else clusters
    count = int(clusters.max()) + 1
    for joint in range(problem.joints):
        place = problem.columns(joint)
        pull = fit.weights.precision[joint] * influence(residual[:, joint]) * residual[:, joint]
        summed = np.zeros((count, len(place)))
        np.add.at(summed, clusters, jacobian[:, joint] * pull[:, None])
        scores[np.ix_(place, place)] += summed.T @ summed * count / max(count - 1, 1)
    precision = np.diag(prior.sigma**-2)
    inverse = np.linalg.inv(curvature + precision)
    covariance = inverse @ (share * (scores + curvature) + precision) @ inverse
    narrowing = np.sqrt(np.diag(covariance)) / prior.sigma
    identified = (narrowing < IDENTIFIED) & ~fit.at_bound & ~problem.frozen
    return Uncertainty(covariance=0.5 * (covariance + covariance.T), narrowing=narrowing, identified=identified)


def strong_correlations(covariance: Array, threshold: float = 0.9) -> list[tuple[int, int, float]]:
    """Pairs (i, j, correlation) of parameters that the data can hardly tell apart, strongest first."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    pairs = [(int(i), int(j), float(correlation[i, j])) for i, j in zip(*np.triu_indices(len(sigma), 1), strict=True)]
    return sorted((pair for pair in pairs if abs(pair[2]) > threshold), key=lambda pair: -abs(pair[2]))


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
