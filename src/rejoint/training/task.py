"""The learning task, and its recipes: bring the tool to a target and hold it there, on randomly drawn arms.

N agents run in lockstep: a control cycle is a fixed number of physics steps, whose length varies. Observation, command
law and guard are those of deployment, without limits of acceleration, contacts, and the push of stuck joints: with it,
policies settle farther away.

Returns are bootstrapped from the last state of a target, also after a collision: else a policy would crash on purpose.
"""

from dataclasses import field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Mask, gravity_torque, heights, solve_position, tcp_position
from rejoint.arms.postures import comfortable_postures
from rejoint.control.controllers.feedforward import Commander, CommandLaw
from rejoint.control.controllers.observation import Layout, Observation, Observer
from rejoint.control.guard import GuardLimits, guard
from rejoint.control.robot import ControlInput, JointState
from rejoint.system.errors import InputError
from rejoint.system.files import read_shipped
from rejoint.system.records import value_type
from rejoint.training.ranges import Ranges
from rejoint.twin.parameters import lifting_torque, nominal_parameters
from rejoint.twin.simulation import Draw, Simulation


def residual_reward(distance: Array, speed: Array, action: Array) -> Array:
    """Reward (N,) that rises with accuracy down to a tenth of a millimetre.

    ``distance`` (N,) [m], ``speed`` (N,) [m/s] of the TCP, ``action`` (N, n). Chosen by simulation.
    """
    attraction = 0.4 * np.exp(-distance / 0.010) + 0.5 * np.exp(-distance / 0.003) + 0.4 * np.exp(-distance / 0.001)
    haste = 0.2 * np.minimum(speed, 1.0) * np.exp(-distance / 0.020)
    effort = 0.02 * np.minimum(action**2, 2.0).sum(axis=-1)
    return -10.0 * np.minimum(distance, 0.1) + attraction - haste - effort


def privileged_constants(arm: Arm, draw: Draw) -> Observation:
    """Part (m, 4 + 6 n) of the privileged observation that stays."""
    base, twin = nominal_parameters(arm), draw.twin
    scalars = (
        5.0 * (draw.gravity_scale - 1.0),
        30.0 * draw.command_delay,
        30.0 * draw.readback_delay,
        np.log(twin.ramp_speed / base.ramp_speed),
    )
    names = ("stiffness", "damping", "armature", "torque_limit")
    ratios = (np.log(getattr(twin, name) / getattr(base, name)) for name in names)
    parts = [np.stack(scalars, axis=-1), *ratios, 0.5 * twin.coulomb / base.coulomb, 30.0 * twin.offset]
    return np.concatenate(parts, axis=-1).clip(-8.0, 8.0).astype(np.float32)


@value_type
class TaskSettings:
    """Settings of a task."""

    layout: Layout = "residual"
    law: CommandLaw = field(default_factory=CommandLaw)
    anywhere: float = 0.0
    """share of targets in the whole workspace, with a trajectory there; others are in the target region"""
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


POSTURE_WEIGHT = 0.2
"""[1/rad^2] cost of the null-space distance from rest; chosen: without it policies drift to the limits"""

EXPLORED = float(np.radians(0.24))
"""[rad] step below which authority does not fall in training; chosen: half of it is just above an encoder count"""

