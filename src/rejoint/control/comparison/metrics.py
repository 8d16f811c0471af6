"""What one target's part of a recording says, as pure functions on arrays.

All take the time since the target was set, ``since`` (T,) [s], and signals sampled at those times.
Errors may be the encoder's or the true ones; nothing here mixes them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rejoint.arms import Array


class Crossing(NamedTuple):
    """End of one target under the protocol of Park et al. 2024, section IV-F."""

    reached: bool
    error: float
    """[m] at the first crossing of the threshold, or at the end"""
    time: float
    """[s] of the first crossing, or of the end"""
    row: int
    """row of that moment"""


def crossing(since: Array, error: Array, threshold: float) -> Crossing:
    """First time at which ``error`` (T,) [m] is below ``threshold`` [m], else the end."""
    below = np.flatnonzero(error < threshold)
    row = int(below[0]) if len(below) else len(error) - 1
    return Crossing(bool(len(below)), float(error[row]), float(since[row]), row)


def stay_time(since: Array, error: Array, within: float) -> float:
    """Time [s] after which ``error`` (T,) [m] is below ``within`` [m] until the end; infinite if the end is not."""
    outside = np.flatnonzero(~(error < within))
    if len(outside) == 0:
        return float(since[0])
    last = int(outside[-1])
    return float(since[last + 1]) if last + 1 < len(since) else float("inf")


def settled(since: Array, signal: Array, window: float) -> float:
    """Mean of ``signal`` (T,) over the last ``window`` [s], by time, so that uneven periods weigh rightly."""
    rows = since >= since[-1] - window
    t, x = since[rows], signal[rows]
    if len(t) < 2:
        return float(x[-1])
    return float(np.trapezoid(x, t) / (t[-1] - t[0]))


def oscillation(since: Array, tcp: Array, window: float) -> float:
    """Root mean square distance [m] of ``tcp`` (T, 3) [m] from its mean over the last ``window`` [s]."""
    last = tcp[since >= since[-1] - window]
    return float(np.sqrt(((last - last.mean(axis=0)) ** 2).sum(axis=-1).mean()))
