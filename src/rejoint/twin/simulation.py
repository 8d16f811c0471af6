"""The simulation behind training, tuning and predictive control, and many free twins in lockstep below it.

It adds late and limited commands (`rejoint.control.servoreference`), backlash and delayed readings.
Each arm has its own clock.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from rejoint.arms import Arm, Array, Index, Mask, gravity_torque, link_inertia, tcp_position
from rejoint.arms.inertia import inertia_values
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import between_directions, turned
from rejoint.arms.workspace import unloaded_joints
from rejoint.control.robot import JointState
from rejoint.control.servoreference import Latency, LiveReference
from rejoint.system.records import entity, taken
from rejoint.twin.parameters import DRY, TIMESTEP, TwinParameters, back_emf, friction_terms
from rejoint.twin.step import GAIN, GROUP, TERMS, advance, workspace

ALL = slice(None)

ROWS = ("stiffness", "offset", "torque_limit", "damping", "armature")
"""Rows of parameters for `rejoint.twin.step`, before the share of the damping within the limit"""


@entity
class Draw:
    """All differences of N simulated arms."""

    twin: TwinParameters
    """leading shape (N,)"""
    command_delay: Array
    """(N,) [s] until a command arrives"""
    readback_delay: Array
    """(N,) [s] age of a reading"""
    acceleration: Array
    """(N,) [rad/s^2] of references while commands change; inf: limited speed instead"""
    gravity_scale: Array
    """(N,) for unknown masses and payload"""
    period: Array
    """(N,) [s] mean control period"""
    backlash: Array
    """(N, n) [rad] inside the servo loop"""
    grease: Array
    """(N,) damping in the backlash, relative to the motor's"""

    @staticmethod
    def of(twin: TwinParameters, acceleration: Array | float = np.inf) -> Draw:
        """Take twins (N,), with all delay before the servo."""
        whole, joints = np.zeros(twin.shape), np.zeros(twin.stiffness.shape)
        return Draw(
            twin=twin,
            command_delay=twin.delay,
            readback_delay=whole,
            acceleration=whole + acceleration,
            gravity_scale=whole + 1.0,
            period=whole,
            backlash=joints,
            grease=whole + 1.0,
        )

    def rows(self, index: Index) -> Draw:
        """Return some of the arms."""
        return taken(self, vars(self), index)


