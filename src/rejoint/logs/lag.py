"""By how much the states of a log come after its commands: a cause cannot come after its effect.

Velocities are compared, since friction shifts positions by the sign of their motion and so looks like lag, while it
leaves velocities alone but for the moment after a reversal. Where commands are steps with rests between them, what
counts is when the joint begins to move: a servo of limited speed takes its time to arrive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.logs.runlog import Array

BELIEVED = (0.0, 0.3)
"""[s] lags of a servo behind its command, delays of commands and answers among them (measured on a real low-cost arm:
0.06 to 0.16 s; 0.3 s chosen)"""

SEARCHED = 1.0
"""[s] to both sides (chosen: twice what recorders that stamp late are known for)"""

_WINDOW = 0.2
"""[s] over which a velocity is taken (chosen: it has to hide the steps of an encoder)"""
_GRID = (0.01, 0.05)
"""[s] finest and coarsest step of the search (chosen)"""
SHORTEST = 4.0
"""[s] of a log below which nothing is said (chosen: four times the widest lag)"""
_MOVING = 0.005
"""[rad/s] rms velocity of a command from which its joint tells something (chosen)"""

SURE = 1.05
"""Unexplained part at the best believed lag over that at the best of all, from which the former is given up, where it
lies at an end of what is believed (measured on 44 motions of a real low-cost arm: 1.00 as they are; 31 of them are
recognised if their states are stamped 0.2 s too early)"""
SURE_OF_ANOTHER = 1.5
"""The same where the believed lag is a minimum of its own, as in periodic motion (measured likewise: up to 1.10)"""

_JUMP = np.radians(2.0)
"""[rad] of a command in one row from which it counts as a step (chosen)"""
_STEPPING = 0.8
"""Share of the travel of a command in steps from which it counts as stepping (chosen)"""
_REST = 1.0
"""[s] without a change of command before a step, and after it (chosen)"""
_BEGUN = 0.05
"""Share of its way after which a joint counts as moving (chosen: above the noise of encoders)"""
_FEWEST_STEPS = 3


@dataclass(frozen=True, kw_only=True)
class Lag:
    """Where states follow their commands best."""

    best: float
    """[s] by which states are late; negative where they come first"""
    sure: bool
    """False where a lag that is believed explains the states as well"""

    @property
    def believed(self) -> bool:
        """Whether a servo can have such a lag."""
        return BELIEVED[0] <= self.best <= BELIEVED[1]


def find_lag(time: Array, position: Array, command: Array) -> Lag | None:
    """Search for the lag of positions (T, n) [rad] behind the commands (T, n) [rad] in force at ``time`` (T,) [s].

    None where the log is too short, or nothing moves.
    """
    if len(time) < 10 or time[-1] - time[0] < SHORTEST:
        return None
    step = float(np.clip(np.median(np.diff(time)), *_GRID))
    even = np.arange(time[0], time[-1], step)
    if len(even) > 1_000_000:  # (chosen) of what a day of logging shows, some hours tell as much
        even = even[:1_000_000]
    held = command[np.searchsorted(time, even, side="right") - 1]
    moved = np.stack([np.interp(even, time, one) for one in position.T], axis=1)
    stepping = [_is_stepping(one, step) for one in held.T if np.ptp(one) > _JUMP]
    if stepping and all(stepping):
        return _of_steps(moved, held, step)
    return _of_velocities(moved, held, step, float(np.median(np.diff(time))))


def _of_velocities(moved: Array, held: Array, step: float, period: float) -> Lag | None:
    width = max(round(max(_WINDOW, 4 * period) / step), 2)
    speed, asked = ((one[width:] - one[:-width]) / (width * step) for one in (moved, held))
    reach = round(SEARCHED / step)
    inner = slice(reach, len(speed) - reach)
    lags: Array = np.arange(-reach, reach + 1).astype(float)
    told = [joint for joint in range(asked.shape[1]) if np.sqrt(np.mean(asked[:, joint] ** 2)) > _MOVING]
    unexplained, weight = np.zeros(len(lags)), 0.0
    for joint in told:
        one = speed[inner, joint]
        power = float(one @ one)
        if power == 0.0:
            continue
        for index, lag in enumerate(range(-reach, reach + 1)):
            other = asked[reach - lag : len(asked) - reach - lag, joint]
            follows = max(float(one @ other), 0.0) ** 2 / max(power * float(other @ other), 1e-12)
            unexplained[index] += power * (1.0 - follows)
        weight += power
    if not weight:
        return None
    return _chosen(lags * step, unexplained / weight, tolerance=max(step, 0.5 * period))


def _chosen(lags: Array, unexplained: Array, tolerance: float) -> Lag:
    """Take a believed lag unless another one explains clearly more."""
    unexplained = unexplained + 1e-4  # a perfect fit is no infinitely better one
    best = int(np.argmin(unexplained))
    believed = (lags > BELIEVED[0] - tolerance - 1e-9) & (lags < BELIEVED[1] + tolerance + 1e-9)
    inside = int(np.flatnonzero(believed)[np.argmin(unexplained[believed])])
    edge = inside in (np.flatnonzero(believed)[0], np.flatnonzero(believed)[-1])
    ratio = unexplained[inside] / unexplained[best]
    if believed[best]:
        return Lag(best=float(np.clip(lags[best], *BELIEVED)), sure=True)
    return Lag(best=float(lags[best]), sure=bool(ratio > (SURE if edge else SURE_OF_ANOTHER)))


def _is_stepping(command: Array, step: float) -> bool:
    """Tell whether a command (T,) mostly jumps, and rests between its jumps."""
    change = np.abs(np.diff(command))
    jumps = np.flatnonzero(change > _JUMP)
    if not len(jumps):
        return False
    near = np.diff(jumps) * step < 0.1
    alone = ~np.concatenate([[False], near]) & ~np.concatenate([near, [False]])
    return bool(change[jumps[alone]].sum() > _STEPPING * change.sum())


def _of_steps(moved: Array, held: Array, step: float) -> Lag | None:
    """Find when joints begin to move, by the median over all steps of their share of the way."""
    reach, rest = round(SEARCHED / step), round(_REST / step)
    shares = []
    for joint in range(held.shape[1]):
        change = np.abs(np.diff(held[:, joint]))
        steps = np.flatnonzero(change > _JUMP) + 1
        changes = np.flatnonzero(change > 0) + 1
        for at in steps:
            others = changes[changes != at]
            if at < reach + rest or at + reach >= len(held) or (np.abs(others - at) < max(reach, rest)).any():
                continue
            start, way = moved[at - reach, joint], moved[at - reach : at + reach + 1, joint]
            if abs(way[-1] - start) > _JUMP:
                shares.append((way - start) / (way[-1] - start))
    if len(shares) < _FEWEST_STEPS:
        return None
    begun = np.flatnonzero(np.median(shares, axis=0) > _BEGUN)
    best = float((begun[0] - reach) * step) if len(begun) else SEARCHED
    return Lag(best=best, sure=not BELIEVED[0] - step < best < BELIEVED[1] + step)
