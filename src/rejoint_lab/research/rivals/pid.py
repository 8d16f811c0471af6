"""The paper's PID: Park et al. 2024, equations 26 and 27.

``theta_{t+1} = theta_t + Kp e_t + Ki sum(e) [dt] + Kd (e_t - e_{t-1}) / dt``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.robot import ControlInput, Controller, Mask


@dataclass(frozen=True, kw_only=True)
class PidGains:
    """Gains of Park et al. 2024, below equation 27."""

    proportional: float = 0.40
    integral: float = 0.01
    """per cycle as a plain sum; per second times ``period``"""
    derivative: float = 5e-3
    """[s]"""
    period: float = 0.02
    """[s] dt of the equation"""
    integral_times_period: bool
    """True: as printed"""


class PidController:
    """Adds a PID correction to the measured position."""

    heeds_turn = True

    def __init__(self, arm: Arm, gains: PidGains) -> None:
        self._gains = gains
        self._sum: Array = np.zeros((0, arm.joints))
        self._last: Array = np.zeros((0, arm.joints))

    @property
    def name(self) -> str:
        """Name with the kind of integral."""
        return "pid-literal" if self._gains.integral_times_period else "pid-sum"

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Clear the integral of ``where`` (B,)."""
        if len(self._sum) != len(inputs.sent):
            self._sum, self._last = np.zeros_like(inputs.sent), np.zeros_like(inputs.sent)
        self._sum[where] = 0.0
        # The change of the error at a new target is the target's jump, not a motion of the arm.
        self._last[where] = inputs.goal[where] - inputs.state.position[where]

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        gains, measured = self._gains, inputs.state.position
        error = inputs.goal - measured
        self._sum += error * (gains.period if gains.integral_times_period else 1.0)
        change = (error - self._last) / gains.period
        self._last = error
        return measured + gains.proportional * error + gains.integral * self._sum + gains.derivative * change


PIDS: dict[str, Callable[[Arm], Controller]] = {
    "pid-sum": lambda arm: PidController(arm, PidGains(integral_times_period=False)),
    "pid-literal": lambda arm: PidController(arm, PidGains(integral_times_period=True)),
}
