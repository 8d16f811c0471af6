"""Two controllers on the same arms at the same targets; intervals resample whole arms.

Times to come and stay within a distance have no mean, since some are infinite; they are compared
by the median of the ratios target by target. Where both never stay, they are equal.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.system.statistics import CONFIDENCE, FEWEST_CLUSTERS, Estimate, paired_difference

NEVER_RATIO = 100.0
"""Ratio where only one of two ever stays: no time within a hold is as many times another (chosen)"""

RESAMPLES = 1000
"""Bootstrap resamples of a median (chosen: ends of the interval repeat within 3 % of its width)"""


def difference(first: Array, second: Array, *, seed: int = 0) -> Estimate | None:
    """Mean of ``first - second`` (A, K) over what both have."""
    arms = np.repeat(np.arange(first.shape[0]), first.shape[1])
    return paired_difference(first.ravel(), second.ravel(), arms, seed=seed)


def time_ratio(first: Array, second: Array, *, seed: int = 0) -> Estimate:
    """Median of ``first / second`` (A, K) for times that may be infinite or NaN (stopped: counts as never).

    Without interval where there are too few arms.
    """
    ratio = ratios(first, second)  # (A, K)
    median = float(np.median(ratio))
    if len(ratio) < FEWEST_CLUSTERS:
        return Estimate(value=median, low=None, high=None)
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, len(ratio), (RESAMPLES, len(ratio)))
    medians = np.median(ratio[picks].reshape(RESAMPLES, -1), axis=1)
    low, high = np.quantile(medians, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="nearest")
    return Estimate(value=median, low=min(float(low), median), high=max(float(high), median))


def ratios(first: Array, second: Array) -> Array:
    """``first / second`` for times; 1 where both are never, `NEVER_RATIO` or its inverse where one is."""
    first, second = (np.where(np.isnan(times), np.inf, np.maximum(times, 1e-3)) for times in (first, second))
    both = np.isinf(first) & np.isinf(second)
    finite = np.where(np.isinf(first) | np.isinf(second), 1.0, first / np.where(np.isinf(second), 1.0, second))
    return np.where(
        both, 1.0, np.where(np.isinf(first), NEVER_RATIO, np.where(np.isinf(second), 1 / NEVER_RATIO, finite))
    )
