"""How closely an arm repeats itself: what no prediction can go below.

Where a motion repeats a command sequence, the two answers are compared. Friction makes an arm's path
depend on where it came from, so a repetition counts only after one whole period of the same commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.logs.exclusions import Rows
from rejoint.logs.runlog import RunLog

SHORTEST, LONGEST = 1.5, 40.0
"""[s] of a period: longer than the arm remembers by its speed, and short enough to come twice (chosen)"""
SAME = np.radians(0.1)
"""[rad] root mean square below which two stretches of commands are the same: an encoder step (chosen)"""
MOVING = np.radians(5.0)
"""[rad] that a command must move there and back in a period: an arm at rest repeats itself well (chosen)"""
_STRIDE = 5
"""Rows between those that are compared first"""


@dataclass(frozen=True, kw_only=True)
class Repeatability:
    """Spread of one repetition about the mean of the two, over time and motions."""

    tcp: float
    """[m] mean over the motions that repeat"""
    lowest: float
    """[m]"""
    highest: float
    """[m]"""
    joint: float
    """[rad] mean over these motions, root mean square over the joints"""
    motions: tuple[str, ...]
    """which repeat"""
    seconds: float
    """[s] compared in all"""


def repeatability(arm: Arm, logs: Sequence[RunLog], free: Sequence[Rows]) -> Repeatability | None:
    """Measure it on all motions that repeat; None if there is none."""
    found = [(log, _spread(arm, log, rows)) for log, rows in zip(logs, free, strict=True)]
    known = [(log.label, spread) for log, spread in found if spread is not None]
    if not known:
        return None
    tcp, joint, seconds = np.array([spread for _, spread in known]).T
    return Repeatability(
        tcp=float(tcp.mean()), lowest=float(tcp.min()), highest=float(tcp.max()), joint=float(joint.mean()),
        motions=tuple(name for name, _ in known), seconds=float(seconds.sum()),
    )  # fmt: skip


def _spread(arm: Arm, log: RunLog, free: Rows) -> tuple[float, float, float] | None:
    """Spread [m], [rad] and time compared [s] of one motion."""
    step = float(np.median(np.diff(log.time)))
    lag = _period(log.command, round(SHORTEST / step), round(LONGEST / step))
    if lag is None:
        return None
    early, late = np.arange(lag, len(log) - lag), np.arange(2 * lag, len(log))
    rows = (_difference(log.command, lag) < SAME**2) & free[early] & free[late]
    if rows.sum() < lag // 2:
        return None
    path = tcp_position(arm, log.position)
    gap = np.sum((path[late] - path[early])[rows] ** 2, axis=1)
    turn = np.mean((log.position[late] - log.position[early])[rows] ** 2)
    # Two repetitions stand apart by the root of two of what each stands from their mean.
    return float(np.sqrt(np.mean(gap) / 2)), float(np.sqrt(turn / 2)), float(rows.sum()) * step


def _period(command: Array, shortest: int, longest: int) -> int | None:
    """Smallest lag [rows] after which moving commands come again for at least a period; None if there is none."""
    coarse = command[::_STRIDE]
    lags = np.arange(max(shortest // _STRIDE, 1), min(longest // _STRIDE, len(coarse) // 3)).tolist()
    for lag in lags:
        if not (_difference(coarse, lag) < (4 * SAME) ** 2).any():
            continue
        around = [lag for lag in range((lag - 1) * _STRIDE, (lag + 2) * _STRIDE) if 0 < 3 * lag < len(command)]
        best, exact = min((float(_difference(command, lag).min()), lag) for lag in around)
        if best < SAME**2:
            return exact
    return None


def _difference(command: Array, lag: int) -> Array:
    """(T - 2 lag,) [rad^2] mean square over a period of what a command differs from that of a period before.

    Infinite where the period before holds too little motion to tell.
    """
    square = _running(((command[lag:] - command[:-lag]) ** 2).mean(axis=1), lag)[lag:]
    steps = np.abs(np.diff(command, axis=0, prepend=command[:1]))
    moved = np.max([_running(column, lag) for column in steps.T], axis=0)[2 * lag :] * lag
    return np.where(moved > 2 * MOVING, square, np.inf)


def _running(values: Array, rows: int) -> Array:
    """Mean over the ``rows`` values up to and with each (fewer at the beginning)."""
    total = np.cumsum(np.concatenate([[0.0], values]))
    first = np.maximum(np.arange(1, len(values) + 1) - rows, 0)
    return (total[1:] - total[first]) / (np.arange(1, len(values) + 1) - first)
