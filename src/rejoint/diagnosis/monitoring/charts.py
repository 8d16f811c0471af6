"""Charts of one quantity over the checks of an arm: baseline, state, jumped zeros, and when a tolerance is reached.

The first checks give mean, scatter and temperature effect; an EWMA (Roberts 1959) the state, a two-sided CUSUM (Page
1954) the alarm.

Wear is a Brownian motion with drift, its first-passage time inverse Gaussian (Folks and Chhikara, J. R. Stat. Soc. B
40, 1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rejoint.arms import Array
from rejoint.diagnosis.regression import fit_believed

FEWEST = 5
"""Checks that a baseline needs; shared facts on monitoring: 5 to 8"""
MOST = 8
"""Most checks in a baseline"""
WEIGHT = 0.25
"""Of the newest check in the EWMA; shared facts on monitoring"""
DRIFTING = 2.7 * (WEIGHT / (2.0 - WEIGHT)) ** 0.5
"""EWMA of a drift: 2.7 of its own standard deviations"""
SLACK = 1.25
"""Slack of the CUSUM in standard deviations; chosen"""
ALARM = 6.0
"""CUSUM of an alarm; shared facts on monitoring; 0.5 % false alarms in two years"""
CUT = 4.0
"""Largest distance that counts, in standard deviations"""
PRIOR_CHECKS = 6.0
"""Checks that the prior scatter counts for; chosen"""

LATELY = 3
"""Checks whose median is the recent change; chosen"""

State = Literal["learning", "steady", "drifting", "alarm"]
"""Too few checks; as at the beginning; moving away; surely changed"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart:
    """One quantity since its baseline began; T checks, the newest last."""

    cusum: Array
    """(T,) the larger side, positive where the quantity grows"""
    usual: float
    """mean of the baseline, at its own temperature"""
    change: float
    """newest value, at the baseline's temperature, less `usual`"""
    lately: float
    """the same, median of the last `LATELY` checks"""
    state: State
    since: int | None
    """index of the last check before the change, by the CUSUM"""


def chart(value: Array, temperature: Array, *, scatter: float, per_degree: float) -> Chart:
    """Compute the chart of ``value`` (T,) at ``temperature`` (T,) [deg C], NaN where unknown.

    Prior: ``scatter``, sigma of one check; ``per_degree``, effect of a degree.
    """
    count, warm = len(value), np.nan_to_num(temperature - temperature[0])
    cusum, changes = np.zeros(count), np.zeros(count)
    sides, sums, began, smooth = np.array([1.0, -1.0]), np.zeros(2), np.full(2, FEWEST - 1), 0.0
    usual, since = float(np.mean(value)), FEWEST - 1
    for t in range(FEWEST, count):
        usual, slope, deviation = _norm(value[: t + 1], warm[: t + 1], min(t, MOST), scatter, per_degree)
        changes[t] = value[t] - usual - slope
        step = float(np.clip(changes[t] / deviation, -CUT, CUT))
        smooth = WEIGHT * step + (1.0 - WEIGHT) * smooth
        sums = np.maximum(sums + sides * step - SLACK, 0.0)
        began = np.where(sums > 0.0, began, t)
        larger = int(sums.argmax())
        cusum[t], since = sides[larger] * sums[larger], int(began[larger])
    state: State = "steady"
    if count <= FEWEST:
        state = "learning"
    elif abs(cusum[-1]) >= ALARM:
        state = "alarm"
    elif abs(smooth) > DRIFTING:
        state = "drifting"
    return Chart(
        cusum=cusum,
        usual=usual,
        change=float(changes[-1]),
        lately=float(np.median(changes[-LATELY:])),
        state=state,
        since=since if state in ("drifting", "alarm") else None,
    )


def _norm(value: Array, warm: Array, count: int, scatter: float, per_degree: float) -> tuple[float, float, float]:
    """Mean of the first ``count`` checks, temperature effect on the last, and sigma."""
    known, middle = warm[:count].mean(), float(value[:count].mean())
    variance, slope, doubt = scatter**2, 0.0, 0.0
    for _ in range(3):  # slope and scatter depend on each other a little
        slope, doubt = _slope(value, warm, variance, per_degree)
        steps = np.diff(value[:count] - slope * warm[:count])
        variance = (PRIOR_CHECKS * scatter**2 + 0.5 * float(steps @ steps)) / (PRIOR_CHECKS + count - 1)
    away = float(warm[-1] - known)
    return middle, slope * away, (variance * (1.0 + 1.0 / count) + away**2 * doubt) ** 0.5


