"""How late states follow their commands. All thresholds without a source are chosen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rejoint.logs.runlog import Array

PLAUSIBLE = (0.0, 0.3)
"""[s] (a low-cost arm: 0.06 to 0.16 s)"""
SEARCHED = 1.0
"""[s] to both sides"""
SHORTEST = 4.0
"""[s] of a log with a lag"""

_ROWS_MOST = 1_000_000
"""Looked at: some hours show as much as a day"""
_WINDOW = 0.2
"""[s] of a velocity: hides encoder steps"""
_GRID = (0.01, 0.05)
"""[s] finest and coarsest step"""
_MOVING = 0.005
"""[rad/s] rms speed of a command"""
_SURE = 1.05, 1.5
"""Unexplained part at the best plausible lag over the best of all, at an end of the plausible range, and inside it (44
motions of a real arm: 1.00, and up to 1.10)"""
_OVERLAP = 0.5
"""Least share of motion in the overlap"""
_UNLIKE = 0.5
"""Unexplained part of a usable lag"""
_EXACT = 1e-3
"""Unexplained part of a lag that explains all (a real cobot: 0.00008 at 0 s, 0.00005 at -0.04 s)"""
_JUMP = np.radians(2.0)
"""[rad] of a command's step in one row"""
_STEPPING = 0.8
"""Stepped share of travel"""
_REST = 1.0
"""[s] without commands around a step"""
_BEGUN = 0.05
"""Travel share of a moving joint: above encoder noise"""
_FEWEST_STEPS = 3


class Lag(NamedTuple):
    """Lag of states behind commands."""

    best: float
    """[s] negative: states come first"""
    sure: bool
    """False: a plausible lag explains as well"""

    @property
    def plausible(self) -> bool:
        """Whether such a lag is usual."""
        return PLAUSIBLE[0] <= self.best <= PLAUSIBLE[1]


def find_lag(time: Array, position: Array, command: Array) -> Lag | None:
    """Lag of positions (T, n) [rad] behind commands at ``time`` (T,) [s]; None: too short or no motion."""
    if len(time) < 10 or time[-1] - time[0] < SHORTEST:
        return None
    period = float(np.median(np.diff(time)))
    step = float(np.clip(period, *_GRID))
    even = np.arange(time[0], time[-1], step)[:_ROWS_MOST]
    held = command[np.searchsorted(time, even, side="right") - 1]
    moved = np.stack([np.interp(even, time, one) for one in position.T], axis=1)
    stepping = [_is_stepping(one, step) for one in held.T if np.ptp(one) > _JUMP]
    if stepping and all(stepping):
        return _of_steps(moved, held, step)
    return _of_velocities(moved, held, step, period)


def _of_velocities(moved: Array, held: Array, step: float, period: float) -> Lag | None:
    width = max(round(max(_WINDOW, 4 * period) / step), 2)
    speed, asked = ((one[width:] - one[:-width]) / (width * step) for one in (moved, held))
    joints = np.sqrt(np.mean(asked**2, axis=0)) > _MOVING
    speed, asked = speed[:, joints], asked[:, joints]
    whole = np.stack([(speed**2).sum(axis=0), (asked**2).sum(axis=0)])
    if not whole[0].any():
        return None
    reach = min(round(SEARCHED / step), len(speed) // 2)
    lags = np.arange(-reach, reach + 1)
    unexplained = np.empty(len(lags))
    for index, lag in enumerate(lags.tolist()):
        later, sooner = speed[max(lag, 0) : len(speed) + min(lag, 0)], asked[max(-lag, 0) : len(asked) - max(lag, 0)]
        power = np.stack([(later**2).sum(axis=0), (sooner**2).sum(axis=0)])
        follows = np.maximum((later * sooner).sum(axis=0), 0.0) ** 2 / np.maximum(power.prod(axis=0), 1e-12)
        # where motion is shifted out of the log, nothing is left to compare
        follows[(power <= _OVERLAP * whole).any(axis=0)] = 0.0
        unexplained[index] = whole[0] @ (1.0 - follows) / whole[0].sum()
    return _chosen(step * lags.astype(float), unexplained, tolerance=max(step, 0.5 * period))


def _chosen(lags: Array, unexplained: Array, tolerance: float) -> Lag:
    alike = bool(unexplained.min() < _UNLIKE)
    unexplained = unexplained + _EXACT
    best = int(np.argmin(unexplained))
    near = np.flatnonzero((lags > PLAUSIBLE[0] - tolerance - 1e-9) & (lags < PLAUSIBLE[1] + tolerance + 1e-9))
    if best in near:
        return Lag(float(np.clip(lags[best], *PLAUSIBLE)), sure=True)
    inside = int(near[np.argmin(unexplained[near])])
    ratio = float(unexplained[inside] / unexplained[best])
    return Lag(float(lags[best]), sure=alike and ratio > _SURE[inside not in (near[0], near[-1])])


def _is_stepping(command: Array, step: float) -> bool:
    """Whether a command (T,) mostly steps and rests."""
    change = np.abs(np.diff(command))
    jumps = np.flatnonzero(change > _JUMP)
    if not len(jumps):
        return False
    near = np.concatenate([[False], np.diff(jumps) * step < 0.1, [False]])
    alone = jumps[~(near[1:] | near[:-1])]
    return bool(change[alone].sum() > _STEPPING * change.sum())


def _of_steps(moved: Array, held: Array, step: float) -> Lag | None:
    reach, rest = round(SEARCHED / step), round(_REST / step)
    shares = []
    for way, asked in zip(moved.T, held.T, strict=True):
        change = np.abs(np.diff(asked))
        changes = np.flatnonzero(change > 0) + 1
        for at in np.flatnonzero(change > _JUMP) + 1:
            others = changes[changes != at]
            if at < reach + rest or at + reach >= len(held) or (np.abs(others - at) < max(reach, rest)).any():
                continue
            near = way[at - reach : at + reach + 1] - way[at - reach]
            if abs(near[-1]) > _JUMP:
                shares.append(near / near[-1])
    if len(shares) < _FEWEST_STEPS:
        return None
    begun = np.flatnonzero(np.median(shares, axis=0) > _BEGUN)
    best = float((begun[0] - reach) * step) if len(begun) else SEARCHED
    return Lag(best=best, sure=not PLAUSIBLE[0] - step < best < PLAUSIBLE[1] + step)
