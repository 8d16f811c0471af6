"""The command law of a learned policy: a classical step plus a bounded correction.

Park et al. 2024, equation 17: next command = position + damped least-squares step + action. Read
literally (``anchor`` measured) the position is the measured one; a worn servo then forgets each
cycle what it took to hold the arm up. Read with the last sent command (``anchor`` sent) the law
integrates, which is what removes the sag.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rejoint.arms import Arm, Array, clip_norm
from rejoint.control.law import GAIN, STEP_LIMIT, limit_lead, limit_position
from rejoint.control.observation import View


@dataclass(frozen=True, kw_only=True)
class CommandLaw:
    """Constants of the law; they are part of a policy's contract."""

    anchor: Literal["sent", "measured"] = "sent"
    """what the step is added to"""
    step_gain: float = GAIN
    """fraction of the damped least-squares step taken each cycle"""
    step_limit: float = float(STEP_LIMIT)
    """[rad] largest element of the damped least-squares step"""
    authority_floor: float = float(np.radians(0.12))
    """[rad] correction that the policy always has (chosen: just above one encoder count)"""
    authority_slope: float = 0.5
    """growth of the authority with the largest element of the damped least-squares step"""
    authority_limit: float = float(np.radians(4.0))
    """[rad] largest correction"""
    lead_limit: float = float(np.radians(20.0))
    """[rad] largest distance between command and measured position (anti-windup)"""
    rest_gain: float = 0.02
    """fraction of the way back to the rest posture taken each cycle in the null space (chosen: a policy without it
    lets the wrist drift to its limits over a few dozen targets)"""
    rest_distance: float = 0.01
    """[m] TCP distance below which that pull fades, so that it does not disturb a settled arm"""

    def authority(self, step: Array) -> Array:
        """Largest correction (B, 1) [rad] at the damped least-squares steps ``step`` (B, n) [rad]."""
        largest = np.abs(step).max(axis=-1, keepdims=True)
        return np.minimum(self.authority_floor + self.authority_slope * largest, self.authority_limit)

    def command(self, arm: Arm, view: View, position: Array, sent: Array, action: Array) -> Array:
        """Return the wanted joint positions (B, n) [rad].

        ``position`` (B, n) [rad] is measured, ``sent`` (B, n) [rad] the last command after the guard,
        ``action`` (B, n) the policy's output in [-1, 1], ``view`` made at the same position.
        """
        anchor = sent if self.anchor == "sent" else position
        wanted = anchor + self.step_gain * clip_norm(view.step, self.step_limit)
        wanted = wanted + self.authority(view.step) * np.clip(action, -1.0, 1.0)
        if self.rest_gain:
            fade = self.rest_gain * np.minimum(view.distance / self.rest_distance, 1.0)
            wanted = wanted + fade[:, None] * clip_norm(view.homing, self.step_limit)
        return limit_position(arm, limit_lead(wanted, position, self.lead_limit))
