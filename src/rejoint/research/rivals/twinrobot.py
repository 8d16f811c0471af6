"""Randomised twins behind the interface of a robot, so that controllers are tuned on what the policy is trained on.

The motion of one cycle is that of `rejoint.training.task.ReachTask`; a test holds the two together bit for bit.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, tcp_position
from rejoint.control.robot import JointState, Mask
from rejoint.training.motion import SUBSTEPS, pass_period
from rejoint.training.play import Play
from rejoint.training.ranges import Draw
from rejoint.training.wire import Wire
from rejoint.twin.batch import TwinBatch


class TwinRobot:
    """One twin per drawn arm, in lockstep, each with its own period, delays and clock."""

    def __init__(
        self, arm: Arm, draw: Draw, *, seed: int, threads: int = 1, jitter: float = 0.2, copies: int = 1
    ) -> None:
        """Put the twins at rest in the rest posture, held there by the first command.

        ``copies``: the batch holds the same arms that many times over, with the same jitter.
        """
        count, n = len(draw.period), arm.joints
        self._arm, self._draw, self._jitter, self._copies = arm, draw, jitter, copies
        self._rng = np.random.default_rng(seed)
        self.twins = TwinBatch(arm, count, threads=threads)
        self.twins.write(draw.twin, gravity_scale=draw.gravity_scale)
        self.play = Play(arm, count)
        self.play.renew(draw, np.ones(count, dtype=bool))
        self.wire = Wire(count, n, SUBSTEPS)
        self.wire.command_delay[:], self.wire.readback_delay[:] = draw.command_delay, draw.readback_delay
        position = np.tile(arm.rest, (count, 1))
        held = draw.gravity_scale[:, None] * gravity_torque(arm, position) / draw.twin.stiffness - draw.twin.offset
        self.twins.restart(position)
        self.reference = position + held
        """(B, n) [rad] what the servos follow"""
        self.wire.clear(np.ones(count, dtype=bool), self.reference, position)
        self._time, self._measured = np.zeros(count), self._quantised(position)

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
        return len(self._time)

    def read(self) -> JointState:
        """Return the newest joint state."""
        return JointState(time=self._time.copy(), position=self._measured.copy(), age=np.zeros(self.count))

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad] and let one period pass; twins that are not ``active`` move on unseen."""
        news = np.ones(self.count, dtype=bool) if active is None else active
        self.wire.send(command, self._time)
        spread = self._rng.uniform(1.0 - self._jitter, 1.0 + self._jitter, self.count // self._copies)
        period = self._draw.period * np.tile(spread, self._copies)
        self.reference = pass_period(
            self.twins, self.play, self.wire, self.reference,
            ramp=self._draw.twin.ramp_speed, time=self._time, period=period,
        )  # fmt: skip
        self._time = self._time + period
        self._measured = np.where(news[:, None], self._quantised(self.wire.read(self._time)), self._measured)
        return self.read()

    def true_tcp(self) -> Array:
        """(B, 3) [m] of the twins' links; what play they have lies inside the loop, so the encoders see it."""
        return tcp_position(self._arm, self.twins.qpos)

    def stop(self) -> None:
        """Hold where they are; nobody reads twins that have stopped."""

    def close(self) -> None:
        """Nothing to release."""

    def _quantised(self, position: Array) -> Array:
        return np.round(position / self._arm.encoder_step) * self._arm.encoder_step
