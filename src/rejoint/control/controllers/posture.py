"""Brings a worn arm to joint positions, its tool first, and stuck joints to their goals.

The law of the feed-forward controller, with joint errors as steps. Other joints make up for one without torque. A worn
motor may hold a joint and not start it: then the joint moves where its load helps (`unloaded_way`).
"""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from rejoint.arms import (
    Arm,
    Array,
    JointTrajectory,
    Mask,
    Motors,
    clip_norm,
    dls,
    gravity_torque,
    plan,
    position_kinematics,
    tcp_position,
)
from rejoint.arms.postures import pool_of
from rejoint.control.controllers.classical import limit_lead, limit_position
from rejoint.control.controllers.feedforward import TAKEN_BACK, FeedforwardController, FeedforwardGains
from rejoint.control.correction import tool_error
from rejoint.control.reference import Reference, pace
from rejoint.control.robot import ControlInput, Servos, Stillness
from rejoint.system.errors import InputError
from rejoint.system.records import value_type

COUNTS = 1.5
"""encoder counts of a stationary reading (chosen)"""

# Chosen by `python -m benchmarks serve`:
FADE = np.radians(0.3)
"""[rad] error at which the integrated share of it fades to half"""
PUSH, WITHIN = np.radians(5.0), np.radians(0.06)
"""[rad/s] extra push at rest, and [rad] error without it"""
MOVING, STANDING = float(np.radians(5.0)), np.radians(1.0)
"""[rad/s] without correction, and of a stationary joint"""
LACKING = np.radians(0.3)
"""[rad] error of a joint without torque"""
CALM = 0.15
"""[s] within `COUNTS` of a stationary arm"""


@value_type
class PostureGains:
    """Settings; chosen likewise."""

    weak: float = float(np.radians(12.0))
    """[rad] following error without torque"""
    close: float = 4e-4
    """[m] uncorrected tool error at rest"""
    lead: float = float(np.radians(18.0))
    """[rad] largest following error, below the guard's"""


