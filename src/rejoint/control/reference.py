"""References: where arms are to be over time, and the ways to far goals.

A way is a joint trajectory along which goal and target move: controllers work close to their target. Paths and streams:
`rejoint.control.moving`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache

import numpy as np

from rejoint.arms import (
    Arm,
    Array,
    Index,
    JointTrajectory,
    Mask,
    Motors,
    clearances,
    link_inertia,
    plan,
    tcp_pose,
    tcp_position,
)
from rejoint.arms.collision import usual_distances
from rejoint.arms.kinematics import REST_GAIN
from rejoint.arms.planning import PlanningError
from rejoint.arms.postures import find_postures
from rejoint.arms.rotations import Orientation
from rejoint.arms.workspace import length_size
from rejoint.control.correction import Modelled
from rejoint.control.robot import ControlInput
from rejoint.control.targets import in_mm

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
TURNING = 0.015
"""[rad/s] of three quarters of the friction (chosen)"""
UNKNOWN = Motors(np.array(np.inf), np.array(np.inf))
"""Motors of an arm without a twin"""


Ways = Sequence[Sequence[JointTrajectory]]
"""B rows of K ways"""


def with_ways(arm: Arm, posture: Array, start: Array, *, motors: Motors | None = None) -> tuple[JointTrajectory, ...]:
    """Plan the ways of one arm from ``start`` (n,) through ``posture`` (K, n) [rad].

    The ``motors`` lift the arm. Where no way is clear, a joint goes a turn farther or less, else InputError.
    """
    ways = []
    for number, goal in enumerate(posture, start=1):
        try:
            ways.append(_clear_way(arm, start, goal, motors))
        except PlanningError as error:
            raise PlanningError(f"target {number} {in_mm(tcp_position(arm, goal))}: {error}") from error
        start = ways[-1].goal
    return tuple(ways)


def _clear_way(arm: Arm, start: Array, goal: Array, motors: Motors | None) -> JointTrajectory:
    """Way to ``goal`` (n,) [rad], or to one with a joint a turn away."""
    try:
        return plan(arm, start, goal, motors=motors)
    except PlanningError:
        turned = goal + 2.0 * np.pi * np.vstack([np.eye(arm.joints), -np.eye(arm.joints)])
        turned = turned[((turned >= arm.lower) & (turned <= arm.upper)).all(axis=-1)]
        for other in turned[np.argsort(np.abs(turned - start).max(axis=-1))]:
            with suppress(PlanningError):
                return plan(arm, start, other, motors=motors)
        raise


def beginning_at(arm: Arm, way: JointTrajectory, position: Array) -> JointTrajectory:
    """Return the ``way``, or a new one from ``position`` (n,) [rad] if the arm is not at its start."""
    if np.abs(way.start - position).max() > LAGS[1]:
        with suppress(PlanningError):
            return plan(arm, position, way.goal, motors=way.motors)
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
        now, way = since[b], ways[b]
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
    worst, lag = behind.argmax(), behind.max()
    alone = goal.copy()  # where the others are without the worst joint, once they have caught up
    alone[worst] = position[worst]
    without = position + (ahead - goal) * (1.0 - np.vstack([0.0 * goal, np.eye(len(goal))]))  # each of the joints
    clear = clearances(arm, np.vstack([goal, position, alone, ahead, without]))
    here = clear[:3].min(axis=0)
    if lag > LAGS[0]:
        rest = position + way.at(np.linspace(since, way.duration, _REST)) - goal
        near = np.minimum(clearances(arm, rest).min(axis=0), clear[5 + worst])
        if (way.heavy and lag > LAGS[1]) or ((near < STOP) & (near < clear[1])).any():
            return 0.0
    room = max((here / _roomy(arm)).min(initial=1.0), LEAST)
    closing = np.maximum(clear[0] - clear[3], clear[1] - clear[4:].min(axis=0)) / AHEAD
    left = np.maximum(here - RESERVE, 1e-4)
    brake = (left / np.maximum(closing, 1e-6)).min(initial=1.0) / BRAKING
    slowly, stuck = np.interp(lag / room, LAGS, (1.0, 0.0)), np.interp(lag, STUCK, (0.0, 1.0))
    return max(min(max(slowly, stuck), brake), SLOWEST * room)


@lru_cache
def _roomy(arm: Arm) -> Array:
    """Distances (c,) [m] with enough room: `ROOM`, or the usual distance of near bodies."""
    return np.clip(np.median(usual_distances(arm), axis=0), 1e-3, ROOM * length_size(arm))


class Reference(ABC):
    """Where B arms are to be. The loop counts its time, without waits."""

    legs: int = 1
    """successive parts, ended by the schedule"""
    waits: Mask | bool = True
    """(B,) whether its time stops in gaps"""
    planned: bool = False
    """the goals are clear of contacts"""
    patience: Array | float = np.inf
    """(B,) [s] after which a leg and its dwell are over"""

    def begin(self, where: Mask, index: Index, sent: Array, position: Array) -> None:  # noqa: B027 - most have one leg
        """Begin the legs ``index`` (B,) of the arms in ``where`` (B,).

        ``sent``, the last commands, and ``position``: (B, n) [rad].
        """

    @abstractmethod
    def advance(self, now: ControlInput) -> ControlInput:
        """Return ``now`` with the goals; its ``since_target`` is the time [s] since the leg began, without waits.

        Called once per cycle, and again where a leg begins. Without a target, NaN stays: the joints alone count.
        """

    def again(self, inputs: ControlInput) -> Mask | None:  # noqa: ARG002 - most correct nothing
        """Correct the aims; returns the changed arms (B,), or None."""
        return None

    def left_out(self, since: Array, before: Array, position: Array) -> Array | float:  # noqa: ARG002 - most wait for none
        """Share (B,) of the cycle that does not count, for lagging joints.

        ``since`` (B,) [s], joints ``before`` and now at ``position`` (B, n) [rad].
        """
        return 0.0


class JointMotion(Reference):
    """Joint positions by the clock."""

    def __init__(self, trajectory: Callable[[Array], Array]) -> None:
        """``trajectory(since)``: (B,) [s] to (B, n) [rad]."""
        self._trajectory = trajectory

    def advance(self, now: ControlInput) -> ControlInput:
        """See `Reference`."""
        return replace(now, goal=self._trajectory(now.since_target), place=now.target)  # nowhere: NaN


class ToolAtGoals(Reference):
    """Joint positions, for controllers of the tool's place."""

    def __init__(self, arm: Arm, reference: Reference) -> None:
        self._arm, self._reference = arm, reference
        self._moved: Array | float = 0.0  # [s] when the goals moved last

    def advance(self, now: ControlInput) -> ControlInput:
        """See `Reference`."""
        since, now = now.since_target, self._reference.advance(now)
        self._moved = np.where(now.arrived, self._moved, since)
        return replace(now, target=tcp_position(self._arm, now.goal), since_target=since - self._moved)


