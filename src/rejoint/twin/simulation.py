"""The one simulation that training, tuning, replay and predictive control step.

Commands come late and are approached at limited speed or acceleration (`rejoint.twin.reference`), gears may have
backlash, dry friction follows the speed, positions are old when read. Many arms run in lockstep, each with its own
parameters, control period and clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Union

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, gravity_torque, tcp_position
from rejoint.control.robot import JointState, Mask
from rejoint.system.errors import InputError
from rejoint.twin.backlash import Backlash
from rejoint.twin.chain.batch import ChainBatch
from rejoint.twin.declaration import TIMESTEP
from rejoint.twin.friction import DRY, dry_friction, friction_terms, is_steady
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.reference import Latency, LiveReference

if TYPE_CHECKING:
    from rejoint.twin.batch import TwinBatch
    from rejoint.twin.table import TablePlane

Twins = Union["ChainBatch", "TwinBatch"]
"""Free arms, and arms that may touch a table"""

SUBSTEPS = 6
"""Physics steps in a control cycle: 3 to 9 ms each"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Draw:
    """N arms to simulate: everything in which one differs from another."""

    twin: TwinParameters
    """parameters with the leading shape (N,)"""
    command_delay: Array
    """(N,) [s] from sending a command to its arrival"""
    readback_delay: Array
    """(N,) [s] age of a measured position when it arrives"""
    stiction: Array
    """(N, n) friction of a joint at rest over that of a moving one"""
    acceleration: Array
    """(N,) [rad/s^2] of the servos' references while commands keep changing; inf: their speed is limited instead"""
    gravity_scale: Array
    """(N,) factor on gravity: unknown masses and payload"""
    period: Array
    """(N,) [s] middle of the control periods"""
    backlash: Array
    """(N, n) [rad] free motion of the gears inside the servo loop"""
    grease: Array
    """(N,) damping of a joint inside that backlash by that of its motor"""

    @staticmethod
    def of(twin: TwinParameters, stiction: Array | float = 1.0, acceleration: Array | float = np.inf) -> Draw:
        """Take twins (N,) as they are; the whole of their delay lies on the way out."""
        whole, joints = np.zeros(twin.shape), np.zeros(twin.stiffness_shape)
        return Draw(
            twin=twin, command_delay=twin.delay, readback_delay=whole, stiction=joints + stiction,
            acceleration=whole + acceleration, gravity_scale=whole + 1.0, period=whole, backlash=joints,
            grease=whole + 1.0,
        )  # fmt: skip

    def rows(self, index: NDArray[np.integer]) -> Draw:
        """Return some of the arms."""
        return Draw(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


class Simulation:
    """``count`` arms of one build; their state is live in ``twins``, their clocks are in ``time``."""

    def __init__(
        self, arm: Arm, count: int, *, timestep: float = TIMESTEP, threads: int = 1, table: bool = False,
        substeps: int = SUBSTEPS,
    ) -> None:  # fmt: skip
        n = arm.joints
        self.arm, self.substeps = arm, substeps
        make = _on_table if table else ChainBatch
        self.twins: Twins = make(arm, count, timestep, threads)
        self.latency = Latency(count, n, substeps)
        self.reference = LiveReference(count, n)
        self.backlash = Backlash(arm, count)
        self.time = np.zeros(count)
        """(N,) [s]"""
        self.measured = np.zeros((count, n))
        """(N, n) [rad] the newest positions that have been read, in encoder steps"""
        self._friction = np.ones((len(DRY) + 1, count, n))

    def place(self, draw: Draw, position: Array, command: Array, where: Mask | None = None) -> None:
        """Put the arms of ``draw`` (m,) in the places ``where`` (N,), everywhere by default, at time 0.

        They are at ``position`` (m, n) [rad]; ``command`` (m, n) [rad] has long been in force.
        """
        where = np.ones(len(self.time), dtype=bool) if where is None else where
        self.twins.write(draw.twin, where, gravity_scale=draw.gravity_scale)
        self.twins.restart(position, ids=where)
        self.latency.command_delay[where], self.latency.readback_delay[where] = draw.command_delay, draw.readback_delay
        self.latency.clear(where, command, position)
        self.reference.restart(where, command, speed=draw.twin.ramp_speed, acceleration=draw.acceleration)
        self.backlash.renew(draw.twin, draw.backlash, draw.grease, where)
        self._friction[:, where] = friction_terms(draw.twin, draw.stiction)
        self.time[where] = 0.0
        self.measured[where] = self._quantised(position)

    def put_tables(self, tables: Sequence[TablePlane]) -> None:
        """Put each arm of a simulation that was made with ``table`` on its own; after `place`."""
        if isinstance(self.twins, ChainBatch):
            raise InputError("simulation: made without a table, and cannot be put on one")
        self.twins.put_tables(tables)

    def send(self, command: Array) -> None:
        """Send ``command`` (N, n) [rad] now."""
        self.latency.send(command, self.time)

    def advance(self, period: Array, offset: Array | None = None) -> None:
        """Let ``period`` (N,) [s] pass, and read; ``offset`` (N, n) [rad] is added to the references."""
        step = period / self.substeps
        self.twins.set_timestep(step)
        starts = self.time[:, None] + step[:, None] * np.arange(self.substeps)
        references = self.reference.follow(self.latency, starts, step)
        passed = self.rollout(references if offset is None else references + offset[:, None])
        self.latency.record(starts + step[:, None], passed)
        self.time = self.time + period
        self.measured = self._quantised(self.latency.read(self.time))

    def rollout(self, reference: Array) -> Array:
        """Advance by the servos' ``reference`` (N, steps, n) [rad], one row a step; return positions of that shape."""
        if not self.backlash.present and isinstance(self.twins, ChainBatch):
            return self.twins.rollout(reference, self._friction)
        if is_steady(self._friction) and not self.backlash.present:
            return self.twins.rollout(reference)
        positions = np.empty_like(reference)
        for k in range(reference.shape[1]):
            self.twins.ctrl[:] = reference[:, k]
            friction = dry_friction(self._friction, self.twins.qvel)
            self.backlash.part(self.twins, self._friction, friction)
            self.twins.set_friction(friction)
            self.twins.step()
            positions[:, k] = self.twins.qpos
        return positions

    def state(self) -> dict[str, Array]:
        """Everything that a checkpoint must keep, as live arrays; of arms that touch no table."""
        twins = self.twins.state() if isinstance(self.twins, ChainBatch) else {}
        return {
            "time": self.time, "measured": self.measured, "friction": self._friction,
            **{f"latency.{name}": value for name, value in self.latency.state().items()},
            **{f"reference.{name}": value for name, value in self.reference.state().items()},
            **{f"backlash.{name}": value for name, value in self.backlash.state().items()},
            **{f"twins.{name}": value for name, value in twins.items()},
        }  # fmt: skip

    def _quantised(self, position: Array) -> Array:
        return np.round(position / self.arm.encoder_step) * self.arm.encoder_step


def _on_table(arm: Arm, count: int, timestep: float, threads: int) -> TwinBatch:
    from rejoint.twin.batch import TwinBatch  # late: free arms need no MuJoCo

    return TwinBatch(arm, count, timestep, threads, table=True)


class TwinRobot:
    """One twin per drawn arm, in lockstep, each with its own period, delays and clock."""

    def __init__(
        self, arm: Arm, draw: Draw, *, seed: int, jitter: float = 0.2, copies: int = 1,
        posture: Array | None = None, address: str = "twins",
    ) -> None:  # fmt: skip
        """Put the twins at rest in a ``posture`` (n,) [rad], by default that of rest, held by the first command.

        ``copies``: the batch holds the same arms that many times over, with the same jitter.
        """
        count = len(draw.period)
        self._arm, self._period, self._jitter, self._copies = arm, draw.period, jitter, copies
        self._rng, self._address = np.random.default_rng(seed), address
        self.simulation = Simulation(arm, count)
        position = np.tile(arm.rest if posture is None else posture, (count, 1))
        held = draw.gravity_scale[:, None] * gravity_torque(arm, position) / draw.twin.stiffness - draw.twin.offset
        self.simulation.place(draw, position, position + held)

    @property
    def arm(self) -> Arm:
        """The arm's kinematics, limits and masses."""
        return self._arm

    @property
    def address(self) -> str:
        """What it is."""
        return self._address

    @property
    def count(self) -> int:
        """Number B of twins."""
        return len(self._period)

    def read(self) -> JointState:
        """Return the newest joint state."""
        now = self.simulation
        return JointState(time=now.time.copy(), position=now.measured.copy(), age=np.zeros(self.count))

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad] and let one period pass; twins that are not ``active`` are not read."""
        simulation, before = self.simulation, self.simulation.measured
        simulation.send(command)
        spread = self._rng.uniform(1.0 - self._jitter, 1.0 + self._jitter, self.count // self._copies)
        simulation.advance(self._period * np.tile(spread, self._copies))
        if active is not None:
            simulation.measured = np.where(active[:, None], simulation.measured, before)
        return self.read()

    def true_tcp(self) -> Array:
        """(B, 3) [m] of the twins' links: encoders see all their backlash."""
        return tcp_position(self._arm, self.simulation.twins.qpos)

    def stop(self) -> None:
        """Hold where they are; twins that have stopped are not read."""

    def close(self) -> None:
        """Nothing to release."""
