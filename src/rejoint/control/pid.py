"""PID in joint space, equations 26 and 27 of Park et al. 2024, in both readings of the integral.

``theta_{t+1} = theta_t + Kp e_t + Ki sum(e) [dt] + Kd (e_t - e_{t-1}) / dt``, where theta_t is the
measured position and e the joint goal (inverse kinematics of the target) minus it. Printed, the sum
is multiplied by dt; on a servo whose torque grows with command minus position this reading can
hardly do more than the default, whereas the plain sum gives results like the printed ones. Both
exist and carry their reading in the name.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.controller import ControlInput
from rejoint.control.goal import Goal
from rejoint.control.robot import Mask


@dataclass(frozen=True, kw_only=True)
class PidGains:
    """Gains of Park et al. 2024, below equation 27."""

    proportional: float = 0.40
    integral: float = 0.01
    """per control cycle as a plain sum, or per second when multiplied by ``period``"""
    derivative: float = 5e-3
    """[s]"""
    period: float = 0.02
    """[s] dt of the equation, a constant there even though the real period varies"""
    integral_times_period: bool
    """True: the equation as printed; False: the integral as a plain sum"""


class PidController:
    """Adds a PID correction of the joint error to the measured position."""

    heeds_turn = True

    def __init__(self, arm: Arm, gains: PidGains) -> None:
        self._goal, self._gains = Goal(arm), gains
        self._sum: Array = np.zeros((0, arm.joints))
        self._last: Array = np.zeros((0, arm.joints))

    @property
    def name(self) -> str:
        """Name with the reading of the integral."""
        return "pid-literal" if self._gains.integral_times_period else "pid-sum"

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Solve for the new targets and forget the integral, for the arms in ``where`` (B,)."""
        self._goal.reset(inputs, where)
        if len(self._sum) != len(inputs.sent):
            self._sum, self._last = np.zeros_like(inputs.sent), np.zeros_like(inputs.sent)
        self._sum[where] = 0.0
        # The change of the error at a new target is the target's jump, not a motion of the arm.
        self._last[where] = self._goal.position[where] - inputs.state.position[where]

    def command(self, inputs: ControlInput) -> Array:
        """Return the measured positions plus the correction, (B, n) [rad]."""
        gains, measured = self._gains, inputs.state.position
        error = self._goal.position - measured
        self._sum += error * (gains.period if gains.integral_times_period else 1.0)
        change = (error - self._last) / gains.period
        self._last = error
        return measured + gains.proportional * error + gains.integral * self._sum + gains.derivative * change