class TargetSequence(Reference):
    """Corrected targets of B arms in turn."""

    def __init__(
        self,
        arm: Arm,
        targets: Array,
        *,
        ways: Ways | None = None,
        turns: Orientation | None = None,
        correction: Modelled | None = None,
    ) -> None:
        """Take ``targets`` (B, K, 3) [m] and ``turns`` (B, K). A target of NaN is a wait without a goal.

        ``ways`` None: the nearest postures at once.
        """
        targets = np.asarray(targets, dtype=float)
        self.count, self.legs = targets.shape[:2]
        self.planned = bool(ways)
        self._arm, self._targets, self._correction = arm, targets, correction
        self._turns = turns and replace(turns, rotation=turns.rotation.copy())  # corrected where legs have begun
        self._rows = ways or ()
        self._aim = targets[:, 0]
        self._goal = self._sag = np.zeros((self.count, arm.joints))  # sag [rad]: off where the ways began, no lag
        self._pace = np.ones(self.count)  # at which the ways go on
        self._went = np.zeros(self.count)  # [s] when they did last
        self._ways = [row[0] for row in self._rows]

    def begin(self, where: Mask, index: Index, sent: Array, position: Array) -> None:
        """See `Reference`."""
        each, correction = np.arange(self.count), self._correction
        self._place = target = self._targets[each, index]
        self._turn = self._turns and self._turns[each, index]
        planned = None
        if self._rows:
            for b in np.flatnonzero(where).tolist():
                self._ways[b] = beginning_at(self._arm, self._rows[b][index[b]], position[b])
            planned = np.array([way.goal for way in self._ways])
            self.patience = PATIENCE[0] + np.array([PATIENCE[1] * way.duration for way in self._ways])
        aim = target
        if correction is not None:
            aim, self._turn = correction.aim(target, sent, where, planned, self._turn)
        if self._turns and self._turn:
            self._turns.rotation[each, index] = self._turn.rotation
        self._aim_at(aim, sent if planned is None else planned, where)

    def _aim_at(self, aim: Array, near: Array, where: Mask) -> None:
        """Aim arms in ``where`` (B,) at ``aim`` (B, 3) [m], with postures found from ``near`` (B, n) [rad]."""
        self._aim = np.where(where[:, None], aim, self._aim)
        self._goal = np.where(where[:, None], near, self._goal)
        aimed = where & np.isfinite(aim).all(axis=-1)
        if aimed.any():
            turn, rest_gain = self._turn and self._turn[aimed], 0.0 if self.planned else REST_GAIN  # a plan is kept
            self._goal[aimed] = find_postures(self._arm, aim[aimed], near[aimed], turn, rest_gain=rest_gain)

    def again(self, inputs: ControlInput) -> Mask | None:
        """See `Reference`."""
        fresh = None if self._correction is None else self._correction.again(inputs.state)
        if fresh is None:
            return None
        changed = (fresh != self._aim).any(axis=-1)
        self._aim_at(fresh, self._goal, changed)
        return changed

    def advance(self, now: ControlInput) -> ControlInput:
        """See `Reference`. The correction of the aim grows along the way; the goal has a `lead`."""
        goal, target, turn, ways = self._goal, self._aim, self._turn, self._ways
        since, time = now.since_target, now.state.time
        now = replace(now, goal=goal, target=target, turn=turn, place=self._place, aim=target, aim_turn=turn)
        if not ways:
            return now
        self._went = np.where((self._pace > 0.0) | (since <= 0.0), time, self._went)
        self.patience = np.where(time - self._went > STOPPED, -np.inf, self.patience)
        duration = np.array([way.duration for way in ways])
        moving = since < duration
        if moving.any():
            goal, target, rows = goal.copy(), target.copy(), np.flatnonzero(moving)
            leads = np.zeros_like(goal)
            for b in rows:
                way, gone = ways[b], max(since[b], 0.0)
                goal[b] = way.at(gone) + gone / duration[b] * (self._goal[b] - way.goal)
                leads[b] = lead(self._arm, way, gone, self._pace[b])
            target[rows] += tcp_position(self._arm, goal[rows]) - tcp_position(self._arm, self._goal[rows])
            if turn:
                here, there = (tcp_pose(self._arm, q)[:, :3, :3] for q in (goal, self._goal))
                turn = replace(turn, rotation=here @ there.mT @ turn.rotation)
            goal += leads
        at_end = np.where(moving, 0.0, since - duration)
        return replace(now, goal=goal, target=target, turn=turn, since_target=at_end, arrived=~moving)

    def left_out(self, since: Array, before: Array, position: Array) -> Array | float:
        """See `Reference`."""
        if not self._ways:
            return 0.0
        sag = np.clip([way.start for way in self._ways] - before, -LAGS[1], LAGS[1])
        self._sag = np.where((since <= 0.0)[:, None], sag, self._sag)
        left = waiting(self._arm, self._ways, since, position, self._sag)
        self._pace = 1.0 - left
        return left
