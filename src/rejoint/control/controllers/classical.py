"""Classical controllers: integrator, and the arm's default (one posture per target, open loop).

Default: Park et al. 2024, section IV-F.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, clip_norm
from rejoint.control.controllers.law import (
    GAIN,
    NOMINAL_PERIOD,
    Pace,
    dls_step,
    fade,
    limit_lead,
    limit_position,
    null_space,
)
from rejoint.control.robot import ControlInput, Mask

# Chosen on simulated worn arms:
RATE = GAIN / NOMINAL_PERIOD
"""[1/s] share of the step; twice as much oscillates in play"""
LEAD = np.radians(15.0)
"""[rad] largest following error (anti-windup)"""
FADE = 4e-3
"""[m] error at which the steps fade to half"""
REST_GAIN, REST_STEP, REST_DISTANCE = 0.01, np.radians(0.1), 0.01
"""Pull to rest per cycle, in the null space; its largest step [rad], an encoder count; [m] from the target, below which
there is none"""


class IntegratorController:
    """Adds shares of the damped least-squares step to the last command, with anti-windup."""

    name = "integrator"
    heeds_turn = True

    def __init__(self, arm: Arm) -> None:
        self._arm, self._pace = arm, Pace()
        self._goal: Array = np.zeros((0, arm.joints))

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Store the goals of ``where`` (B,)."""
        if len(self._goal) != len(inputs.goal):
            self._goal = inputs.goal.copy()
        self._goal[where] = inputs.goal[where]

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        arm, measured = self._arm, inputs.state.position
        elapsed = self._pace.tick(inputs.state.time)[:, None]
        seen = dls_step(arm, measured, inputs.target, inputs.turn)
        step = RATE * elapsed * fade(seen.error, FADE) * seen.step
        pull = clip_norm(null_space(seen.jacobian, REST_GAIN * (inputs.goal - inputs.sent)), REST_STEP)
        far = np.linalg.norm(seen.error, axis=-1, keepdims=True) > REST_DISTANCE
        along = inputs.goal - self._goal if len(self._goal) == len(inputs.goal) else 0.0  # on the way the goal moves
        self._goal = inputs.goal.copy()
        return limit_position(arm, limit_lead(inputs.sent + along + step + far * pull, measured, LEAD))


class DefaultController:
    """Open loop."""

    name = "default"
    heeds_turn = True

    def __init__(self, arm: Arm) -> None:
        self._arm = arm

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Do nothing."""

    def command(self, inputs: ControlInput) -> Array:
        """Goal postures (B, n) [rad]."""
        return inputs.goal.copy()