DRAWN = 16
"""Postures that are drawn until an arm lifts one; chosen"""


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

    ends_on_success = False
    """whether a reached target ends the episode"""

    def __init__(
        self,
        arm: Arm,
        ranges: Ranges,
        agents: int,
        settings: TaskSettings,
        *,
        seed: int,
    ) -> None:
        n = arm.joints
        self.arm, self.ranges, self.settings, self.agents = arm, ranges, settings, agents
        self.simulation = Simulation(arm, agents)
        self.observer = Observer(arm, agents, settings.layout)
        law = settings.law  # exploring arms are never stuck for long
        law = replace(law, loosen=0.0, authority_floor=max(law.authority_floor, EXPLORED * law.authority_slope))
        self.commander = Commander(arm, law)
        self.privileged_size = 8 * (n + 1)
        self._limits, self._rng = GuardLimits.of(arm).of_simulation(), np.random.default_rng(seed)
        self._since, self._period, self._middle, self._travel = np.zeros((4, agents))
        self._tcp, self._aim = np.zeros((2, agents, 3))
        self._sent, self._goal, self._start, self._no_speed, self._lifts = np.zeros((5, agents, n))
        """the last: (N, n) [N m] torques that the motors lift"""
        self._far = np.zeros(agents, dtype=bool)
        self._step, self._count = np.zeros((2, agents), dtype=np.int64)
        self._constants = np.zeros((agents, 4 + 6 * n), dtype=np.float32)

    def reset(self, *, staggered: bool = True) -> tuple[Observation, Observation]:
        """Restart all agents, ``staggered`` at different points of their episodes; returns both observations."""
        everyone = np.ones(self.agents, dtype=bool)
        self._new_arms(everyone)
        self._new_targets(everyone)
        if staggered:  # so that a batch holds all phases of a motion and not the same one everywhere
            self._step[:] = self._rng.integers(0, self.settings.hold_steps, self.agents)
            self._count[:] = self._rng.integers(0, self.settings.targets, self.agents)
        return self._observe(np.zeros(self.agents))

    def step(self, action: NDArray[np.floating]) -> Transition:
        """Run one control cycle with actions (N, n)."""
        s, inputs = self.settings, self._inputs()
        asked = np.asarray(action, dtype=float)
        applied = np.clip(asked, -1.0, 1.0)
        self.observer.acted(applied)
        wanted = self.commander.commands(inputs, self.observer.view, applied)
        self._sent = guard(self._limits, wanted, self._sent, self._no_speed, inputs.state, self._period).command
        self.simulation.send(self._sent)
        before = self.simulation.twins.qpos.copy()
        spread = self._rng.uniform(1.0 - s.jitter, 1.0 + s.jitter, self.agents)
        self._period = np.clip(self._middle * spread, s.min_period, s.max_period)
        self.simulation.advance(self._period)
        self._since = self._since + self._period
        tcp = tcp_position(self.arm, self.simulation.twins.qpos)
        speed = np.linalg.norm(tcp - self._tcp, axis=-1) / self._period
        self._tcp = tcp
        distance = np.linalg.norm(self._aim - tcp, axis=-1)
        self._step += 1
        final, final_privileged = self._observe(speed)
        late = self._step >= s.hold_steps
        reward, reached, collided = self.judge(asked, before, distance, speed, late)
        cut = (late | collided) & ~reached
        observation, privileged = final, final_privileged
        if (ended := reached | cut).any():
            self._count[ended] += 1
            exchanged = ended & ((self._count >= s.targets) | collided)  # they have had all
            if exchanged.any():
                self._new_arms(exchanged)
            self._new_targets(ended)
            observation, privileged = self._observe(np.where(ended, 0.0, speed))
        return Transition(observation, privileged, final, final_privileged, reward, reached, cut, collided, distance)

    def judge(
        self,
        action: Array,
        before: Array,  # noqa: ARG002 - for other tasks
        distance: Array,
        speed: Array,
        late: Mask,  # noqa: ARG002
    ) -> tuple[Array, Mask, Mask]:
        """Reward (N,) of a cycle, successes and collisions (N,) that end its episodes: here none.

        ``before`` (N, n) [rad] is the posture before it, ``late`` (N,) a time-out; else as `residual_reward`.
        """
        homing = (self.observer.view.homing**2).sum(axis=-1)
        none = np.zeros(self.agents, dtype=bool)
        return residual_reward(distance, speed, action) - POSTURE_WEIGHT * homing, none, none

    def _inputs(self) -> ControlInput:
        now, goal, target, moving = self.simulation, self._goal, self._aim, self._since < self._travel
        if moving.any():
            goal, target = goal.copy(), target.copy()
            left = 1.0 - self._since[moving] / self._travel[moving]
            goal[moving] += left[:, None] * (self._start[moving] - goal[moving])
            target[moving] += tcp_position(self.arm, goal[moving]) - tcp_position(self.arm, self._goal[moving])
        state = JointState(time=now.time, position=now.measured, age=np.zeros(self.agents))
        since = np.maximum(self._since - self._travel, 0.0)
        return ControlInput(state=state, target=target, goal=goal, sent=self._sent, since_target=since)

    def _new_targets(self, where: Mask) -> None:
        """Draw targets for the arms in ``where`` (N,): anywhere, or in the region near the posture of the last."""
        first, before = self._count[where] == 0, self._far[where]
        start = np.where(first[:, None], self._sent[where], self._goal[where])
        place = self.arm.targets.sample(self._rng, (len(start),))
        goal = solve_position(self.arm, place, np.where(before[:, None], self.arm.rest, start)).q
        far = np.zeros(len(start), dtype=bool)
        if self.settings.anywhere > 0.0:
            far = self._rng.random(len(start)) < self.settings.anywhere
            goal[far] = self._draw_postures(start[far], self._lifts[where][far])
            place[far] = tcp_position(self.arm, goal[far])
        way = np.abs(goal - start) / self.arm.max_speed
        self._start[where], self._goal[where], self._aim[where], self._far[where] = start, goal, place, far
        self._travel[where] = np.where(far | (before & ~first), way.max(axis=-1), 0.0)
        self._since[where] = 0.0
        self._step[where] = -np.ceil(self._travel[where] / self._middle[where])
        self.observer.reset(self._inputs(), where)
        self.commander.reset(self._inputs(), where)

    def _draw_postures(self, start: Array, lifts: Array) -> Array:
        """Draw a posture (m, n) [rad] for each arm: of `DRAWN` the first that suits, or the lightest.

        Its motors lift it, and the straight ways from ``start`` (m, n) [rad] and to rest are above the floor.
        """
        postures = comfortable_postures(self.arm)
        goal = postures[self._rng.integers(0, len(postures), (len(lifts), DRAWN))]
        loads, share = gravity_torque(self.arm, goal), np.linspace(0.0, 1.0, 9)[1:-1, None, None, None]
        # Joints with several turns take the short way: long ones cross the floor.
        near = goal - 2.0 * np.pi * np.round((goal - start[:, None]) / (2.0 * np.pi))
        goal = np.where((near >= self._limits.lower) & (near <= self._limits.upper), near, goal)
        excess = np.maximum(np.abs(loads) / lifts[:, None], 1.0).max(axis=-1)
        for end in (start[:, None], self.arm.rest):
            room = heights(self.arm, end + share * (goal - end))[..., 1:] - self._limits.floors
            excess += np.where((room < self.arm.floor).any(axis=(0, -1)), 100.0, 0.0)
        return goal[np.arange(len(lifts)), excess.argmin(axis=1)]

    def _new_arms(self, where: Mask) -> None:
        """Draw arms around rest, inside the guard's limits and above the floor; commands lead by part of the sag."""
        arm, s, limits, count = self.arm, self.settings, self._limits, int(where.sum())
        draw = self.ranges.draw(self._rng, count)
        position = arm.rest + self._rng.normal(0.0, s.start_spread, (count, arm.joints))
        position = np.clip(position, limits.lower, limits.upper)
        low = tcp_position(arm, position)[:, 2:] < 3.0 * arm.floor
        command = position = np.where(low, arm.rest, position)
        if s.start_sag:
            sag = draw.gravity_scale[:, None] * gravity_torque(arm, position) / draw.twin.stiffness - draw.twin.offset
            lead = np.clip(sag, -s.law.lead_limit, s.law.lead_limit)
            command = position + lead * self._rng.uniform(0.0, 1.0, (count, 1))
        self.simulation.place(draw, position, command, where)
        self._lifts[where] = lifting_torque(draw.twin) / draw.gravity_scale[:, None]
        self._sent[where] = command
        self._tcp[where] = tcp_position(arm, position)
        self._middle[where] = self._period[where] = draw.period
        self._count[where] = 0
        self._constants[where] = privileged_constants(arm, draw)
        self.observer.reset_learned(where)
        self.commander.reset_learned(self._inputs(), where)

    def _observe(self, speed: Array) -> tuple[Observation, Observation]:
        """Observation (N, size) and privileged observation (N, p); ``speed`` (N,) [m/s] of the TCP."""
        twins, distance = self.simulation.twins, np.linalg.norm(self._aim - self._tcp, axis=-1)
        lag = self.simulation.reference.position - twins.qpos
        scalars = (10.0 * distance, (np.log(distance + 0.0003) + 5.0) / 2.0, 3.0 * speed, 30.0 * self._period)
        joints = np.concatenate([0.5 * twins.qvel, 4.0 * lag], axis=-1).clip(-8.0, 8.0)
        moving = np.concatenate([np.stack(scalars, axis=-1), joints], axis=-1).astype(np.float32)
        return self.observer.observe(self._inputs()), np.concatenate([moving, self._constants], axis=1)