class ChainBatch:
    """``nsim`` simulations of one arm; ``qpos`` and ``qvel`` (nsim, n) are live."""

    def __init__(self, arm: Arm, nsim: int, timestep: float = TIMESTEP, threads: int = 1) -> None:
        self.arm = arm
        shape = (nsim, arm.joints)
        self.qpos, self.qvel = np.zeros((2, *shape))
        self.timestep = np.full(nsim, timestep)
        """(nsim,) [s]"""
        self._links = chain_links(arm)
        self._impulse, self._motors = np.zeros(shape), np.zeros((TERMS + len(DRY), *shape))
        self._gravity, self._carried = np.zeros((nsim, 3)), link_inertia(arm, arm.rest)
        self._gear = np.zeros((5, *shape))
        """half of the backlash, place of the motor, its speed, flank, and grease, see `cross` of the step"""
        groups = -(-nsim // GROUP)
        bounds = np.linspace(0, groups, min(threads, groups) + 1).astype(int) * GROUP
        self._parts = [(first, min(last, nsim), workspace(arm.joints)) for first, last in pairwise(bounds)]
        self._each = ThreadPoolExecutor(len(self._parts)).map if len(self._parts) > 1 else map

    def write(self, draw: Draw, ids: Mask | slice = ALL) -> None:
        """Set servos, friction, gravity and backlash of the simulations ``ids`` (a mask or slice); they go on moving.

        Motors are put in the middle of the backlash; joints have it where no load presses them to a flank.
        """
        parameters, half = draw.twin, 0.5 * draw.backlash * unloaded_joints(self.arm)
        for row, name in enumerate(ROWS):
            self._motors[row, ids] = getattr(parameters, name)
        self._motors[GAIN, ids] = parameters.damping - back_emf(self.arm, parameters)
        self._motors[TERMS:, ids] = friction_terms(parameters)
        self._gravity[ids] = np.multiply.outer(draw.gravity_scale, GRAVITY)
        still, flank = np.zeros_like(half), np.where(half > 0.0, 0.0, 1.0)
        self._gear[:, ids] = np.stack([half, still, still, flank, still + draw.grease[:, None]])

    def rollout(self, control: Array) -> Array:
        """Advance by ``control`` (nsim, steps, n) [rad]; return such positions."""
        path = np.empty_like(control)
        control = np.ascontiguousarray(control)
        state = self.qpos, self.qvel, self._impulse
        gears = (self._gear, self._carried, bool(self._gear[0].any()))
        arrays = (self._links, self._motors, gears, (self._gravity, self.timestep), control, state, path)
        list(self._each(lambda part: advance(*arrays, part), self._parts))
        return path

    def restart(self, position: Array, velocity: Array | float = 0.0, ids: Mask | slice = ALL) -> None:
        """Restart at ``position`` (m, n) [rad] with ``velocity`` [rad/s], without friction impulses."""
        self.qpos[ids] = position
        self.qvel[ids], self._impulse[ids] = velocity, 0.0


def chain_links(arm: Arm) -> Array:
    """(n, LINK) the constants of each link, see `rejoint.twin.step`: in frames with the joint as z axis."""
    rows, before = [], np.eye(3)
    for j, after in enumerate(turned(between_directions(np.eye(3)[2], arm.axis))):
        place, com, mass = before.T @ arm.offset[j, :3, 3], after.T @ arm.com[j], arm.mass[j]
        inertia = after.T @ arm.inertia[j] @ after + mass * (com @ com * np.eye(3) - np.outer(com, com))
        rotation, carried = before.T @ arm.offset[j, :3, :3] @ after, arm.mass[j:].sum()
        rows.append([*rotation.T.flat, *place, mass, *(mass * com), *inertia_values(inertia), carried])
        before = after
    return np.array(rows)


SUBSTEPS = 6
"""Physics steps per control cycle: 3 to 9 ms each"""


class Simulation:
    """``count`` arms of one build, with live ``twins`` and ``time``."""

    def __init__(self, arm: Arm, count: int, *, substeps: int = SUBSTEPS) -> None:
        n = arm.joints
        self.arm, self.substeps = arm, substeps
        self.twins = ChainBatch(arm, count)
        self.latency = Latency(count, n, substeps)
        self.reference = LiveReference(count, n)
        self.time = np.zeros(count)
        """(N,) [s]"""
        self.measured = np.zeros((count, n))
        """(N, n) [rad] newest readings, in encoder steps"""
        self.feed = np.zeros((count, n))
        """(N, n) [rad/(N m)] fed forward per torque of gravity"""

    def place(self, draw: Draw, position: Array, command: Array, where: Mask | slice = ALL) -> None:
        """Put the arms of ``draw`` (m,) in ``where`` (N,), default: all, at time 0.

        At ``position`` with constant ``command`` (m, n) [rad].
        """
        self.twins.write(draw, where)
        self.twins.restart(position, ids=where)
        self.latency.command_delay[where], self.latency.readback_delay[where] = draw.command_delay, draw.readback_delay
        self.latency.clear(where, command, position)
        self.reference.restart(where, command, speed=draw.twin.ramp_speed, acceleration=draw.acceleration)
        self.feed[where] = draw.twin.compensation / draw.twin.stiffness
        self.time[where] = 0.0
        self.measured[where] = self._quantised(position)

    def send(self, command: Array) -> None:
        """Send ``command`` (N, n) [rad]."""
        self.latency.send(command, self.time)

    def advance(self, period: Array, offset: Array | None = None) -> None:
        """Advance by ``period`` (N,) [s] and read; ``offset`` (N, n) [rad] shifts references."""
        step = period / self.substeps
        self.twins.timestep[:] = step
        starts = self.time[:, None] + step[:, None] * np.arange(self.substeps)
        references = self.reference.follow(self.latency, starts, step)
        fed = self.feed.any(axis=1)
        references[fed] += self.feed[fed, None] * gravity_torque(self.arm, references[fed])
        passed = self.twins.rollout(references if offset is None else references + offset[:, None])
        self.latency.record(starts + step[:, None], passed)
        self.time = self.time + period
        self.measured = self._quantised(self.latency.read(self.time))

    def _quantised(self, position: Array) -> Array:
        return np.round(position / self.arm.encoder_step) * self.arm.encoder_step


class TwinRobot:
    """One twin per drawn arm, in lockstep."""

    def __init__(
        self,
        arm: Arm,
        draw: Draw,
        *,
        seed: int,
        jitter: float = 0.2,
        copies: int = 1,
        posture: Array | None = None,
        address: str = "twins",
    ) -> None:
        """Put the twins at rest in a ``posture`` (n,) [rad], default: that of rest.

        ``copies``: repeats of all arms, with the same jitter.
        """
        self.arm, self.address, self.count = arm, address, len(draw.period)
        self._period, self._jitter, self._copies, self._rng = draw.period, jitter, copies, np.random.default_rng(seed)
        self.simulation = Simulation(arm, self.count)
        position = (arm.rest if posture is None else posture)[None]
        held = gravity_torque(arm, position) / draw.twin.stiffness
        held = (draw.gravity_scale[:, None] - draw.twin.compensation) * held - draw.twin.offset
        self.simulation.place(draw, position, position + held)

    def read(self) -> JointState:
        """Newest joint state."""
        now = self.simulation
        return JointState(time=now.time.copy(), position=now.measured.copy(), age=np.zeros(self.count))

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad], advance one period; read only ``active`` twins."""
        simulation, before = self.simulation, self.simulation.measured
        simulation.send(command)
        spread = self._rng.uniform(1.0 - self._jitter, 1.0 + self._jitter, self.count // self._copies)
        simulation.advance(self._period * np.tile(spread, self._copies))
        if active is not None:
            simulation.measured = np.where(active[:, None], simulation.measured, before)
        return self.read()

    def true_tcp(self) -> Array:
        """(B, 3) [m] of the twins' links, without backlash."""
        return tcp_position(self.arm, self.simulation.twins.qpos)

    def stop(self) -> None:
        """Hold position."""

    def close(self) -> None:
        """Nothing to release."""
