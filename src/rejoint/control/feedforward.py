"""Model-based control: inverse kinematics, gravity feed-forward, and the integrator for the rest.

A servo of stiffness k sags by gravity torque / k, so the command is raised by that much beforehand.
What the model gets wrong the integrator removes and remembers: its correction carries over to the
next target.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.control.controller import Situation
from rejoint.control.goal import Goal
from rejoint.control.integrator import IntegratorGains
from rejoint.control.law import dls_step, limit_position
from rejoint.control.robot import Mask
from rejoint.errors import InputError

NOMINAL_STIFFNESS = 6.0
"""[N m/rad] assumed where nothing is known of a worn servo (chosen: middle of the 3 to 12 of the twins trained on)."""


class FeedforwardController:
    """Sends the posture that a sagging arm needs, then integrates what is left."""

    name = "feedforward"

    def __init__(
        self,
        arm: Arm,
        stiffness: Array | float = NOMINAL_STIFFNESS,
        gains: IntegratorGains = IntegratorGains(),  # noqa: B008
    ) -> None:
        self._arm, self._gains, self._goal = arm, gains, Goal(arm)
        self._stiffness = np.broadcast_to(np.asarray(stiffness, dtype=float), (arm.joints,)).copy()
        if not (self._stiffness > 0.0).all():
            raise InputError(f"feedforward: stiffness must be positive in N m/rad, got {self._stiffness.tolist()}")
        self._correction: Array = np.zeros((0, arm.joints))

    def reset(self, situation: Situation, where: Mask) -> None:
        """Solve for the new targets of the arms in ``where`` (B,); what was learned carries over."""
        self._goal.reset(situation, where)
        if len(self._correction) != len(situation.sent):
            self._correction = np.zeros_like(situation.sent)

    def command(self, situation: Situation) -> Array:
        """Return the raised goal postures plus the correction, (B, n) [rad]."""
        arm, gains, goal = self._arm, self._gains, self._goal.position
        raised = goal + gravity_torque(arm, goal) / self._stiffness
        seen = dls_step(arm, situation.state.position, situation.target)
        # Bounded by itself: on the way to the goal the command leads by the whole distance.
        self._correction = np.clip(self._correction + gains.gain * seen.step, -gains.lead, gains.lead)
        return limit_position(arm, raised + self._correction)
