"""Simulated twins behind the interface of a robot, so that controllers are tuned on what the policy is trained on."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, tcp_position
from rejoint.control.robot import JointState, Mask
from rejoint.twin.simulation import Draw, Simulation


class TwinRobot:
    """One twin per drawn arm, in lockstep, each with its own period, delays and clock."""

    def __init__(
        self, arm: Arm, draw: Draw, *, seed: int, threads: int = 1, jitter: float = 0.2, copies: int = 1
    ) -> None:
        """Put the twins at rest in the rest posture, held there by the first command.

        ``copies``: the batch holds the same arms that many times over, with the same jitter.
        """
        count = len(draw.period)
        self._arm, self._period, self._jitter, self._copies = arm, draw.period, jitter, copies
        self._rng = np.random.default_rng(seed)
        self.simulation = Simulation(arm, count, threads=threads)
        position = np.tile(arm.rest, (count, 1))
        held = draw.gravity_scale[:, None] * gravity_torque(arm, position) / draw.twin.stiffness - draw.twin.offset
        self.simulation.place(draw, position, position + held)

    @property
    def arm(self) -> Arm:
        """The arm's kinematics, limits and masses."""
        return self._arm

    @property
    def address(self) -> str:
        """What it is."""
        return "twins"

    @property
    def count(self) -> int:
        """Number B of twins."""
        return len(self._period)

    def read(self) -> JointState:
        """Return the newest joint state."""
        now = self.simulation
        return JointState(time=now.time.copy(), position=now.measured.copy(), age=np.zeros(self.count))

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad] and let one period pass; twins that are not ``active`` move on unseen."""
        simulation, before = self.simulation, self.simulation.measured
        simulation.send(command)
        spread = self._rng.uniform(1.0 - self._jitter, 1.0 + self._jitter, self.count // self._copies)
        simulation.advance(self._period * np.tile(spread, self._copies))
        if active is not None:
            simulation.measured = np.where(active[:, None], simulation.measured, before)
        return self.read()

    def true_tcp(self) -> Array:
        """(B, 3) [m] of the twins' links; what backlash they have is inside the loop, so the encoders see it."""
        return tcp_position(self._arm, self.simulation.twins.qpos)

    def stop(self) -> None:
        """Hold where they are; nobody reads twins that have stopped."""

    def close(self) -> None:
        """Nothing to release."""
