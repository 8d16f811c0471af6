"""Adaptive regulation of an arm with unknown servos and load.

Tomei, IEEE Trans. Robotics and Automation 7(4), 1991: PD plus gravity compensation Y(q) p with ``dp/dt = G Y' (2 e / (1
+ 2 e'e) - m v)``. The servo is the PD law, so the command gets ``load / k + mass * lever / k + offset``. Dead zone:
Peterson and Narendra, IEEE Trans. Automatic Control 27(3), 1982.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, position_kinematics
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.workspace import torque_size
from rejoint.control.controller import ControlInput
from rejoint.control.feedforward import NOMINAL_STIFFNESS
from rejoint.control.law import Pace, limit_position
from rejoint.control.robot import Mask
from rejoint_lab.research.rivals.scheduled import Gain, JointSpeed

_UNIT_MASS = 0.1  # [kg] scale of the unknown load (chosen: brings its regressor to the size of the arm's own)


@dataclass(frozen=True, kw_only=True, eq=False)
class AdaptiveGains:
    """Settings; each a number or (B, 1)."""

    softness_rate: Gain
    """[1/(s rad)] adaptation of the relative inverse stiffness"""
    load_rate: Gain
    """[1/(s rad)] adaptation of the load"""
    offset_rate: Gain
    """[1/s] adaptation of the offset"""
    scale: Gain
    """[rad] error of saturation"""
    damping: Gain
    """[s] weight of the joint speed"""
    dead_zone: Gain
    """[rad]"""
    proportional: Gain
    """beside the servo's own"""
    derivative: Gain
    """[s] of the joint speed"""
    prior: Gain
    """[1] initial relative softness"""


class AdaptiveController:
    """Tomei's law for position servos."""

    def __init__(self, arm: Arm, name: str, gains: AdaptiveGains) -> None:
        self._arm, self._name, self._gains = arm, name, gains
        self._pace, self._speed = Pace(), JointSpeed()
        self._stiffness = NOMINAL_STIFFNESS * torque_size(arm)
        self._regressor = self._estimate = np.zeros((3, 0, arm.joints))

    @property
    def name(self) -> str:
        """Name in tables."""
        return self._name

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Take new goals in ``where`` (B,); the estimates stay."""
        count, n = inputs.sent.shape
        if self._estimate.shape[1] != count:
            self._estimate, self._regressor = np.zeros((2, 3, count, n))
            self._estimate[0] = self._gains.prior
        goal = inputs.goal[where]
        lever = position_kinematics(self._arm, goal)[1][..., 2, :]
        self._regressor[0][where] = gravity_torque(self._arm, goal) / self._stiffness
        self._regressor[1][where] = _UNIT_MASS * -GRAVITY[2] * lever / self._stiffness
        self._regressor[2][where] = 1.0

    def command(self, inputs: ControlInput) -> Array:
        """Goal posture with its compensation, (B, n) [rad]."""
        gains, measured = self._gains, inputs.state.position
        elapsed = self._pace.tick(inputs.state.time)[:, None]
        speed = self._speed.observe(measured, elapsed)
        error = inputs.goal - measured
        outside = np.sign(error) * np.maximum(np.abs(error) - gains.dead_zone, 0.0)
        size = np.linalg.norm(error / gains.scale, axis=-1, keepdims=True)
        drive = outside / (1.0 + size**2) - gains.damping * speed * (np.abs(outside) > 0.0)
        rates = (gains.softness_rate, gains.load_rate, gains.offset_rate)
        for estimate, regressor, rate in zip(self._estimate, self._regressor, rates, strict=True):
            estimate += elapsed * rate * regressor * drive
        raised = inputs.goal + (self._estimate * self._regressor).sum(axis=0)
        return limit_position(self._arm, raised + gains.proportional * error - gains.derivative * speed)
