"""Joint goals of a batch: the inverse kinematics of each arm's target, solved once when the target is set."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, solve_position
from rejoint.control.controller import Situation
from rejoint.control.robot import Mask


class Goal:
    """Remembers one goal posture per arm."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self.position: Array = np.zeros((0, arm.joints))
        """(B, n) [rad]"""

    def reset(self, situation: Situation, where: Mask) -> None:
        """Solve for the targets of the arms in ``where`` (B,), searching from their last commands.

        A target out of reach gets the nearest posture found.
        """
        if len(self.position) != len(situation.sent):
            self.position = situation.sent.copy()
        self.position[where] = solve_position(self._arm, situation.target[where], situation.sent[where]).q
