"""Joint goals: the posture for each target, and the way there.

Controllers receive the posture of their target. A far goal comes with a way: a joint trajectory from the last posture,
along which goal and target move, so that controllers work close to their target.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache

import numpy as np

from rejoint.arms import Arm, Array, JointTrajectory, Motors, clearances, link_inertia, plan
from rejoint.arms.collision import usual_distances
from rejoint.arms.kinematics import REST_GAIN
from rejoint.arms.planning import PlanningError
from rejoint.arms.postures import find_postures
from rejoint.arms.rotations import Orientation
from rejoint.arms.workspace import length_size
from rejoint.control.moving.posture import TURNING

LAGS, SLOWEST = tuple(np.radians([6.0, 18.0])), 0.1
"""[rad] lags behind a way between which the arm slows down, and the least share of its speed (chosen: a worn joint lags
by 8 deg at full speed)"""
SHARE = 0.5
"""Share of the friction that goals on a way compensate (chosen: a fit mistakes it for stiffness)"""
STUCK = tuple(np.radians([30.0, 36.0]))
"""[rad] lags between which the others go on without a stuck joint: that may lighten it (chosen)"""
PATIENCE, STOPPED = (20.0, 10.0), 6.0
"""[s] plus durations of the way, and [s] that it stands still, after which the target is given up (chosen)"""
ROOM, LEAST = 0.1, 0.3
"""[m] of a myCobot 280: clearance below which those lags shrink, and their least share (chosen by `python -m benchmarks
postures`)"""
STOP, LAST, _REST = 0.012, 0.9, 12
"""[m] clearance of the others while a joint is stuck, and share of a way after which they wait for it (chosen)"""
AHEAD, BRAKING, RESERVE = 0.05, 0.22, 0.007
"""[s] over which the approach to obstacles is measured; least time [s] to a clearance of the [m] after it (chosen
likewise)"""
UNKNOWN = Motors(np.array(np.inf), np.array(np.inf))
"""Motors of an arm without a twin"""


Ways = Sequence[Sequence[JointTrajectory]]
"""B rows of K ways"""


def with_ways(arm: Arm, posture: Array, start: Array, *, motors: Motors | None = None) -> tuple[JointTrajectory, ...]:
    """Plan the ways of one arm from ``start`` (n,) through ``posture`` (K, n) [rad].

    The ``motors`` lift the arm. Where no way is clear, a joint goes a turn farther or less, else InputError.
    """
    ways: list[JointTrajectory] = []
    for goal in posture:
        before = ways[-1].goal if ways else start
        ways.append(_clear_way(arm, before, goal, motors))
    return tuple(ways)


def _clear_way(arm: Arm, start: Array, goal: Array, motors: Motors | None) -> JointTrajectory:
    """Way to ``goal`` (n,) [rad], or to one with a joint a turn away."""
    turned = goal + 2.0 * np.pi * np.vstack([np.eye(arm.joints), -np.eye(arm.joints)])
    turned = turned[((turned >= arm.lower) & (turned <= arm.upper)).all(axis=-1)]
    try:
        return plan(arm, start, goal, motors=motors)
    except PlanningError:
        for other in turned[np.argsort(np.abs(turned - start).max(axis=-1))]:
            with suppress(PlanningError):
                return plan(arm, start, other, motors=motors)
        raise


def beginning_at(arm: Arm, way: JointTrajectory, position: Array) -> JointTrajectory:
    """Return the ``way``, or a new one from ``position`` (n,) [rad] if the arm is not at its start."""
    if np.abs(way.start - position).max() > LAGS[1]:
        with suppress(PlanningError):
            return plan(arm, position, way.goal, motors=way.motors, speed=way.speed)
    return way


def lead(arm: Arm, way: JointTrajectory, since: float, pace: float) -> Array:
    """Lead (n,) [rad] of the goal on a way, ``since`` [s] its begin, at a ``pace``: by the inverse of its servos."""
    motors = way.motors or UNKNOWN
    here, late = way.at(since), since + pace * motors.delay
    speed, acceleration = pace * way.at(late, 1), pace**2 * way.at(late, 2)
    mass = motors.armature + link_inertia(arm, here)
    torque = SHARE * motors.coulomb * np.tanh(speed / TURNING) + mass * acceleration + motors.damping * speed
    return way.at(late) - here + torque / motors.stiffness


def waiting(arm: Arm, ways: Sequence[JointTrajectory], since: Array, position: Array, sag: Array) -> Array:
    """Share (B,) of the time that ways wait for lagging joints.

    ``since`` (B,) [s]: time on the way; ``position`` (B, n) [rad]: measured; ``sag`` (B, n) [rad]: its distance from
    the start of the way at the begin. The whole way waits, else it would not be the checked one.
    """
    share = np.zeros(len(ways))
    for b in np.flatnonzero(since < [way.duration for way in ways]).tolist():
        now, way = float(since[b]), ways[b]
        late = now > LAST * way.duration and np.abs(way.at(now) - position[b] - sag[b]).max() > STUCK[1]
        share[b] = 1.0 if late else 1.0 - pace(arm, way, now, position[b], sag[b])
    return share


def pace(arm: Arm, way: JointTrajectory, since: float, position: Array, sag: Array | float = 0.0) -> float:
    """Share of its speed at which a way goes on, ``since`` [s] its begin, at ``position`` (n,) [rad].

    It brakes before obstacles, also those that the arm meets if one joint does not move. The less room, the less joints
    may lag. It waits for a stuck joint where the others would touch something, or where the motors may not lift the
    arm.
    """
    goal, ahead = way.at(np.array([since, since + AHEAD]))
    behind = np.abs(goal - position - sag)
    worst, lag = behind.argmax(), float(behind.max())
    alone = goal.copy()  # where the others are without the worst joint, once they have caught up
    alone[worst] = position[worst]
    without = position + (ahead - goal) * (1.0 - np.vstack([0.0 * goal, np.eye(len(goal))]))  # each of the joints
    clear = clearances(arm, np.vstack([goal, position, alone, ahead, without]), np.zeros(0))
    here = clear[:3].min(axis=0)
    if lag > LAGS[0]:
        rest = position + way.at(np.linspace(since, way.duration, _REST)) - goal
        near = np.minimum(clearances(arm, rest, np.zeros(0)).min(axis=0), clear[5 + worst])
        if (way.heavy and lag > LAGS[1]) or ((near < STOP) & (near < clear[1])).any():
            return 0.0
    room = max(float((here / _roomy(arm)).min(initial=1.0)), LEAST)
    closing = np.maximum(clear[0] - clear[3], clear[1] - clear[4:].min(axis=0)) / AHEAD
    left = np.maximum(here - RESERVE, 1e-4)
    brake = float((left / np.maximum(closing, 1e-6)).min(initial=1.0)) / BRAKING
    slowly, stuck = np.interp(lag / room, LAGS, (1.0, 0.0)), np.interp(lag, STUCK, (0.0, 1.0))
    return max(min(max(slowly, stuck), brake), SLOWEST * room)


@lru_cache(maxsize=32)
def _roomy(arm: Arm) -> Array:
    """Distances (c,) [m] with enough room: `ROOM`, or the usual distance of near bodies."""
    return np.clip(np.median(usual_distances(arm), axis=0), 1e-3, ROOM * length_size(arm))


def nearest_postures(
    arm: Arm, target: Array, start: Array, turn: Orientation | None = None, *, rest_gain: float = REST_GAIN
) -> Array:
    """Postures (B, n) [rad] of targets (B, 3) [m], found from ``start`` (B, n) [rad].

    An arm with a target of NaN keeps ``start``. ``rest_gain`` as in `find_postures`.
    """
    posture = start.copy()
    aimed = np.isfinite(target).all(axis=-1)
    if aimed.any():
        wanted = None if turn is None else turn[aimed]
        posture[aimed] = find_postures(arm, target[aimed], start[aimed], wanted, rest_gain=rest_gain)
    return posture
