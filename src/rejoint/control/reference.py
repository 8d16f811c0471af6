"""References: where arms are to be over time.

Paths and streams of targets: `rejoint.control.moving`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, Index, JointTrajectory, Mask, tcp_position
from rejoint.arms.kinematics import REST_GAIN
from rejoint.arms.rotations import Orientation
from rejoint.control.correction import Modelled
from rejoint.control.goal import LAGS, PATIENCE, STOPPED, Ways, beginning_at, lead, nearest_postures, waiting
from rejoint.control.robot import ControlInput, JointState
from rejoint.system.errors import InputError

ARRIVED = np.ones(1, dtype=bool)
"""At rest, of any number of arms"""


class Setpoint(NamedTuple):
    """Where B arms are to be now."""

    goal: Array
    """(B, n) [rad]"""
    target: Array | None = None
    """(B, 3) [m] of the tools, corrected; None: the joints alone count"""
    since: Array | None = None
    """(B,) [s] since the goal stopped, 0 on the way; None: the reference's time"""
    arrived: Mask = ARRIVED
    """(B,) or (1,) the goal has stopped"""
    turn: Orientation | None = None
    """(B,) wanted orientations; None: any"""
    place: Array | None = None
    """(B, 3) [m] recorded target, at the end of the way; None: the tool's at the goal"""
    aim: Array | None = None
    """(B, 3) [m] the same, corrected; None: as ``place``"""
    ahead: Callable[[Array], Array] | None = None
    """goals (k, B, n) [rad] in ``later`` (k, B) [s]; None: as now"""


class Reference(ABC):
    """Where B arms are to be. The loop counts its time, without waits."""

    count: int = 1
    """arms"""
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
    def advance(self, state: JointState, since: Array, /) -> Setpoint:
        """Setpoint ``since`` (B,) [s]; called once per cycle, and again where a leg begins."""

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

    def __init__(self, trajectory: Callable[[Array], Array], count: int) -> None:
        """``trajectory(since)``: (B,) [s] to (B, n) [rad]."""
        self._trajectory, self.count = trajectory, count

    def advance(self, state: JointState, since: Array, /) -> Setpoint:  # noqa: ARG002 - the clock tells
        """See `Reference`."""
        return Setpoint(self._trajectory(since), place=np.full((self.count, 3), np.nan))


class ToolAtGoals(Reference):
    """Joint positions, for controllers of the tool's place."""

    def __init__(self, arm: Arm, reference: Reference) -> None:
        self._arm, self._reference, self.count = arm, reference, reference.count
        self._moved: Array | float = 0.0  # [s] when the goals moved last

    def advance(self, state: JointState, since: Array, /) -> Setpoint:
        """See `Reference`."""
        now = self._reference.advance(state, since)
        self._moved = np.where(now.arrived, self._moved, since)
        return now._replace(target=tcp_position(self._arm, now.goal), since=since - self._moved)


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
        if targets.ndim != 3 or targets.shape[1] == 0 or targets.shape[2] != 3:
            raise InputError(f"targets have shape {targets.shape}, expected (arms, K, 3) with K > 0")
        self.count, self.legs = targets.shape[:2]
        self.planned = ways is not None
        self._arm, self._targets, self._turns, self._correction, self._rows = arm, targets, turns, correction, ways
        self._place = self._aim = targets[:, 0]
        self._goal = self._sag = np.zeros((self.count, arm.joints))  # sag [rad]: off where the ways began, no lag
        self._turn: Orientation | None = None
        self._pace = np.ones(self.count)  # at which the ways go on
        self._went = np.zeros(self.count)  # [s] when they did last
        self._ways: list[JointTrajectory] = []

    def begin(self, where: Mask, index: Index, sent: Array, position: Array) -> None:
        """See `Reference`."""
        each, correction = np.arange(self.count), self._correction
        self._place = target = self._targets[each, index]
        self._turn = None if self._turns is None else self._turns[each, index]
        planned = None
        if self._rows is not None:
            self._ways = self._ways or [row[0] for row in self._rows]
            for b in np.flatnonzero(where).tolist():
                self._ways[b] = beginning_at(self._arm, self._rows[b][index[b]], position[b])
            planned = np.array([way.goal for way in self._ways])
            self.patience = PATIENCE[0] + np.array([PATIENCE[1] * way.duration for way in self._ways])
        aim = target
        if correction is not None:
            aim, self._turn = correction.aim(target, sent, where, planned, self._turn)
        self._aim_at(aim, sent if planned is None else planned, where)

    def _aim_at(self, aim: Array, near: Array, where: Mask) -> None:
        """Aim arms in ``where`` (B,) at ``aim`` (B, 3) [m], with postures found from ``near`` (B, n) [rad]."""
        self._aim = np.where(where[:, None], aim, self._aim)
        turn = None if self._turn is None else self._turn[where]
        self._goal = self._goal.copy()
        rest_gain = 0.0 if self.planned else REST_GAIN  # a planned posture is kept
        self._goal[where] = nearest_postures(self._arm, self._aim[where], near[where], turn, rest_gain=rest_gain)

    def again(self, inputs: ControlInput) -> Mask | None:
        """See `Reference`."""
        if self._correction is None:
            return None
        fresh = self._correction.again(self._place, replace(inputs, target=self._aim))  # the target moves on the way
        if fresh is None:
            return None
        changed: Mask = (fresh != self._aim).any(axis=-1)
        self._aim_at(fresh, self._goal, changed)
        return changed

    def advance(self, state: JointState, since: Array, /) -> Setpoint:
        """See `Reference`. The correction of the aim grows along the way; the goal has a `lead`."""
        goal, target, ways = self._goal, self._aim, self._ways
        if not ways:
            return Setpoint(goal, target, since, ARRIVED, self._turn, self._place, target)
        self._went = np.where((self._pace > 0.0) | (since <= 0.0), state.time, self._went)
        self.patience = np.where(state.time - self._went > STOPPED, -np.inf, self.patience)
        duration = np.array([way.duration for way in ways])
        moving = since < duration
        if moving.any():
            goal, target, rows = goal.copy(), target.copy(), np.flatnonzero(moving).tolist()
            leads = np.zeros_like(goal)
            for b in rows:
                way, now = ways[b], max(float(since[b]), 0.0)
                goal[b] = way.at(now) + now / duration[b] * (self._goal[b] - way.goal)
                leads[b] = lead(self._arm, way, now, self._pace[b])
            target[rows] += tcp_position(self._arm, goal[rows]) - tcp_position(self._arm, self._goal[rows])
            goal += leads
        at_end = np.where(moving, 0.0, since - duration)
        return Setpoint(goal, target, at_end, ~moving, self._turn, self._place, self._aim)

    def left_out(self, since: Array, before: Array, position: Array) -> Array | float:
        """See `Reference`."""
        if not self._ways:
            return 0.0
        sag = np.clip([way.start for way in self._ways] - before, -LAGS[1], LAGS[1])
        self._sag = np.where((since <= 0.0)[:, None], sag, self._sag)
        left = waiting(self._arm, self._ways, since, position, self._sag)
        self._pace = 1.0 - left
        return left
