"""Adaptive regulation of an arm whose servos and load are unknown.

Tomei, "Adaptive PD controller for robot manipulators", IEEE Trans. Robotics and Automation 7(4), 1991: a PD law
around the goal plus a gravity compensation that is linear in unknown parameters, Y(q) p, whose estimates follow
``dp/dt = G Y' (2 e / (1 + 2 e'e) - m v)`` with the joint error e and speed v. The arm's own servo is the PD law
here, and it takes positions, so the compensation is divided by its stiffness and enters as an offset
of the command: per joint ``load / k + mass * lever / k + offset``, which is linear in 1/k, mass/k and the offset.
The regressor is taken at the goal, as in Tomei's regulation with desired gravity (his remark 2; Kelly 1997), and
the adaptation has a dead zone (Peterson and Narendra, IEEE Trans. Automatic Control 27(3), 1982), without which
stiction makes the estimates drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, position_kinematics
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.size import torque_size
from rejoint.control.controller import ControlInput
from rejoint.control.feedforward import NOMINAL_STIFFNESS
from rejoint.control.goal import Goal
from rejoint.control.law import limit_position
from rejoint.control.pace import Pace
from rejoint.control.robot import Mask
from rejoint.research.rivals.scheduled import Gain, JointSpeed

_UNIT_MASS = 0.1  # [kg] scale of the unknown load (chosen: brings its regressor to the size of the arm's own)


@dataclass(frozen=True, kw_only=True, eq=False)
class AdaptiveGains:
    """Settings; each a number or (B, 1)."""

    softness_rate: Gain
    """[1/(s rad)] adaptation of the servo's inverse stiffness, by its nominal value"""
    load_rate: Gain
    """[1/(s rad)] adaptation of the unknown load"""
    offset_rate: Gain
    """[1/s] adaptation of the offset"""
    scale: Gain
    """[rad] error from which the adaptation saturates"""
    damping: Gain
    """[s] weight of the joint speed against the error"""
    dead_zone: Gain
    """[rad] errors below this do not adapt"""
    proportional: Gain
    """further gain on the joint error, beside the servo's own"""
    derivative: Gain
    """[s] further gain on the joint speed"""
    prior: Gain
    """[1] initial softness by that of nominal servos"""


class AdaptiveController:
    """Tomei's law for servos that take positions."""

    def __init__(self, arm: Arm, name: str, gains: AdaptiveGains) -> None:
        self._arm, self._name, self._gains = arm, name, gains
        self._goal, self._pace, self._speed = Goal(arm), Pace(), JointSpeed()
        self._stiffness = NOMINAL_STIFFNESS * torque_size(arm)
        self._regressor = self._estimate = np.zeros((3, 0, arm.joints))

    @property
    def name(self) -> str:
        """Name in tables."""
        return self._name

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Solve for new targets in ``where`` (B,); the estimates stay."""
        count, n = inputs.sent.shape
        if self._estimate.shape[1] != count:
            self._estimate, self._regressor = np.zeros((2, 3, count, n))
            self._estimate[0] = self._gains.prior
        self._goal.reset(inputs, where)
        goal = self._goal.position[where]
        lever = position_kinematics(self._arm, goal)[1][..., 2, :]
        self._regressor[0][where] = gravity_torque(self._arm, goal) / self._stiffness
        self._regressor[1][where] = _UNIT_MASS * -GRAVITY[2] * lever / self._stiffness
        self._regressor[2][where] = 1.0

    def command(self, inputs: ControlInput) -> Array:
        """Return the goal posture with its compensation, (B, n) [rad]."""
        gains, measured = self._gains, inputs.state.position
        elapsed = self._pace.tick(inputs.state.time)[:, None]
        speed = self._speed.observe(measured, elapsed)
        error = self._goal.position - measured
        outside = np.sign(error) * np.maximum(np.abs(error) - gains.dead_zone, 0.0)
        size = np.linalg.norm(error / gains.scale, axis=-1, keepdims=True)
        drive = outside / (1.0 + size**2) - gains.damping * speed * (np.abs(outside) > 0.0)
        rates = (gains.softness_rate, gains.load_rate, gains.offset_rate)
        for estimate, regressor, rate in zip(self._estimate, self._regressor, rates, strict=True):
            estimate += elapsed * rate * regressor * drive
        raised = self._goal.position + (self._estimate * self._regressor).sum(axis=0)
        return limit_position(self._arm, raised + gains.proportional * error - gains.derivative * speed)
