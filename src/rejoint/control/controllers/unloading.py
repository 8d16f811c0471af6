"""Brings stuck joints to their goals.

A worn motor may hold a joint and not start it. Then the joint moves where its load helps (`unloaded_way`).
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable

import numpy as np

from rejoint.arms import Arm, Array, JointTrajectory, Motors, gravity_torque, plan
from rejoint.arms.postures import pool_of
from rejoint.control.goal import pace
from rejoint.control.reference import Reference, Setpoint
from rejoint.control.robot import JointState, Stillness
from rejoint.system.errors import InputError

OFF, STANDS = float(np.radians(3.0)), 0.5
"""[rad] off its goal, and [s] without motion, of a stuck joint (chosen)"""
PUSHED = 5.0
"""[s] the same for a nearer joint, which is pushed until then (chosen)"""
STILL = float(np.radians(0.5))
"""[rad] within which a joint stands (chosen)"""
TRIES = 4
"""Postures tried for one goal (chosen)"""
EASIER = 0.2
"""Share less that a motor lifts in each further try (chosen)"""
_SHARES, _PLANNED, _TRAVEL = (0.3, 0.6, 1.0), 6, 0.15  # of ways to stored postures; what a radian counts
_STARTS = 5.0  # what a load counts that the motor does not surely lift


class PlannedWay(Reference):
    """Follows a planned way at its `pace`, and stays at its end."""

    def __init__(self, arm: Arm, way: JointTrajectory) -> None:
        self._arm, self._way, self._since, self._time = arm, way, 0.0, np.nan

    def advance(self, state: JointState, since: Array, /) -> Setpoint:  # noqa: ARG002 - it waits by itself
        """See `Reference`. The first call begins the way."""
        now = float(state.time[0])
        if now > self._time:
            self._since += (now - self._time) * pace(self._arm, self._way, self._since, state.position[0])
        self._time = now
        return Setpoint(self._way.at(self._since)[None], arrived=np.array([self._since >= self._way.duration]))


class UnloadedWay(Reference):
    """Any way of one arm, with `Unloading`."""

    def __init__(self, way: Reference, unloading: Unloading, say: Callable[[str], object] = lambda _: None) -> None:
        """``say`` receives the joint that stays off its goal."""
        self._way, self._unloading, self._say, self._since = way, unloading, say, np.inf

    def advance(self, state: JointState, since: Array, /) -> Setpoint:
        """See `Reference`."""
        wanted = self._unloading.advance(state, self._way.advance(state, since))
        short = self._unloading.short(state.position[0]) if self._unloading.given_up and wanted.arrived[0] else ""
        now = float(state.time[0])
        self._since = min(self._since, now) if short else np.inf  # a joint that is still pushed may come
        if now - self._since > PUSHED:
            self._say(f"{short}.")
            self._since = np.nan  # said once
        return wanted


class Unloading:
    """Brings stuck joints of one arm to their goals."""

    def __init__(self, arm: Arm, motors: Motors | None = None, off: float = OFF) -> None:
        """``off`` [rad], at least `STILL`: distance of a stuck joint from its goal."""
        self._arm, self._least = arm, max(off, STILL)
        self._motors = motors or Motors(*np.full((2, arm.joints), np.inf))
        self._goal = np.full(arm.joints, np.nan)
        self._tries = 0
        self._legs: deque[PlannedWay] = deque()
        self._still, self._arrived = Stillness(STILL), 0.0

    @property
    def given_up(self) -> bool:
        """Whether nothing more is tried for this goal."""
        return self._tries >= TRIES

    def short(self, position: Array) -> str:
        """Describe the joint off its goal at ``position`` (n,) [rad], or empty."""
        joint = self._off(position, self._goal)
        if joint is None:
            return ""
        away = np.degrees(abs(self._goal[joint] - position[joint]))
        load = abs(float(gravity_torque(self._arm, self._goal)[joint]))
        lifts = float(self._motors.usable[joint])
        why = f", where it would carry {load:.2f} N m and surely lifts {lifts:.2f} N m" if load > lifts else ""
        return f"{self._arm.joint_names[joint]} stopped {away:.0f} deg from its goal{why}"

    def advance(self, state: JointState, wanted: Setpoint) -> Setpoint:
        """``wanted``, or another setpoint, not arrived, from which a joint starts."""
        now, position, goal = float(state.time[0]), state.position[0], wanted.goal[0]
        if not (wanted.arrived[0] and np.abs(goal - self._goal).max() < STILL):
            self._goal, self._tries, self._arrived = goal.copy(), 0, now
            self._legs.clear()
        stood = self._still.look(state.time, state.position)[0]
        if not wanted.arrived[0]:
            return wanted
        if self._legs:
            return self._on_legs(state, stood)
        if self.given_up or (joint := self._off(position, goal)) is None:
            if now - self._arrived > 2.0 * STANDS:  # there: who pushes the arm away later does not make it swing
                self._tries = TRIES
            return wanted
        far = abs(goal[joint] - position[joint]) > OFF
        if min(now - self._arrived, stood[joint]) > (STANDS if far else PUSHED):
            self._tries += 1
            share = 1.0 - EASIER * self._tries
            legs = unloaded_way(self._arm, position, goal, joint, self._motors, share)
            if not legs:
                self._tries = TRIES
                return wanted
            self._legs.extend(PlannedWay(self._arm, leg) for leg in legs)
            self._still.restart(np.ones(1, dtype=bool))
            return self._on_legs(state, 0.0 * stood)
        return Setpoint(wanted.goal, arrived=np.zeros(1, dtype=bool))

    def _off(self, position: Array, goal: Array) -> int | None:
        away = np.abs(goal - position)
        joint = int(away.argmax())
        return joint if away[joint] > self._least else None

    def _on_legs(self, state: JointState, stood: Array) -> Setpoint:
        now, found = float(state.time[0]), self._legs[0].advance(state, state.time)
        if found.arrived[0] or stood.min() > 2.0 * STANDS:  # there, or as near as it comes
            self._legs.popleft()
            self._still.restart(np.ones(1, dtype=bool))
            self._arrived = now
        return Setpoint(found.goal, arrived=np.zeros(1, dtype=bool))


def unloaded_way(
    arm: Arm, position: Array, goal: Array, joint: int, motors: Motors, share: float
) -> tuple[JointTrajectory, ...]:
    """Plan a way from ``position`` to ``goal`` (n,) [rad] on which its load helps ``joint``.

    Its motor lifts at most a ``share`` of its torque, if possible. Three trajectories (the others, the joint, the
    others), one if the straight way was blocked, or none.
    """
    pool, sense = pool_of(arm), np.sign(goal[joint] - position[joint])
    load = sense * gravity_torque(arm, position)[joint]
    if load < motors.usable[joint]:
        with contextlib.suppress(InputError):
            straight = plan(arm, position, goal)
            if len(straight.moves) > 1:  # something was in the way
                return (straight,)
    stored = pool.posture[:: max(1, len(pool.posture) // 1500)]
    tried = np.concatenate([position + share * (stored - position) for share in _SHARES])
    tried[:, joint] = position[joint]
    there = tried.copy()
    there[:, joint] = goal[joint]
    scale = np.maximum(np.abs(pool.torque).max(axis=0), 1e-9)
    if scale[joint] <= 1e-3 * scale.max():
        return ()
    loads = np.stack([gravity_torque(arm, tried), gravity_torque(arm, there)])
    starts = np.maximum((sense * loads[..., joint]).max(axis=0) / motors.usable[joint] - share, 0.0)
    against = sense * loads[0, :, joint] / scale[joint] + _STARTS * starts
    others = np.delete(np.abs(loads) / motors.usable, joint, axis=2)
    heavy = np.maximum(others.max(axis=(0, 2)) - 1.0, 0.0)
    cost = against + heavy + _TRAVEL * (np.abs(tried - position).max(axis=1) + np.abs(goal - there).max(axis=1))
    for k in np.argsort(cost)[:_PLANNED]:
        try:
            return (plan(arm, position, tried[k]), plan(arm, tried[k], there[k]), plan(arm, there[k], goal))
        except InputError:
            continue
    return ()
