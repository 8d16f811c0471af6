"""Numbers with intervals, for few and dependent trials.

Means: bootstrap over clusters (Davison and Hinkley 1997, section 3.8). Shares: Wilson's interval (J. Am. Stat. Assoc.
22, 1927) with trials reduced by the design effect (Kish, Survey Sampling, 1965, section 8.2).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from rejoint.system.records import value_type

Array = NDArray[np.float64]
Labels = NDArray[np.intp]

CONFIDENCE = 0.95
NORMAL95 = float(ndtri((1.0 + CONFIDENCE) / 2.0))
"""Half width of the normal interval, in standard deviations"""
RESAMPLES = 4000
"""(chosen)"""
FEWEST_CLUSTERS = 5
"""of an interval: resamples of 5 hold the median in 94 %"""


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval; None: open end."""

    value: float
    low: float | None
    high: float | None

    def __post_init__(self) -> None:
        for name, number in dict(vars(self)).items():
            if number is not None:
                object.__setattr__(self, name, float(number))  # NumPy scalars are not plain data


@value_type
class Spread:
    """A mean with its interval, and the scatter of values."""

    mean: Estimate
    std: float | None
    """None for one value"""
    p95: float
    """95th percentile"""
    count: int


def student95(freedom: int) -> float:
    """Half width of Student's t interval with ``freedom`` degrees; infinite below 1."""
    return float(stdtrit(freedom, (1.0 + CONFIDENCE) / 2.0)) if freedom >= 1 else math.inf


def cluster(shape: tuple[int, int, int]) -> tuple[str, Labels]:
    """Clusters of results (S, R, K): name and flat labels."""
    sets, repetitions, targets = shape
    index = np.arange(sets * repetitions * targets)
    if sets >= FEWEST_CLUSTERS:
        return "target sets", index // (repetitions * targets)
    if sets * repetitions >= FEWEST_CLUSTERS:
        return "trials", index // targets
    return "targets", index


def _clustered(values: Array, labels: Labels) -> tuple[Array, Array, Labels]:
    known = np.isfinite(values)
    _, groups = np.unique(labels[known], return_inverse=True)
    return values[known], np.bincount(groups, weights=values[known]).astype(float), np.bincount(groups)


def bootstrap_mean(values: Array, labels: Labels) -> Estimate:
    """Mean of ``values`` (N,) with interval over clusters ``labels`` (N,), if at least `FEWEST_CLUSTERS`."""
    values, sums, counts = _clustered(values, labels)
    mean = values.mean()
    if len(counts) < FEWEST_CLUSTERS:
        return Estimate(value=mean, low=None, high=None)
    picks = np.random.default_rng(0).integers(0, len(sums), (RESAMPLES, len(sums)))
    means = sums[picks].sum(axis=1) / counts[picks].sum(axis=1)
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value=mean, low=min(low, mean), high=max(high, mean))


def above_zero(estimate: Estimate) -> bool:
    """Whether the whole interval is above zero."""
    return estimate.low is not None and estimate.low > 0.0


def spread(values: Array, labels: Labels) -> Spread | None:
    """Mean with interval, deviation and 95th percentile of ``values`` (N,), or None."""
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return None
    return Spread(
        mean=bootstrap_mean(values, labels),
        std=float(known.std(ddof=1)) if len(known) > 1 else None,
        p95=float(np.quantile(known, 0.95)),
        count=len(known),
    )


def wilson(hits: float, trials: float) -> Estimate:
    """Share ``hits / trials`` with Wilson's interval; ``trials`` may be fractional."""
    share, z2 = hits / trials, NORMAL95**2
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = NORMAL95 * np.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    low = 0.0 if hits == 0 else max(0.0, centre - half)
    high = 1.0 if hits == trials else min(1.0, centre + half)
    return Estimate(value=share, low=low, high=high)


def clustered_share(hits: Array, labels: Labels) -> Estimate:
    """Share of ones in ``hits`` (N,), with interval over clusters ``labels`` (N,)."""
    hits, sums, counts = _clustered(hits, labels)
    share, trials, clusters, effect = hits.mean(), len(hits), len(counts), 1.0
    if clusters > 1 and 0.0 < share < 1.0:
        between = clusters / (clusters - 1) * np.sum((sums - share * counts) ** 2) / trials**2
        effect = max(1.0, between / (share * (1 - share) / trials))
    return wilson(share * trials / effect, trials / effect)


def paired_difference(first: Array, second: Array, labels: Labels) -> Estimate | None:
    """Mean of ``first - second`` (N,) over common results, with interval, or None."""
    difference = first - second
    return bootstrap_mean(difference, labels) if np.isfinite(difference).any() else None