def _slope(value: Array, warm: Array, variance: float, per_degree: float) -> tuple[float, float]:
    if per_degree <= 0.0 or np.ptp(warm) == 0.0:
        return 0.0, 0.0
    order = np.arange(len(value), dtype=float)
    design = np.stack([np.ones(len(value)), order - order.mean(), warm - warm.mean()], axis=1)
    sigma = variance**0.5
    best, spread = fit_believed(design / sigma, value / sigma, np.diag([0.0, 0.0, per_degree**-2]))
    return float(best[2]), float(spread[2, 2])


SURE = 5.0
"""Standard deviations of a jumped zero; chosen, see `python -m benchmarks years`"""
SHARE = 1.0 / 3.0
"""Largest change of all else, over the jump; chosen"""
STAYED = 0.5
"""Share of the jump that must remain; chosen"""
BEFORE = 3
"""Checks whose median is the old zero; chosen"""
UNTOLD = 10.0
"""[K] difference where no temperature is known; chosen"""


def find_jump(
    deviation: Array, others: Sequence[Array], temperature: Array, *, scatter: float, per_degree: float
) -> tuple[int, float] | None:
    """Find the first check after the last jump of a joint's zero, if any, and its way [mm].

    ``deviation`` (T,) [mm] at ``temperature`` (T,) [deg C]; ``others`` (T,) [mm] also change by wear.
    """
    for at in range(len(deviation) - 1, 0, -1):
        way = float(deviation[at] - deviation[at - 1])
        warmer = float(temperature[at] - temperature[at - 1])
        doubt = per_degree * (abs(warmer) if np.isfinite(warmer) else UNTOLD)
        if abs(way) < SURE * float(np.hypot(2.0**0.5 * scatter, doubt)):
            continue
        alone = all(abs(float(one[at] - one[at - 1])) < SHARE * abs(way) for one in others)
        was = float(np.median(deviation[max(at - BEFORE, 0) : at]))
        stayed = (float(deviation[-1]) - was) / way >= STAYED
        if alone and stayed:
            return at, way
    return None


DRAWS = 4000
"""chosen: an 80 % interval repeats within a few per cent"""
SHARES = (0.1, 0.5, 0.9)
"""Quantiles"""
_SEEN = 0.9
"""Share of drifts that must reach the tolerance; chosen"""
_UNEVEN = 0.36
"""Random share of wear over the whole span; chosen: `python -m benchmarks years`"""
_POINTS = 200
"""Newest checks that count; chosen: the work is cubic"""


def remaining(
    use: Array, error: Array, warm: Array, tolerance: float, *, scatter: float, per_degree: float
) -> Array | None:
    """Estimate the use left until an arm's ``error`` (T,) [mm] reaches ``tolerance`` [mm]: its quantiles `SHARES`.

    ``use`` (T,) grows; ``warm`` (T,) [K] is relative. None for too few checks or no wear.
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
    diffusion = _UNEVEN * size
    root = np.linalg.cholesky(diffusion**2 * common + scatter**2 * np.eye(len(x)))
    white: Array = np.asarray(np.linalg.solve(root, np.column_stack([design, error])), dtype=float)
    best, spread = fit_believed(white[:, :-1], white[:, -1], believed)
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(best, spread, DRAWS)
    way, drift = tolerance - drawn[:, 0], drawn[:, 1]
    if float((drift > 0.0).mean()) < _SEEN:
        return None
    # Against the drift a motion still passes with a chance of exp(2 drift way / diffusion^2), then as with it.
    chance = np.exp(np.minimum(2.0 * drift * way / diffusion**2, 0.0))
    passes = (way > 0.0) & (rng.uniform(size=DRAWS) < chance)
    far = np.where(passes, way, 1.0)
    times = rng.wald(far / np.maximum(np.abs(drift), 1e-9 * diffusion), far**2 / diffusion**2)
    times = np.where(passes, times, np.where(way <= 0.0, 0.0, np.inf))
    return span * np.quantile(times, SHARES, method="higher")
