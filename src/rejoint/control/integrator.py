"""The integrator: damped least squares on the last command, with anti-windup.

Each cycle the command moves by a fraction of the joint step that would bring the measured TCP to
the target. A soft servo needs its command ahead of the position; since the steps are added to the
last command, that lead builds up by itself until the TCP error is gone. The simplest law that a
learned policy has to beat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, clip_norm
from rejoint.control.controller import ControlInput
from rejoint.control.law import GAIN, dls_step, fade, limit_lead, limit_position, null_space
from rejoint.control.pace import NOMINAL_PERIOD, Pace
from rejoint.control.robot import Mask


@dataclass(frozen=True, kw_only=True)
class IntegratorGains:
    """Settings of the integrator; all chosen on simulated worn arms."""

    rate: float = GAIN / NOMINAL_PERIOD
    """[1/s] fraction of the step per second; twice as much oscillates where gears have play. A rate and not a
    fraction per cycle, because what limits it is the arm and not the wire"""
    lead: float = np.radians(15.0)
    """[rad] anti-windup: largest distance of the command from the measured position"""
    fade: float = 4e-3
    """[m] distance at which the steps have faded to half; at 1 mm worn arms hunt, above 5 mm all arms are slow"""
    rest_gain: float = 0.01
    """fraction of the way back to the rest posture per cycle, in the null space"""
    rest_step: float = np.radians(0.1)
    """[rad] largest step of that pull: about one encoder count, so that it never disturbs the TCP"""
    rest_distance: float = 0.01
    """[m] closer to the target nothing pulls, so that the arm comes to rest"""


class IntegratorController:
    """Integrates the TCP error into the command."""

    name = "integrator"
    heeds_turn = True

    def __init__(self, arm: Arm, gains: IntegratorGains | None = None) -> None:
        self._arm, self._gains, self._pace = arm, gains or IntegratorGains(), Pace()

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Do nothing: what is remembered is the last command, and it carries over."""

    def command(self, inputs: ControlInput) -> Array:
        """Return the last command, moved towards the target, (B, n) [rad]."""
        arm, gains, measured = self._arm, self._gains, inputs.state.position
        elapsed = self._pace.tick(inputs.state.time)[:, None]
        seen = dls_step(arm, measured, inputs.target, inputs.turn)
        step = gains.rate * elapsed * fade(seen.error, gains.fade) * seen.step
        pull = clip_norm(null_space(seen.jacobian, gains.rest_gain * (arm.rest - inputs.sent)), gains.rest_step)
        far = np.linalg.norm(seen.error, axis=-1, keepdims=True) > gains.rest_distance
        return limit_position(arm, limit_lead(inputs.sent + step + far * pull, measured, gains.lead))
