"""Charts of one quantity over the checks of an arm: what is usual, how it stands, and when to call out.

The first checks after a repair say what is usual for this arm: a mean, a scatter, and what warmth does to it. Every
later check is judged by how far it lies from that in standard deviations, with what the few checks leave open. An EWMA
tells the state (Roberts 1959); a two-sided CUSUM calls out (Page 1954).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rejoint.arms import Array

FEWEST = 5
"""Checks that a norm needs (shared facts on monitoring: 5 to 8)"""
MOST = 8
"""Checks that a norm takes in, as they come"""
WEIGHT = 0.25
"""Of the newest check in the EWMA (shared facts on monitoring)"""
DRIFTING = 2.7 * (WEIGHT / (2.0 - WEIGHT)) ** 0.5
"""EWMA from which a quantity is said to drift: 2.7 of its own standard deviations"""
SLACK = 1.25
"""Standard deviations that a CUSUM forgives at each check: half of the shift that it is to find (chosen: with half of
one, as is usual, a mean that rests on five checks alone gives false alarms; an arm that wears is soon three off)"""
ALARM = 6.0
"""CUSUM that is an alarm (shared facts on monitoring: 6 where there are twenty quantities; of 1000 that do not change,
drawn with two years of warmth, a slack of 1 and an alarm of 5 called out 2.8 %, these 0.5 %)"""
CUT = 4.0
"""Standard deviations as which a larger distance counts, so that no single odd check is an alarm"""
PRIOR_CHECKS = 6.0
"""Checks that what is known of the scatter before counts for (chosen: a norm of five alone would often have next to
none, and call out at nothing)"""

LATELY = 3
"""Checks whose middle says by how much a quantity has changed (chosen: the fewest that bear an odd one)"""

State = Literal["learning", "steady", "drifting", "alarm"]
"""Too few checks to say; as at the beginning; moving away; surely not as at the beginning"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart:
    """One quantity of one arm since its norm began; T checks, the newest last."""

    z: Array
    """(T,) distance from what is usual at that warmth, in standard deviations; NaN in the first `FEWEST` checks"""
    cusum: Array
    """(T,) the larger of both sides, positive where the quantity grows"""
    usual: float
    """mean of the norm, at its own warmth"""
    change: float
    """newest value, at the warmth of the norm, less `usual`"""
    lately: float
    """the same, the middle of the last `LATELY` checks"""
    state: State
    since: int | None
    """index of the last check before the quantity began to leave, as the CUSUM sees it; None where it has not"""


def chart(value: Array, temperature: Array, *, scatter: float, per_degree: float) -> Chart:
    """Draw the chart of ``value`` (T,) at ``temperature`` (T,) [deg C], NaN where the servos do not tell.

    ``scatter`` is the standard deviation that one check of an arm that does not change has, and ``per_degree`` how much
    a degree may move it: what is believed before the arm has shown its own.
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
        z=z, cusum=cusum, usual=usual, change=float(changes[-1]) if count else 0.0,
        lately=float(np.median(changes[-LATELY:])) if count else 0.0, state=state,
        since=since if state in ("drifting", "alarm") else None,
    )  # fmt: skip


def _norm(value: Array, warm: Array, count: int, scatter: float, per_degree: float) -> tuple[float, float, float]:
    """Mean of the first ``count`` checks, what warmth adds to the last one, and the standard deviation of that one.

    The scatter is that of neighbouring checks, which a slow change hardly widens, with what is known of it before. The
    slope over warmth is a regression over all checks with a prior, `per_degree`, beside a straight change over time, so
    that wear is not taken for warmth.
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
    """Change per degree beside a straight change over the checks, and its variance."""
    if per_degree <= 0.0 or np.ptp(warm) == 0.0:
        return 0.0, 0.0
    order = np.arange(len(value), dtype=float)
    design = np.stack([np.ones(len(value)), order - order.mean(), warm - warm.mean()], axis=1)
    precision = design.T @ design / variance + np.diag([0.0, 0.0, per_degree**-2])
    spread = np.linalg.inv(precision)
    return float((spread @ (design.T @ value))[2] / variance), float(spread[2, 2])
