"""Least squares with intervals for dependent neighbouring samples.

The covariance is clustered by motion (Liang and Zeger 1986, with the small-sample factor of Stata's ``vce(cluster)``);
quantiles are Student's.
"""

import numpy as np
from scipy.special import fdtri

from rejoint.arms import Array, Index, Mask
from rejoint.system.records import entity
from rejoint.system.statistics import CONFIDENCE, Estimate, student95

PER_SET = 10**9
"""Clusters of a set, such as a recording"""
_LAD_ROUNDS = 12
"""Reweightings of least absolute deviations; measured: converged to a percent of an interval"""


@entity
class LinearFit:
    """Coefficients with their clustered covariance."""

    coefficients: Array
    """(p,)"""
    covariance: Array
    """(p, p)"""
    freedom: int
    """degrees of freedom"""

    def estimate(self, index: int) -> Estimate:
        """Coefficient ``index`` with its interval."""
        half = student95(self.freedom) * np.sqrt(self.covariance[index, index])
        value = self.coefficients[index]
        return Estimate(value, value - half, value + half)


def fit_clustered(design: Array, response: Array, cluster: Index) -> LinearFit:
    """Fit ``response`` (N,) on ``design`` (N, p), grouped by ``cluster`` (N,), with `PER_SET` numbers in a set."""
    scale = np.sqrt((design**2).mean(axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)  # a column of zeros keeps the coefficient 0
    scaled = design / scale
    inverse = np.linalg.pinv(scaled.T @ scaled, hermitian=True)
    beta = inverse @ (scaled.T @ response)
    (rows, terms), residual = design.shape, response - scaled @ beta

    def spread(cluster: Index) -> tuple[Array, int]:
        groups = np.unique(cluster)
        scores = np.array([scaled[cluster == g].T @ residual[cluster == g] for g in groups])
        factor = len(groups) / max(len(groups) - 1, 1) * (rows - 1) / max(rows - terms, 1)
        return factor * inverse @ (scores.T @ scores) @ inverse, len(groups)

    (covariance, count), (between, sets) = spread(cluster), spread(cluster // PER_SET)
    freedom, wider = max(count - terms, 1), np.ones(terms)
    if 1 < sets < count:
        ratio = np.diag(between) / np.maximum(np.diag(covariance), 1e-300)
        apart = ratio > fdtri(sets - 1, freedom, CONFIDENCE)  # sets that differ measurably are the observations
        wider = np.where(apart, np.sqrt(ratio) * student95(sets - 1) / student95(freedom), 1.0)
    covariance = covariance * np.outer(wider / scale, wider / scale)
    return LinearFit(coefficients=beta / scale, covariance=covariance, freedom=freedom)


def fit_believed(design: Array, response: Array, believed: Array) -> tuple[Array, Array]:
    """Coefficients (p,) and their covariance (p, p), for unit noise and prior precision ``believed`` (p, p) about 0."""
    spread = np.linalg.inv(design.T @ design + believed)
    return spread @ (design.T @ response), np.asarray(spread)


def fit_trimmed(design: Array, response: Array, cluster: Index, first: Mask | None = None) -> LinearFit:
    """Like `fit_clustered`, without samples more than five robust deviations off.

    Starts from least absolute deviations (Schlossmacher 1973) of ``first`` (N,).
    """
    weight = np.ones(len(response)) if first is None else first.astype(float)
    for _ in range(_LAD_ROUNDS):
        root = np.sqrt(weight)
        beta = np.linalg.lstsq(design * root[:, None], response * root, rcond=None)[0]
        residual = np.abs(response - design @ beta)
        weight = (weight > 0.0) / np.maximum(residual, max(0.01 * residual.mean(), 1e-9))
    kept = residual <= 5 * max(1.48 * np.median(residual[weight > 0.0]), 1e-5)
    return fit_clustered(design[kept], response[kept], cluster[kept])


def mean_of(values: Array) -> Estimate:
    """Mean of independent values (N,), none below zero, with Student's interval."""
    value = values.mean()
    if len(values) < 2:
        return Estimate(value, None, None)
    half = student95(len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    return Estimate(value, max(value - half, 0.0), value + half)


def scaled(estimate: Estimate, factor: float) -> Estimate:
    """Multiply a number and its interval."""
    low, high = (None if end is None else factor * end for end in (estimate.low, estimate.high))
    return Estimate(factor * estimate.value, *((high, low) if factor < 0.0 else (low, high)))


def within(value: float, share: float) -> Estimate:
    """``value`` with relative half width ``share``."""
    return Estimate(value, value * (1 - share), value * (1 + share))


def shifted(estimate: Estimate, offset: float) -> Estimate | None:
    """Sum of a quantity and ``offset``; None unless it is positive."""
    value = estimate.value + offset
    if value <= 0:
        return None
    low = None if estimate.low is None else max(estimate.low + offset, 0.05 * value)
    return Estimate(value, low, None if estimate.high is None else estimate.high + offset)


def reciprocal(estimate: Estimate) -> Estimate:
    """1/x of a positive quantity; bounds that would cross zero are open."""
    low, high = (1 / end if end and end > 0 else None for end in (estimate.high, estimate.low))
    return Estimate(1 / estimate.value, low, high)


def product(one: Estimate, other: Estimate) -> Estimate:
    """Product of two positive independent quantities: relative half widths added in squares."""
    below, above = (np.hypot(_share(one, side), _share(other, side)) for side in ("low", "high"))
    value = one.value * other.value
    return Estimate(value, value * max(1 - below, 0.0), value * (1 + above) if np.isfinite(above) else None)


def _share(estimate: Estimate, side: str) -> float:
    end = getattr(estimate, side)
    return np.inf if end is None else abs(end - estimate.value) / max(abs(estimate.value), 1e-300)
