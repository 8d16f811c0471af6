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
from rejoint.arms.collision import usual_distances
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
PATIENCE = (20.0, 10.0)
"""[s] and durations of its way after which an arm goes on to the next target, reached or not (chosen)"""
ROOM, LEAST = 0.1, 0.3
"""[m] of a myCobot 280 to what an arm could touch below which its joints may lag less, in proportion, and the least
share of those lags (chosen by `python -m benchmarks postures`: with half that room, worn arms touched boxes)"""
AHEAD, BRAKING, RESERVE = 0.05, 0.35, 0.005
"""[s] over which the speed is measured with which a way comes nearer to something, least time [s] until it would be as
near as the [m] after it (chosen likewise: with 0.25 s worn arms overshot, with 0.5 s ways took 0.1 s longer)"""
STOP, CREEPING = 0.010, 1e-3
"""[m] to something at which the others stop while a joint is stuck, and [m/s] with which they come nearer (chosen)"""


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


def beginning_at(arm: Arm, way: JointTrajectory, position: Array) -> JointTrajectory:
    """Return the ``way``, or a new one to its goal where the arm is at another ``position`` (n,) [rad] than its start.

    A clear one is not always found; then the old one stays.
    """
    if np.abs(way.start - position).max() > LAGS[1]:
        with suppress(PlanningError):
            return plan(arm, position, way.goal)
    return way


def waiting(arm: Arm, ways: Sequence[JointTrajectory], since: Array, position: Array, sag: Array) -> Array:
    """Return the share (B,) of the time that ways of B arms leave out now, because joints lag behind them.

    ``since`` (B,) [s] is the time after their begin, ``position`` (B, n) [rad] is measured, ``sag`` (B, n) [rad] what
    it was short of their start. A way on which every joint is late by its own is no longer the one that was checked.
    """
    share = np.zeros(len(ways))
    for b in np.flatnonzero(since < [way.duration for way in ways]).tolist():
        share[b] = 1.0 - pace(arm, ways[b], float(since[b]), position[b], sag[b])
    return share


def pace(arm: Arm, way: JointTrajectory, since: float, position: Array, sag: Array | float = 0.0) -> float:
    """Return the share of its speed with which a way goes on, ``since`` [s] its begin, at ``position`` (n,) [rad].

    It brakes before what it comes nearer to. The less room there is to what the arm may touch, the less its joints may
    lag. Nothing waits for one that is stuck, but the way stops where the others would then touch something.
    """
    goal, ahead = way.at(np.array([since, since + AHEAD]))
    postures = np.stack([goal, position, ahead, position + ahead - goal])
    clear = clearances(arm, postures, np.zeros(0))
    room = max(float((clear[:2] / _roomy(arm)).min(initial=1.0)), LEAST)
    closing = (clear[:2] - clear[2:]) / AHEAD
    left = np.maximum(clear[:2].min(axis=0) - RESERVE, 1e-4)
    brake = float((left / np.maximum(closing, 1e-6)).min(initial=1.0)) / BRAKING
    lag = float(np.abs(goal - position - sag).max())
    if lag > LAGS[1] and ((clear[3] < STOP) & (closing[1] > CREEPING)).any():
        return 0.0
    slowly, stuck = np.interp(lag / room, LAGS, (1.0, 0.0)), np.interp(lag, STUCK, (0.0, 1.0))
    return max(min(max(slowly, stuck), brake), SLOWEST * room)


@lru_cache(maxsize=32)
def _roomy(arm: Arm) -> Array:
    """Distances (c,) [m] from which there is room: `ROOM`, or less between what is near in most postures."""
    return np.asarray(np.clip(np.median(usual_distances(arm), axis=0), 1e-3, ROOM * length_size(arm)))


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
