"""The posture that clients are shown: that of a perfect arm whose tool is where this one's tool really is.

What lies behind the encoders shifts a tool by millimetres. A client knows nothing of it: it asks for joint angles or
coordinates of a perfect arm. So it is shown the angles that such an arm would have, and what it asks for is turned
into measured angles at which the tool is there. Without a calibration the two are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, clip_norm, dls, frames, position_kinematics
from rejoint.control.correction import ROUNDS

Shift = Callable[[Array, Array], Array]
"""How far (3,) [m] the tool is from where the encoders see it, from the position and where the arm came from, both
(n,) [rad]; as `rejoint.control.correction.Modelled.shift`"""

DAMPING = 0.01
"""[m] of the inverse kinematics (chosen: a fifth of what controllers take; the shift is small)"""
MOST = np.radians(15.0)
"""[rad] by which a joint is shown elsewhere at most (chosen: what 5 cm take at the wrist)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Apparent:
    """What clients are shown of an ``arm``, and where it is sent for it."""

    arm: Arm
    shift: Shift | None = None
    """None: the tool is where the encoders see it"""

    def shown(self, position: Array, came: Array) -> Array:
        """Posture (n,) [rad] shown where ``position`` (n,) is measured and the arm came from ``came`` (n,)."""
        if self.shift is None:
            return position
        return position + self._turn(position, self.shift(position, came))

    def measured(self, posture: Array, came: Array) -> Array:
        """Measured position (n,) [rad] at which ``posture`` (n,) is shown."""
        if self.shift is None:
            return posture
        position = posture
        for _ in range(ROUNDS):
            position = posture - (self.shown(position, came) - position)
        return np.clip(position, self.arm.lower, self.arm.upper)

    def _turn(self, position: Array, way: Array) -> Array:
        """Joint motion (n,) [rad] that takes the tool ``way`` (3,) [m] farther, without turning it where it can."""
        jacobian = position_kinematics(self.arm, position)[1]
        turning = np.swapaxes(frames(self.arm, position).axis, -1, -2)
        both = np.concatenate([jacobian, DAMPING * turning], axis=-2)
        return clip_norm(dls(both, np.concatenate([way, np.zeros(3)]), 0.1 * DAMPING), MOST)
