"""What the run logs of the trials show: paths through targets and errors over time. Pure functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.logs.runlog import RunLog


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetSpan:
    """The time in which one target was in force."""

    target: Array
    """(3,) [m]"""
    aim: Array
    """(3,) [m] where the TCP was to stand by the encoders at the end: beside the target where a calibration says so"""
    time: Array
    """(T,) [s] since the target was set; the first entry is 0"""
    encoder_error: Array
    """(T,) [m] distance of the TCP that the encoders tell from the aim"""
    true_error: Array
    """(T,) [m] distance of the real TCP from the target; NaN where nobody knows"""


def encoder_path(arm: Arm, log: RunLog) -> Array:
    """TCP (T, 3) [m] by forward kinematics of the measured joint positions."""
    return tcp_position(arm, log.position)


def visits(arm: Arm, log: RunLog) -> tuple[TargetSpan, ...]:
    """Split a log wherever its target changes; rows without a target are left out."""
    tcp, aim = encoder_path(arm, log), log.target if log.aim is None else log.aim
    found = []
    for start, stop in _spans(log):
        # The target was set when the last row of the previous one was read.
        rows = np.arange(max(start - 1, 0), stop)
        target, aims = log.target[start], aim[np.maximum(rows, start)]
        found.append(
            TargetSpan(
                target=target,
                aim=aims[-1],
                time=log.time[rows] - log.time[rows[0]],
                encoder_error=np.linalg.norm(tcp[rows] - aims, axis=1),
                true_error=np.linalg.norm(log.true_tcp[rows] - target, axis=1),
            )
        )
    return tuple(found)


def _spans(log: RunLog) -> list[tuple[int, int]]:
    if not len(log):
        return []
    filled = np.nan_to_num(log.target, nan=np.inf)  # NaN differs from itself
    cuts = np.flatnonzero((filled[1:] != filled[:-1]).any(axis=1)) + 1
    edges = [0, *cuts.tolist(), len(log)]
    return [(a, b) for a, b in pairwise(edges) if np.isfinite(log.target[a]).all()]


def error_at(visit: TargetSpan, time: Array) -> Array:
    """Return the encoder error (K,) [m] as read last at each ``time`` (K,) [s]; NaN after the visit's end."""
    rows = np.searchsorted(visit.time, time + 1e-9, side="right") - 1
    error: NDArray[np.float64] = visit.encoder_error[np.clip(rows, 0, None)]
    return np.where(time > visit.time[-1] + _grain(visit), np.nan, error)


def _grain(visit: TargetSpan) -> float:
    return float(np.diff(visit.time).max(initial=0.0))


def spread_over_time(all_visits: Sequence[TargetSpan], time: Array) -> tuple[Array, Array, Array]:
    """Median, 10th and 90th percentile (K,) [m] of the encoder error over all visits.

    From the moment when fewer than half of the visits are still going on, the values are NaN: the
    rest would be a selection of the slow ones.
    """
    errors = np.stack([error_at(visit, time) for visit in all_visits])
    enough = np.isfinite(errors).sum(axis=0) * 2 >= len(errors)
    result = np.full((3, len(time)), np.nan)
    result[:, enough] = np.nanpercentile(errors[:, enough], [50, 10, 90], axis=0)
    return result[0], result[1], result[2]


def bounds(paths: Sequence[Array], margin: float = 0.012) -> Array:
    """Box (3, 2) [m] around all ``paths`` (T, 3) [m] with a margin (chosen: a little over the success radius)."""
    points = np.concatenate(list(paths))
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin], axis=1)
