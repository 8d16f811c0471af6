"""Classical controllers: integrator, PID, and the arm's default (one posture per target, open loop).

PID: Park et al. 2024, equations 26 and 27,
``theta_{t+1} = theta_t + Kp e_t + Ki sum(e) [dt] + Kd (e_t - e_{t-1}) / dt``. Default: section IV-F.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, clip_norm
from rejoint.control.controller import ControlInput
from rejoint.control.law import GAIN, NOMINAL_PERIOD, Pace, dls_step, fade, limit_lead, limit_position, null_space
from rejoint.control.robot import Mask


@dataclass(frozen=True, kw_only=True)
class IntegratorGains:
    """Settings; chosen on simulated worn arms."""

    rate: float = GAIN / NOMINAL_PERIOD
    """[1/s] share of the step; twice as much oscillates in play"""
    lead: float = np.radians(15.0)
    """[rad] largest following error (anti-windup)"""
    fade: float = 4e-3
    """[m] error at which the steps fade to half"""
    rest_gain: float = 0.01
    """per cycle, in the null space"""
    rest_step: float = np.radians(0.1)
    """[rad] largest step of that pull: an encoder count"""
    rest_distance: float = 0.01
    """[m] from the target, below which there is no pull"""


class IntegratorController:
    """Adds shares of the damped least-squares step to the last command, with anti-windup."""

    name = "integrator"
    heeds_turn = True

    def __init__(self, arm: Arm, gains: IntegratorGains | None = None) -> None:
        self._arm, self._gains, self._pace = arm, gains or IntegratorGains(), Pace()
        self._goal: Array = np.zeros((0, arm.joints))

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Store the goals of ``where`` (B,)."""
        if len(self._goal) != len(inputs.goal):
            self._goal = inputs.goal.copy()
        self._goal[where] = inputs.goal[where]

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        arm, gains, measured = self._arm, self._gains, inputs.state.position
        elapsed = self._pace.tick(inputs.state.time)[:, None]
        seen = dls_step(arm, measured, inputs.target, inputs.turn)
        step = gains.rate * elapsed * fade(seen.error, gains.fade) * seen.step
        pull = clip_norm(null_space(seen.jacobian, gains.rest_gain * (inputs.goal - inputs.sent)), gains.rest_step)
        far = np.linalg.norm(seen.error, axis=-1, keepdims=True) > gains.rest_distance
        along = inputs.goal - self._goal if len(self._goal) == len(inputs.goal) else 0.0  # on the way the goal moves
        self._goal = inputs.goal.copy()
        return limit_position(arm, limit_lead(inputs.sent + along + step + far * pull, measured, gains.lead))


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
