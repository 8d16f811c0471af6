"""Joint goals: the posture for each target, and the way there.

Every controller receives the posture that brings the tool to its target, so no controller searches one by itself.
A far goal comes with a way: a joint trajectory that moves the goal from the last posture to the new one. The target
moves with the goal, so controllers always work close to it, wherever the arm goes.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache

import numpy as np

from rejoint.arms import Arm, Array, JointTrajectory, Motors, clearances, plan
from rejoint.arms.inverse import REST_GAIN
from rejoint.arms.planning import PlanningError
from rejoint.arms.posing import find_postures
from rejoint.arms.rotations import Orientation
from rejoint.arms.workspace import length_size

LAGS, SLOWEST = tuple(np.radians([6.0, 18.0])), 0.1
"""[rad] by which a joint may lag behind its way, and from which the arm goes on with that share of its speed (chosen: a
worn joint lags by 8 deg at full speed, and with twice these lags an arm cut a corner by 7 mm)"""
STUCK = tuple(np.radians([30.0, 36.0]))
"""[rad] of lag from which a joint does not come at all, so that the others go on without it (chosen)"""
ROOM, LEAST = 0.1, 0.2
"""[m] of a myCobot 280 to what an arm could touch below which its joints may lag less, in proportion, and the least
share of those lags (chosen by `python -m benchmarks postures`: with half that room, worn arms touched boxes)"""


Ways = Sequence[Sequence[JointTrajectory]]
"""B rows of K ways, one for each target"""


def with_ways(
    arm: Arm, posture: Array, start: Array, *, motors: Motors | None = None, speed: float = 1.0
) -> tuple[JointTrajectory, ...]:
    """Plan the ways of one arm from ``start`` (n,) to one ``posture`` (K, n) [rad] after another.

    The ``motors`` lift the arm on them. ``speed`` is a share of the arm's own. Where no way is clear, a joint is turned
    once more or less, as far as it goes; InputError where that does not help.
    """
    ways: list[JointTrajectory] = []
    for goal in posture:
        before = ways[-1].goal if ways else start
        ways.append(_clear_way(arm, before, goal, motors, speed))
    return tuple(ways)


def _clear_way(arm: Arm, start: Array, goal: Array, motors: Motors | None, speed: float) -> JointTrajectory:
    """Return the way to ``goal`` (n,) [rad], or to the first posture with one joint a turn away that has one."""
    turned = goal + 2.0 * np.pi * np.vstack([np.eye(arm.joints), -np.eye(arm.joints)])
    turned = turned[((turned >= arm.lower) & (turned <= arm.upper)).all(axis=-1)]
    try:
        return plan(arm, start, goal, motors=motors, speed=speed)
    except PlanningError:
        for other in turned[np.argsort(np.abs(turned - start).max(axis=-1))]:
            with suppress(PlanningError):
                return plan(arm, start, other, motors=motors, speed=speed)
        raise


def waiting(arm: Arm, ways: Sequence[JointTrajectory], since: Array, position: Array, sag: Array) -> Array:
    """Return the share (B,) of the time that ways of B arms leave out now, because joints lag behind them.

    ``since`` (B,) [s] is the time after their begin, ``position`` (B, n) [rad] is measured, ``sag`` (B, n) [rad] what
    it was short of their start. A way on which every joint is late by its own is no longer the one that was checked.
    """
    share = np.zeros(len(ways))
    for b in np.flatnonzero(since < [way.duration for way in ways]).tolist():
        share[b] = 1.0 - pace(arm, ways[b].at(float(since[b])), position[b], sag[b])
    return share


def pace(arm: Arm, goal: Array, position: Array, sag: Array | float = 0.0) -> float:
    """Return the share of its speed with which a way goes on at ``goal`` (n,), for an arm at ``position`` (n,) [rad].

    The less room there is to what the arm may touch, the less its joints may lag. Nothing waits for one that is stuck.
    """
    clear = clearances(arm, np.stack([goal, position]), np.zeros(arm.joints))[:, arm.joints :]
    room = float((clear / _roomy(arm)).min(initial=1.0))
    lag = float(np.abs(goal - position - sag).max())
    return max(float(np.interp(lag / max(room, LEAST), LAGS, (1.0, SLOWEST))), float(np.interp(lag, STUCK, (0.0, 1.0))))


@lru_cache(maxsize=32)
def _roomy(arm: Arm) -> Array:
    """Distances (c,) [m] from which there is room: `ROOM`, or less between what is near in most postures."""
    drawn = np.random.default_rng(1).uniform(arm.lower, arm.upper, (256, arm.joints))
    usual = np.median(clearances(arm, drawn, np.zeros(arm.joints))[:, arm.joints :], axis=0)
    return np.asarray(np.clip(usual, 1e-3, ROOM * length_size(arm)))


def nearest_postures(
    arm: Arm, target: Array, start: Array, turn: Orientation | None = None, *, rest_gain: float = REST_GAIN
) -> Array:
    """Return the postures (B, n) [rad] of targets (B, 3) [m] that are found from ``start`` (B, n) [rad].

    A target of NaN is none: its arm keeps ``start``. A ``rest_gain`` as in `find_postures`.
    """
    posture = start.copy()
    aimed = np.isfinite(target).all(axis=-1)
    if aimed.any():
        wanted = None if turn is None else turn[aimed]
        posture[aimed] = find_postures(arm, target[aimed], start[aimed], wanted, rest_gain=rest_gain)
    return posture
