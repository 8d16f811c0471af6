"""The learning task: bring the tool to a target and hold it there, on randomly drawn arms.

N agents run in lockstep: a control cycle is a fixed number of physics steps, whose length varies by agent and cycle.
Observation, command law and guard are those of deployment, without the guard's limits of acceleration (no measurable
effect on the policy, docs/benchmarks.md), contacts, and the push of stuck joints: with it, policies settle
farther away.

A target ends by time-out, not failure: the return is bootstrapped from the last state. So it is after a collision; else
a policy would crash on purpose to end a bad episode.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, collides, frames, gravity_torque, heights, solve_position, tcp_position
from rejoint.arms.postures import comfortable_postures
from rejoint.control.controller import ControlInput
from rejoint.control.guard import GuardLimits, guard
from rejoint.control.observation import ALL, SUCCESS_DISTANCE, Layout, Observation, Observer, Rows
from rejoint.control.residual import Commander, CommandLaw
from rejoint.control.robot import JointState, Mask
from rejoint.training.ranges import Ranges
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.simulation import Draw, Simulation


class ResetStates(NamedTuple):
    """m arms at the start of their first episode."""

    draw: Draw
    position: Array
    """(m, n) [rad]"""
    command: Array
    """(m, n) [rad]"""

    def rows(self, index: NDArray[np.integer]) -> ResetStates:
        """Return some rows."""
        return ResetStates(self.draw.rows(index), self.position[index], self.command[index])


def draw_reset_states(
    ranges: Ranges, limits: GuardLimits, rng: np.random.Generator, count: int, *, spread: float, lead_limit: float
) -> ResetStates:
    """Draw ``count`` arms around rest with sigma ``spread`` [rad].

    The first command leads by part of the sag, at most ``lead_limit`` [rad].
    """
    draw = ranges.draw(rng, count)
    position = _start_postures(limits, rng, count, spread)
    return ResetStates(draw, position, position + _start_lead(limits.arm, rng, draw, position, lead_limit))


def _start_postures(limits: GuardLimits, rng: np.random.Generator, count: int, spread: float) -> Array:
    """Postures (m, n) [rad] inside the guard's limits and above the floor."""
    arm = limits.arm
    position = arm.rest + rng.normal(0.0, spread, (count, arm.joints))
    position = np.clip(position, limits.lower, limits.upper)
    low = tcp_position(arm, position)[:, 2] < 3.0 * arm.floor
    return np.where(low[:, None], arm.rest, position)


def _start_lead(arm: Arm, rng: np.random.Generator, draw: Draw, position: Array, limit: float) -> Array:
    """Lead (m, n) [rad] of the first command: none up to the whole sag."""
    if limit == 0.0:
        return np.zeros_like(position)
    torque = draw.gravity_scale[:, None] * gravity_torque(arm, position)
    held = torque / draw.twin.stiffness - draw.twin.offset
    return np.clip(held, -limit, limit) * rng.uniform(0.0, 1.0, (len(position), 1))


def residual_reward(distance: Array, speed: Array, action: Array) -> Array:
    """Reward (N,) that rises with accuracy down to a tenth of a millimetre.

    Three exponentials give a slope at every ``distance`` (N,) [m]; the TCP's ``speed`` (N,) costs only near the target,
    the ``action`` (N, n) everywhere. Chosen by simulation.
    """
    attraction = 0.4 * np.exp(-distance / 0.010) + 0.5 * np.exp(-distance / 0.003) + 0.4 * np.exp(-distance / 0.001)
    haste = 0.2 * np.minimum(speed, 1.0) * np.exp(-distance / 0.020)
    effort = 0.02 * np.minimum(action**2, 2.0).sum(axis=-1)
    return -10.0 * np.minimum(distance, 0.1) + attraction - haste - effort


def paper_reward(
    distance: Array,
    joint_speed: Array,
    collided: NDArray[np.bool_],
    reached: NDArray[np.bool_],
    timed_out: NDArray[np.bool_],
) -> Array:
    """Equation 25 of Park et al. 2024 for ``distance`` (N,) [m] and ``joint_speed`` (N, n) [rad/s].

    Weights .1, .1, -5, 10, 10. Our choice: centimetres, the mean joint speed; the time-out is a penalty, as the text
    says.
    """
    travel = -0.1 * 100.0 * distance - 0.1 * np.abs(joint_speed).mean(axis=-1)
    return travel - 5.0 * timed_out - 10.0 * collided + 10.0 * reached


