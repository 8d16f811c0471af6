"""When the tool error will reach the tolerance: a first-passage time, with an interval.

Wear is a Brownian motion with drift, seen by noisy checks; for each posterior draw the time is inverse Gaussian (Folks
and Chhikara, J. R. Stat. Soc. B 40, 1978).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.diagnosis.monitoring.charts import FEWEST

DRAWS = 4000
"""chosen: an 80 % interval repeats within a few per cent"""
SHARES = (0.1, 0.5, 0.9)
"""Quantiles"""
_SEEN = 0.9
"""Share of drifts that must reach the tolerance; chosen"""
_UNEVEN, _UNEVEN_FACTOR = 0.5, 1.6
"""Prior of wear's random share, and its factor; chosen: `python -m benchmarks years`"""
_DIFFUSIONS = np.geomspace(0.05, 2.0, 9)
"""Shares on the grid"""
_SCATTERS = np.geomspace(0.6, 1.8, 4)
"""Scatters on the grid, relative to the prior"""
_SCATTER_FACTOR = 1.5
"""Factor of uncertainty of the scatter; chosen"""
_POINTS = 200
"""Most points, by averaging; chosen: the work is cubic"""


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
    if len(use) < FEWEST + 1 or use[-1] <= use[0]:
        return None
    span = float(use[-1] - use[0])
    x = (use - use[-1]) / span  # in spans, and 0 now
    design = np.stack(
        [np.ones(len(x)), x, np.nan_to_num(warm - np.nanmean(warm) if np.isfinite(warm).any() else np.zeros(len(x)))],
        axis=1,
    )
    design, error, scatter = _together(design, error, scatter)
    x = design[:, 1]
    believed = np.diag([0.0, 0.0, 1.0 / max(per_degree, 1e-9) ** 2])
    common = np.minimum.outer(x - x[0], x - x[0])  # covariance of a Brownian motion
    size = max(float(np.abs(np.polyfit(x, error, 1)[0])), scatter)
    weights, fits = [], []
    for uneven in _DIFFUSIONS:
        for factor in _SCATTERS:
            diffusion, noise = uneven * size, factor * scatter
            fit = _fit(design, error, diffusion**2 * common + noise**2 * np.eye(len(x)), believed)
            weights.append(fit[0] + _log_prior(uneven / _UNEVEN, _UNEVEN_FACTOR) + _log_prior(factor, _SCATTER_FACTOR))
            fits.append((fit[1], fit[2], diffusion, noise))
    weight = np.exp(np.array(weights) - max(weights))
    rng = np.random.default_rng(0)
    counts = rng.multinomial(DRAWS, weight / weight.sum())
    drawn = [_passages(rng, fit, int(n), x, error, design, tolerance) for fit, n in zip(fits, counts, strict=True) if n]
    times, drifts = (np.concatenate(part) for part in zip(*drawn, strict=True))
    if float((drifts > 0.0).mean()) < _SEEN:
        return None
    early, middle, late = (span * float(np.quantile(times, share, method="higher")) for share in SHARES)
    return Remaining(early=early, middle=middle, late=late)


def _together(design: Array, error: Array, scatter: float) -> tuple[Array, Array, float]:
    each = -(-len(error) // _POINTS)
    if each == 1:
        return design, error, scatter
    first = len(error) % each
    rows = design[first:].reshape(-1, each, design.shape[1]).mean(axis=1)
    return rows, error[first:].reshape(-1, each).mean(axis=1), scatter / each**0.5


def _log_prior(ratio: float, factor: float) -> float:
    return float(-0.5 * (np.log(ratio) / np.log(factor)) ** 2)


def _fit(design: Array, value: Array, covariance: Array, believed: Array) -> tuple[float, Array, Array]:
    root = np.linalg.cholesky(covariance)
    a, y = np.linalg.solve(root, design), np.linalg.solve(root, value)
    precision = a.T @ a + believed
    spread = np.linalg.inv(precision)
    best = spread @ (a.T @ y)
    left = float(y @ y - best @ precision @ best)
    logdet = 2.0 * float(np.log(np.diag(root)).sum()) + float(np.linalg.slogdet(precision)[1])
    return -0.5 * (left + logdet), np.asarray(best, dtype=float), np.asarray(spread, dtype=float)


def _passages(
    rng: np.random.Generator,
    fit: tuple[Array, Array, float, float],
    count: int,
    x: Array,
    error: Array,
    design: Array,
    tolerance: float,
) -> tuple[Array, Array]:
    best, spread, diffusion, noise = fit
    drawn = rng.multivariate_normal(best, spread, count, method="cholesky")
    drift = drawn[:, 1]
    here = _state(rng, drawn, diffusion, noise, x, error, design)
    way = tolerance - here
    times = np.where(way <= 0.0, 0.0, np.inf)
    ahead = way > 0.0
    # Against the drift a motion still passes with a chance of exp(2 drift way / diffusion^2), then as with it.
    chance = np.exp(np.minimum(2.0 * drift * way / diffusion**2, 0.0))
    passes = ahead & (rng.uniform(size=count) < chance)
    mean = np.where(passes, way, 1.0) / np.maximum(np.abs(drift), 1e-9 * max(diffusion, 1e-12))
    shape = np.where(passes, way, 1.0) ** 2 / diffusion**2
    return np.where(passes, rng.wald(mean, shape), times), drift


def _state(
    rng: np.random.Generator, drawn: Array, diffusion: float, noise: float, x: Array, error: Array, design: Array
) -> Array:
    """Draw the present error (N,), without its scatter, given lines ``drawn`` (N, 3)."""
    common = diffusion**2 * np.minimum.outer(x - x[0], x - x[0])
    gain = np.linalg.solve(common + noise**2 * np.eye(len(x)), common[:, -1])
    left = error - drawn @ design.T
    spread = max(float(common[-1, -1] - gain @ common[:, -1]), 0.0)
    return np.asarray(drawn[:, 0] + left @ gain + spread**0.5 * rng.normal(size=len(drawn)))
