"""Charts of one quantity over the checks of an arm: baseline, state, and jumped zeros.

The first checks give mean, scatter and temperature effect. For later ones, in standard deviations, an EWMA (Roberts
1959) gives the state, a two-sided CUSUM (Page 1954) the alarm.

A collision moves a zero alike in all poses; wear changes sag and friction too.
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

    z: Array
    """(T,) standard deviations from the baseline; NaN in its first checks"""
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
    count = len(value)
    warm = np.nan_to_num(temperature - temperature[0]) if count else temperature
    z, cusum, changes = np.full(count, np.nan), np.zeros(count), np.zeros(count)
    up = down = smooth = 0.0
    began_up = began_down = FEWEST - 1
    usual, since = float(np.mean(value)) if count else 0.0, None
    for t in range(FEWEST, count):
        seen = slice(t + 1)
        mean, slope, deviation = _norm(value[seen], warm[seen], min(t, MOST), scatter, per_degree)
        usual, changes[t] = mean, float(value[t] - mean - slope)
        z[t] = changes[t] / deviation
        step = float(np.clip(z[t], -CUT, CUT))
        smooth = WEIGHT * step + (1.0 - WEIGHT) * smooth
        up, began_up = (up + step - SLACK, began_up) if up + step > SLACK else (0.0, t)
        down, began_down = (down - step - SLACK, began_down) if down - step > SLACK else (0.0, t)
        cusum[t] = up if up >= down else -down
        since = began_up if up >= down else began_down
    state: State = "learning" if count <= FEWEST else "steady"
    if count > FEWEST and abs(cusum[-1]) >= ALARM:
        state = "alarm"
    elif count > FEWEST and abs(smooth) > DRIFTING:
        state = "drifting"
    return Chart(
        z=z,
        cusum=cusum,
        usual=usual,
        change=float(changes[-1]) if count else 0.0,
        lately=float(np.median(changes[-LATELY:])) if count else 0.0,
        state=state,
        since=since if state in ("drifting", "alarm") else None,
    )


def _norm(value: Array, warm: Array, count: int, scatter: float, per_degree: float) -> tuple[float, float, float]:
    """Mean of the first ``count`` checks, temperature effect on the last, and sigma.

    Sigma is from neighbours, the effect from regression with a prior and a linear trend.
    """
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

    ``deviation`` (T,) [mm] at ``temperature`` (T,) [deg C]; ``others`` (T,) [mm] also change by wear; ``scatter`` and
    ``per_degree`` as in `chart`.
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