_MOVING_SCALARS = 4
_FIXED_SCALARS = 4


def privileged_size(joints: int) -> int:
    """Length of the privileged observation."""
    return _MOVING_SCALARS + 2 * joints + _FIXED_SCALARS + 6 * joints


def privileged_constants(arm: Arm, draw: Draw) -> Observation:
    """Privileged observation (m, size) of new arms; the varying part is zero."""
    base, twin = nominal_parameters(arm), draw.twin
    scalars = np.stack(
        [
            5.0 * (draw.gravity_scale - 1.0),
            30.0 * draw.command_delay,
            30.0 * draw.readback_delay,
            np.log(twin.ramp_speed / base.ramp_speed),
        ],
        axis=-1,
    )
    parts = [
        np.log(twin.stiffness / base.stiffness),
        np.log(twin.damping / base.damping),
        np.log(twin.armature / base.armature),
        np.log(twin.torque_limit / base.torque_limit),
        0.5 * twin.coulomb / base.coulomb,
        30.0 * twin.offset,
    ]
    moving = np.zeros((len(scalars), _MOVING_SCALARS + 2 * arm.joints))
    return np.concatenate([moving, scalars, *parts], axis=-1).clip(-8.0, 8.0).astype(np.float32)


def fill_privileged(
    privileged: Observation, distance: Array, speed: Array, velocity: Array, lag: Array, period: Array
) -> None:
    """Fill in the varying part.

    ``distance`` (N,) [m] of the TCP, its ``speed`` (N,) [m/s], joint ``velocity`` (N, n) [rad/s], ``lag`` (N, n) [rad]
    behind the servo's reference, control ``period`` (N,) [s].
    """
    n = velocity.shape[1]
    privileged[:, 0] = 10.0 * distance
    privileged[:, 1] = (np.log(distance + 0.0003) + 5.0) / 2.0
    privileged[:, 2] = 3.0 * speed
    privileged[:, 3] = 30.0 * period
    privileged[:, 4 : 4 + n] = np.clip(0.5 * velocity, -8.0, 8.0)
    privileged[:, 4 + n : 4 + 2 * n] = np.clip(4.0 * lag, -8.0, 8.0)


@dataclass(frozen=True, kw_only=True)
class TaskSettings:
    """Settings of a task."""

    layout: Layout = "residual"
    law: CommandLaw = field(default_factory=CommandLaw)
    reward: Literal["residual", "equation-25"] = "residual"
    posture_weight: float = 0.2
    """[1/rad^2] cost of the null-space distance from rest; chosen: without it the policy drifts to the joint limits"""
    anywhere: float = 0.0
    """share of targets in the whole workspace, with a trajectory there; others are in the target region, and
    immediate"""
    hold_steps: int = 120
    """control cycles per target"""
    targets: int = 6
    """targets per arm"""
    min_period: float = 0.018
    """[s]"""
    max_period: float = 0.055
    """[s]"""
    jitter: float = 0.2
    """relative half-width of each agent's control periods"""
    start_spread: float = float(np.radians(12.0))
    """[rad] sigma around rest"""
    start_sag: bool = True
    """whether the first command leads by part of the sag"""
    ends_on_success: bool = False
    """whether reaching 5 mm ends the episode (the paper)"""
    collisions: bool = False
    """whether a collision ends the target and exchanges the arm (the paper); else ignored"""


DRAWN = 16
"""Postures that are drawn until an arm lifts one; chosen"""


def lifted(draw: Draw) -> Array:
    """Torques (m, n) [N m] that the motors of arms lift, by the rule of `rejoint.session.payload.believed_motors`."""
    limit = draw.twin.torque_limit
    usable = 0.9 * limit - 2.0 * draw.twin.coulomb
    return np.asarray(np.maximum(usable, 0.1 * limit) / draw.gravity_scale[:, None])


@lru_cache(maxsize=4)
def comfortable_loads(arm: Arm) -> Array:
    """Torques (P, n) [N m] that hold the comfortable postures."""
    return gravity_torque(arm, comfortable_postures(arm))