class PostureController(FeedforwardController):
    """Brings B arms to their goals, joint by joint."""

    name = "posture"
    heeds_turn = False

    def __init__(self, arm: Arm, servos: Servos | None = None, gains: PostureGains | None = None) -> None:
        """Take the ``servos`` (n,) of the twin."""
        super().__init__(arm, None if servos is None else servos.stiffness, FeedforwardGains(moving=MOVING))
        self._settings, self._offset = gains or PostureGains(), 0.0 if servos is None else servos.offset
        self._still = Stillness(COUNTS * arm.encoder_step)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Do nothing."""

    def _take(self, inputs: ControlInput, where: Mask) -> None:
        super()._take(inputs, where)
        self._raised[where] -= self._offset

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        position, everyone = inputs.state.position, np.full(len(inputs.sent), True)
        if len(self._position) != len(position):
            self.reset_learned(inputs, everyone)
            self._take(inputs, everyone)
            self.take_over(inputs, everyone)
            self._weak = np.full(position.shape, False)
        moved, goal = position - self._position, self._goals_of(inputs)
        error, arrived = np.where(self._weak, inputs.goal, goal) - position, inputs.arrived[:, None]
        stood = self._still.look(inputs.state.time, position).min(axis=1)[:, None]
        away = tool_error(self._arm, position, tcp_position(self._arm, inputs.goal))[:, None]
        rests, size = (stood >= CALM) & arrived & (away < self._settings.close), np.abs(error)
        stays = (moved == 0.0) & arrived
        push = PUSH / self._gains.rate * np.sign(error) * ((size > WITHIN) & arrived)
        loose = arrived & (self._pushed * moved > 0.0)
        taken, before = np.where(loose, TAKEN_BACK * self._pushed, 0.0), self._correction.copy()
        command = self.correct(inputs, error * size / (size + FADE) + push, -taken, np.zeros(len(error)))
        lead = np.where(self._weak, 1.25 * self._settings.weak, self._settings.lead)  # more would only heat it
        self._asked = np.where(rests, self._asked, limit_lead(command, position, lead))
        added, lost = self._correction + taken - before, self._raised + self._correction - self._asked
        self._correction -= lost  # nothing winds up beyond what can be sent
        sent = (added - lost).clip(np.minimum(added, 0.0), np.maximum(added, 0.0))
        self._pushed = np.where(stays, self._pushed + sent, 0.0)
        return self._asked.copy()

    def _goals_of(self, inputs: ControlInput) -> Array:
        """Postures (B, n) [rad] that place the tools despite weak joints."""
        position, posture = inputs.state.position, inputs.goal
        lead, away = self._asked - position, posture - position
        off = inputs.arrived[:, None] & (np.abs(away) > LACKING)
        spent = (np.abs(lead) > self._settings.weak) & (away * lead > 0.0) & (np.abs(self._speed) < STANDING)
        self._weak = (self._weak | spent) & off
        rows = self._weak.any(axis=1)
        if not rows.any():
            return posture
        goal = posture.copy()
        goal[rows] = _without(self._arm, posture[rows], position[rows], self._weak[rows])
        return goal


def _without(arm: Arm, posture: Array, position: Array, weak: Mask) -> Array:
    """Postures (B, n) [rad] near ``posture`` with the same tool place and constant ``weak`` joints."""
    goal, place = np.where(weak, position, posture), tcp_position(arm, posture)
    for damping in (0.004, 0.004, 0.004, 0.001):
        tool, jacobian = position_kinematics(arm, goal)
        step = dls(jacobian * ~weak[:, None, :], place - tool, damping)
        goal = goal + clip_norm(step, np.radians(8.0))
    return limit_position(arm, goal)


OFF, STANDS = np.radians(3.0), 0.5
"""[rad] off its goal, and [s] without motion, of a stuck joint (chosen)"""
PUSHED = 5.0
"""[s] the same for a nearer joint, which is pushed until then (chosen)"""
STILL = np.radians(0.5)
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

    def advance(self, now: ControlInput) -> ControlInput:
        """See `Reference`. The first call begins the way."""
        time = now.state.time[0]
        if time > self._time:
            self._since += (time - self._time) * pace(self._arm, self._way, self._since, now.state.position[0])
        self._time, arrived = time, np.array([self._since >= self._way.duration])
        return replace(now, goal=self._way.at(self._since)[None], arrived=arrived)


class Unloading(Reference):
    """Brings stuck joints of one arm to their goals."""

    def __init__(
        self,
        arm: Arm,
        motors: Motors | None = None,
        off: float = OFF,
        say: Callable[[str], object] = lambda _: None,
        way: Reference | None = None,
    ) -> None:
        """``off`` [rad], at least `STILL`: distance of a stuck joint from its goal; ``say`` receives one that stays."""
        self._arm, self._least, self._say = arm, max(off, STILL), say
        self._motors = motors or Motors(*np.full((2, arm.joints), np.inf))
        self._goal = np.full(arm.joints, np.nan)
        self._tries, self._said = 0, False
        self._legs: deque[PlannedWay] = deque()
        self._still, self._arrived, self._way = Stillness(STILL), 0.0, way

    @property
    def given_up(self) -> bool:
        """Whether nothing more is tried for this goal."""
        return self._tries >= TRIES

    def give_up(self) -> bool:
        """Try nothing more for this goal; whether it was on such a way."""
        swings, self._tries = bool(self._legs), TRIES
        self._legs.clear()
        return swings

    def short(self, position: Array) -> str:
        """Describe the joint off its goal at ``position`` (n,) [rad], or empty."""
        joint = self._off(position, self._goal)
        if joint is None:
            return ""
        away = np.degrees(abs(self._goal[joint] - position[joint]))
        load = abs(gravity_torque(self._arm, self._goal)[joint])
        lifts = self._motors.usable[joint]
        why = f", where it would carry {load:.2f} N m and surely lifts {lifts:.2f} N m" if load > lifts else ""
        return f"{self._arm.joint_names[joint]} stopped {away:.0f} deg from its goal{why}"

    def advance(self, wanted: ControlInput) -> ControlInput:
        """``wanted``, or with another goal, not arrived, from which a joint starts."""
        wanted = wanted if self._way is None else self._way.advance(wanted)
        state, goal = wanted.state, wanted.goal[0]
        now, position = state.time[0], state.position[0]
        if not (wanted.arrived[0] and np.abs(goal - self._goal).max() < STILL):
            self._goal, self._tries, self._arrived, self._said = goal.copy(), 0, now, False
            self._legs.clear()
        stood = self._still.look(state.time, state.position)[0]
        if not wanted.arrived[0]:
            return wanted
        if self._legs:
            return self._on_legs(wanted, stood)
        if (joint := self._off(position, goal)) is None:
            if now - self._arrived > 2.0 * STANDS:  # there: who pushes the arm away later does not make it swing
                self._tries = TRIES
            return wanted
        stands = min(now - self._arrived, stood[joint])
        if self.given_up:
            if stands > PUSHED and not self._said:  # a joint that is still pushed may come
                self._say(f"{self.short(position)}.")
                self._said = True
            return wanted
        if stands > (STANDS if abs(goal[joint] - position[joint]) > OFF else PUSHED):
            self._tries += 1
            legs = unloaded_way(self._arm, position, goal, joint, self._motors, 1.0 - EASIER * self._tries)
            if not legs:
                self._tries = TRIES
                return wanted
            self._legs.extend(PlannedWay(self._arm, leg) for leg in legs)
            self._still = Stillness(STILL)
            return self._on_legs(wanted, 0.0 * stood)
        return replace(wanted, arrived=np.full(1, False))

    def _off(self, position: Array, goal: Array) -> int | None:
        away = np.abs(goal - position)
        joint = int(away.argmax())
        return joint if away[joint] > self._least else None

    def _on_legs(self, wanted: ControlInput, stood: Array) -> ControlInput:
        found = self._legs[0].advance(wanted)
        if found.arrived[0] or stood.min() > 2.0 * STANDS:  # there, or as near as it comes
            self._legs.popleft()
            self._still = Stillness(STILL)
            self._arrived = wanted.state.time[0]
        return replace(found, arrived=np.full(1, False))


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
        with suppress(InputError):
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