@value_type
class PpoSettings:
    """Settings of proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347)."""

    agents: int = 1024
    """arms at the same time; chosen"""
    rollout: int = 16
    """control cycles between updates"""
    iterations: int = 150
    """updates"""
    epochs: int = 3
    mini_batches: int = 13
    """per epoch; chosen"""
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-4
    """at the last iteration, linear"""
    clip: float = 0.2
    discount: float = 0.98
    gae_lambda: float = 0.95
    gradient_clip: float = 1.0
    reward_scale: float = 0.1
    """to scale returns to about one"""
    log_std: float = -0.7
    """initial log exploration noise"""
    log_std_ceiling: tuple[float, float] = (-0.4, -2.0)
    """its upper bound at the start, and at `rejoint.training.learner.CEILING_FALLS`: deployment has no noise"""
    critic_first: int = 0
    """first updates of the critic alone: an untrained one would spoil a good actor"""
    actor_layers: tuple[int, ...] = (128, 64)
    critic_layers: tuple[int, ...] = (128, 64)


@value_type
class Preset:
    """A recipe."""

    name: str
    make: type[ReachTask] = ReachTask
    """the task's own kind"""
    task: TaskSettings = field(default_factory=TaskSettings)
    ppo: PpoSettings = field(default_factory=PpoSettings)
    warm: PpoSettings | None = None
    """instead of ``ppo`` for a training from the generic policy; None: never"""


DEFAULT = read_shipped(__file__, "default.toml", Preset)

PRESETS = {preset.name: preset for preset in (DEFAULT, replace(DEFAULT, name="scratch", warm=None))}


def load_preset(preset: str | Preset) -> Preset:
    """Look up a preset by name; InputError names the alternatives."""
    if isinstance(preset, Preset):
        return preset
    if preset not in PRESETS:
        raise InputError(f"no preset is called {preset!r}; known presets: {', '.join(sorted(PRESETS))}")
    return PRESETS[preset]