class Transition(NamedTuple):
    """One control cycle of N agents."""

    observation: Observation
    """(N, size) for the next decision"""
    privileged: Observation
    """(N, p) for the critic"""
    final_observation: Observation
    """(N, size) at the end of this cycle, before new targets"""
    final_privileged: Observation
    reward: Array
    """(N,)"""
    terminated: Mask
    """(N,) success, where it ends the episode"""
    truncated: Mask
    """(N,) time-outs and collisions"""
    collided: Mask
    """(N,) with the ground or itself"""
    distance: Array
    """(N,) [m] of the twin's true TCP to the target"""


class ReachTask:
    """N arms with targets; arrays have a leading axis of agents."""

    def __init__(
        self,
        arm: Arm,
        ranges: Ranges,
        agents: int,
        settings: TaskSettings,
        *,
        seed: int,
        threads: int = 1,
    ) -> None:
        n = arm.joints
        self.arm, self.ranges, self.settings, self.agents = arm, ranges, settings, agents
        self.simulation = Simulation(arm, agents, threads=threads)
        self.observer = Observer(arm, agents, settings.layout)
        self.commander = Commander(arm, replace(settings.law, loosen=0.0))  # exploring arms are never stuck for long
        self.privileged_size = privileged_size(n)
        self._limits, self._no_speed = GuardLimits.of(arm).of_simulation(), np.zeros((agents, n))
        self._rng = np.random.default_rng(seed)
        self._since, self._period, self._middle = np.zeros((3, agents))
        self._sent, self._tcp = np.zeros((agents, n)), np.zeros((agents, 3))
        self._aim, self._next_aim = np.zeros((2, agents, 3))
        self._goal, self._next_goal, self._start = np.zeros((3, agents, n))
        self._far, self._next_far, self._travel = *np.zeros((2, agents), dtype=bool), np.zeros(agents)
        self._lifts = np.ones((agents, n))
        self._foreseen, self._prepared_row = np.zeros(agents, dtype=bool), np.zeros(agents, dtype=np.int64)
        self._prepared: ResetStates | None = None
        self._step, self._count = np.zeros(agents, dtype=np.int64), np.zeros(agents, dtype=np.int64)
        self._constants = np.zeros((agents, privileged_size(n)), dtype=np.float32)

    def reset(self, *, staggered: bool = True) -> tuple[Observation, Observation]:
        """Restart all agents, ``staggered`` at different points of their episodes; returns both observations."""
        everyone = np.ones(self.agents, dtype=bool)
        self._new_arms(everyone)
        self._new_targets(everyone)
        if staggered:  # so that a batch holds all phases of a motion and not the same one everywhere
            self._step[:] = self._rng.integers(0, self.settings.hold_steps, self.agents)
            self._count[:] = self._rng.integers(0, self.settings.targets, self.agents)
        distance = np.linalg.norm(self._aim - self._tcp, axis=-1)
        return self.observer.observe(self._inputs()), self._privileged(distance, np.zeros(self.agents))

    def prepare(self, cycles: int) -> None:
        """Draw new targets and arms for all agents that time out within so many cycles.

        One batch is faster than the draws in `step`.
        """
        if self.settings.ends_on_success or self.settings.collisions:
            return  # when is not known
        due = self._step + cycles >= self.settings.hold_steps
        leaving = due & (self._count + 1 >= self.settings.targets)
        self._prepared = self._draw_reset_states(int(leaving.sum()))
        self._prepared_row[leaving] = np.arange(leaving.sum())
        self._foreseen = due
        start, lifts = self._goal.copy(), self._lifts.copy()
        start[leaving], lifts[leaving] = self._prepared.command, lifted(self._prepared.draw)
        self._draw_targets(due, start, lifts)

    def step(self, action: NDArray[np.floating]) -> Transition:
        """Run one control cycle with actions (N, n)."""
        applied = np.clip(np.asarray(action, dtype=float), -1.0, 1.0)
        self._command(applied)
        before = self.simulation.twins.qpos.copy()
        self._advance()
        position = self.simulation.twins.qpos
        tcp = tcp_position(self.arm, position)
        speed = np.linalg.norm(tcp - self._tcp, axis=-1) / self._period
        self._tcp = tcp
        distance = np.linalg.norm(self._aim - tcp, axis=-1)
        self._step += 1
        final, final_privileged = self.observer.observe(self._inputs()), self._privileged(distance, speed)
        reached = (distance < SUCCESS_DISTANCE) & self.settings.ends_on_success
        collided = self._collided()
        late = (self._step >= self.settings.hold_steps) & ~reached
        if self.settings.reward == "residual":
            reward = residual_reward(distance, speed, np.asarray(action, dtype=float))
            reward = reward - self.settings.posture_weight * (self.observer.view.homing**2).sum(axis=-1)
        else:
            joint_speed = (position - before) / self._period[:, None]
            reward = paper_reward(distance, joint_speed, collided, reached, late)
        cut = late | (collided & ~reached)
        observation, privileged = self._renew(reached | cut, collided, final, final_privileged)
        return Transition(observation, privileged, final, final_privileged, reward, reached, cut, collided, distance)

    def state(self) -> dict[str, Any]:
        """Return copies for a checkpoint."""
        arrays = {name: value.copy() for name, value in self._arrays().items()}
        return {"random": self._rng.bit_generator.state, **arrays}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state`, bit for bit, if no prepared targets were left."""
        self._foreseen[:] = False
        self._rng.bit_generator.state = state["random"]
        for name, value in self._arrays().items():
            value[...] = state[name]

    def _arrays(self) -> dict[str, Array]:
        own = (
            "since",
            "period",
            "middle",
            "sent",
            "tcp",
            "aim",
            "goal",
            "start",
            "travel",
            "step",
            "count",
            "constants",
            "lifts",
            "far",
        )
        return {
            **{name: getattr(self, f"_{name}") for name in own},
            **{f"observer.{name}": value for name, value in self.observer.state().items()},
            **{f"commander.{name}": value for name, value in self.commander.memory().items()},
            **{f"simulation.{name}": value for name, value in self.simulation.state().items()},
        }

    def _inputs(self) -> ControlInput:
        now = self.simulation
        state = JointState(time=now.time, position=now.measured, age=np.zeros(self.agents))
        goal, target, since = self._setpoint()
        return ControlInput(state=state, target=target, goal=goal, sent=self._sent, since_target=since)

    def _setpoint(self) -> tuple[Array, Array, Array]:
        moving = self._since < self._travel
        if not moving.any():
            return self._goal, self._aim, self._since - self._travel
        goal, target = self._goal.copy(), self._aim.copy()
        left = 1.0 - self._since[moving] / self._travel[moving]
        goal[moving] += left[:, None] * (self._start[moving] - goal[moving])
        target[moving] += tcp_position(self.arm, goal[moving]) - tcp_position(self.arm, self._goal[moving])
        return goal, target, np.maximum(self._since - self._travel, 0.0)

    def _command(self, action: Array) -> None:
        inputs, observer = self._inputs(), self.observer
        observer.acted(action)
        wanted = self.commander.command(inputs, observer.view, action)
        self._sent = guard(self._limits, wanted, self._sent, self._no_speed, inputs.state, self._period).command
        self.simulation.send(self._sent)

    def _advance(self) -> None:
        s = self.settings
        spread = self._rng.uniform(1.0 - s.jitter, 1.0 + s.jitter, self.agents)
        self._period = np.clip(self._middle * spread, s.min_period, s.max_period)
        self.simulation.advance(self._period)
        self._since = self._since + self._period

    def _collided(self) -> Mask:
        if not self.settings.collisions:
            return np.zeros(self.agents, dtype=bool)
        return collides(self.arm, frames(self.arm, self.simulation.twins.qpos))

    def _renew(
        self, ended: Mask, collided: Mask, final: Observation, final_privileged: Observation
    ) -> tuple[Observation, Observation]:
        if not ended.any():
            return final, final_privileged
        self._count[ended] += 1
        exchanged = ended & ((self._count >= self.settings.targets) | collided)
        if exchanged.any():
            self._new_arms(exchanged)
        self._new_targets(ended)
        rows = np.flatnonzero(ended)
        observation, privileged = final.copy(), final_privileged.copy()
        observation[rows] = self.observer.observe(self._inputs(), rows)
        distance = np.linalg.norm(self._aim[rows] - self._tcp[rows], axis=-1)
        privileged[rows] = self._privileged(distance, np.zeros(len(rows)), rows)
        return observation, privileged

    def _new_targets(self, where: Mask) -> None:
        unforeseen = where & ~self._foreseen
        start = np.where(self._count[:, None] == 0, self._sent, self._goal)
        self._draw_targets(unforeseen, start, self._lifts)
        self._start[where] = start[where]
        self._aim[where], self._goal[where] = self._next_aim[where], self._next_goal[where]
        way = np.abs(self._goal[where] - self._start[where]) / self.arm.max_speed
        first = self._count[where] == 0
        far = self._next_far[where] | (self._far[where] & ~first)
        self._travel[where] = np.where(far, way.max(axis=-1), 0.0)
        self._far[where] = self._next_far[where]
        self._foreseen[where] = False
        self._since[where] = 0.0
        self._step[where] = -np.ceil(self._travel[where] / self._middle[where])
        self.observer.reset(self._inputs(), where)
        self.commander.reset(self._inputs(), where)

    def _draw_targets(self, where: Mask, start: Array, lifts: Array) -> None:
        """Draw the next targets of the arms in ``where`` (N,): anywhere, or in the region near ``start`` (N, n).

        Those anywhere are among what their motors lift, ``lifts`` (N, n) [N m], as a deployment chooses them.
        """
        count = int(where.sum())
        place = self.arm.targets.sample(self._rng, (count,))
        near = np.where(self._far[where, None], self.arm.rest, start[where])
        goal = solve_position(self.arm, place, near).q
        if self.settings.anywhere > 0.0:
            far = self._rng.random(count) < self.settings.anywhere
            goal[far] = self._draw_postures(start[where][far], lifts[where][far])
            place[far] = tcp_position(self.arm, goal[far])
            self._next_far[where] = far
        self._next_aim[where], self._next_goal[where] = place, goal

    def _draw_postures(self, start: Array, lifts: Array) -> Array:
        """Draw a posture (m, n) [rad] for each arm: of `DRAWN` the first that suits, or the lightest.

        Its motors lift it, and the straight ways from ``start`` (m, n) [rad] and to rest stay above the floor.
        """
        postures, loads = comfortable_postures(self.arm), comfortable_loads(self.arm)
        drawn = self._rng.integers(0, len(postures), (len(lifts), DRAWN))
        goal, share = postures[drawn], np.linspace(0.0, 1.0, 9)[1:-1, None, None, None]
        excess = np.maximum(np.abs(loads[drawn]) / lifts[:, None], 1.0).max(axis=-1)
        for end in (start[:, None], self.arm.rest):
            room = heights(self.arm, end + share * (goal - end))[..., 1:] - self._limits.floors
            excess += np.where((room < self.arm.floor).any(axis=(0, -1)), 100.0, 0.0)
        return np.asarray(goal[np.arange(len(lifts)), excess.argmin(axis=1)])

    def _new_arms(self, where: Mask) -> None:
        foreseen, unforeseen = where & self._foreseen, where & ~self._foreseen
        if foreseen.any() and self._prepared is not None:
            self._place(foreseen, self._prepared.rows(self._prepared_row[foreseen]))
        if unforeseen.any():
            self._place(unforeseen, self._draw_reset_states(int(unforeseen.sum())))

    def _draw_reset_states(self, count: int) -> ResetStates:
        s = self.settings
        lead_limit = s.law.lead_limit if s.start_sag else 0.0
        return draw_reset_states(
            self.ranges, self._limits, self._rng, count, spread=s.start_spread, lead_limit=lead_limit
        )

    def _place(self, where: Mask, states: ResetStates) -> None:
        draw, position, command = states
        self._lifts[where] = lifted(draw)
        self.simulation.place(draw, position, command, where)
        self._sent[where] = command
        self._tcp[where] = tcp_position(self.arm, position)
        self._middle[where] = self._period[where] = draw.period
        self._count[where] = 0
        self._constants[where] = privileged_constants(self.arm, draw)
        self.observer.reset_learned(where)
        self.commander.reset_learned(self._inputs(), where)

    def _privileged(self, distance: Array, speed: Array, rows: Rows = ALL) -> Observation:
        """Privileged observation (N, p), or some ``rows`` of it."""
        privileged = self._constants[rows].copy()
        twins = self.simulation.twins
        lag = self.simulation.reference.position[rows] - twins.qpos[rows]
        fill_privileged(privileged, distance, speed, twins.qvel[rows], lag, self._period[rows])
        return privileged
