"""When the tool error will reach the tolerance: a first-passage time, with an interval.

Wear is a Brownian motion with drift, seen by noisy checks; for each posterior draw the time is inverse Gaussian (Folks
and Chhikara, J. R. Stat. Soc. B 40, 1978).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from rejoint.arms import Array
from rejoint.diagnosis.monitoring.charts import FEWEST
from rejoint.diagnosis.regression import fit_believed

DRAWS = 4000
"""chosen: an 80 % interval repeats within a few per cent"""
SHARES = (0.1, 0.5, 0.9)
"""Quantiles"""
_SEEN = 0.9
"""Share of drifts that must reach the tolerance; chosen"""
_UNEVEN, _UNEVEN_FACTOR = 0.5, 1.6
"""Prior of wear's random share, and its factor; chosen: `python -m benchmarks years`"""
_SCATTER_FACTOR = 1.5
"""Factor of uncertainty of the scatter; chosen"""
_GRID = tuple(product(np.geomspace(0.05, 2.0, 9).tolist(), np.geomspace(0.6, 1.8, 4).tolist()))
"""Random shares of wear, and scatters relative to the prior"""
_POINTS = 200
"""Newest checks that count; chosen: the work is cubic"""


@dataclass(frozen=True, kw_only=True)
class Remaining:
    """Use left until the tolerance is reached."""

    early: float
    """10 % quantile"""
    middle: float
    late: float
    """90 % quantile; infinite if perhaps never"""


def remaining(
    use: Array, error: Array, warm: Array, tolerance: float, *, scatter: float, per_degree: float
) -> Remaining | None:
    """Estimate the use left until an arm's ``error`` (T,) [mm] reaches ``tolerance`` [mm].

    ``use`` (T,) grows; ``warm`` (T,) [K] is relative; ``scatter`` and ``per_degree`` as in `chart`. None for too few
    checks or no wear.
    """
    use, error, warm = use[-_POINTS:], error[-_POINTS:], warm[-_POINTS:]
    if len(use) < FEWEST + 1 or use[-1] <= use[0]:
        return None
    span = float(use[-1] - use[0])
    x = (use - use[-1]) / span  # in spans, and 0 now: the line's height there is the present error
    warmer = np.nan_to_num(warm - np.nanmean(warm)) if np.isfinite(warm).any() else np.zeros(len(x))
    design = np.stack([np.ones(len(x)), x, warmer], axis=1)
    believed = np.diag([0.0, 0.0, 1.0 / max(per_degree, 1e-9) ** 2])
    common = np.minimum.outer(-x, -x)  # covariance of a Brownian motion, backwards from now
    size = max(float(np.abs(np.polyfit(x, error, 1)[0])), scatter)
    fits = [
        _fit(design, error, (uneven * size) ** 2 * common + (factor * scatter) ** 2 * np.eye(len(x)), believed)
        for uneven, factor in _GRID
    ]
    priors = [
        np.hypot(np.log(uneven / _UNEVEN) / np.log(_UNEVEN_FACTOR), np.log(factor) / np.log(_SCATTER_FACTOR))
        for uneven, factor in _GRID
    ]
    evidence = np.array([fit[0] for fit in fits]) - 0.5 * np.square(priors)
    weight = np.exp(evidence - evidence.max())
    rng = np.random.default_rng(0)
    which = rng.choice(len(_GRID), DRAWS, p=weight / weight.sum())
    means, roots = (np.array([fit[i] for fit in fits]) for i in (1, 2))
    drawn = means[which] + (roots[which] @ rng.standard_normal((DRAWS, 3, 1)))[..., 0]
    way, drift = tolerance - drawn[:, 0], drawn[:, 1]
    diffusion = size * np.array([uneven for uneven, _ in _GRID])[which]
    if float((drift > 0.0).mean()) < _SEEN:
        return None
    # Against the drift a motion still passes with a chance of exp(2 drift way / diffusion^2), then as with it.
    chance = np.exp(np.minimum(2.0 * drift * way / diffusion**2, 0.0))
    passes = (way > 0.0) & (rng.uniform(size=DRAWS) < chance)
    far = np.where(passes, way, 1.0)
    times = rng.wald(far / np.maximum(np.abs(drift), 1e-9 * diffusion), far**2 / diffusion**2)
    times = np.where(passes, times, np.where(way <= 0.0, 0.0, np.inf))
    early, middle, late = (span * float(np.quantile(times, share, method="higher")) for share in SHARES)
    return Remaining(early=early, middle=middle, late=late)


def _fit(design: Array, value: Array, covariance: Array, believed: Array) -> tuple[float, Array, Array]:
    """Log evidence, coefficients (p,), and a root (p, p) of their covariance, by generalised least squares."""
    root = np.linalg.cholesky(covariance)
    a, y = np.linalg.solve(root, design), np.linalg.solve(root, value)
    best, spread = fit_believed(a, y, believed)
    left = float(y @ (y - a @ best))
    logdet = 2.0 * float(np.log(np.diag(root)).sum()) - float(np.linalg.slogdet(spread)[1])
    return -0.5 * (left + logdet), best, np.asarray(np.linalg.cholesky(spread))
