"""Joint goals of a batch: the inverse kinematics of each arm's target, solved once when the target is set."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, solve_position
from rejoint.arms.posing import find_postures
from rejoint.control.controller import ControlInput
from rejoint.control.robot import Mask


class Goal:
    """Remembers one goal posture per arm."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self.position: Array = np.zeros((0, arm.joints))
        """(B, n) [rad]"""
        self._foreseen: Array = np.zeros((0, 3))  # (B, 3) targets solved ahead, NaN where there is none
        self._ahead: Array = np.zeros((0, arm.joints))  # (B, n) their goal postures

    def foresee(self, target: Array, start: Array, where: Mask) -> None:
        """Solve ahead for the ``target`` (B, 3) [m] that each arm in ``where`` (B,) will be given next.

        The search begins at ``start`` (B, n) [rad]; `reset` to that very target then takes what was found.
        """
        self._foreseen = np.where(where[:, None], target, np.nan)
        self._ahead = start.copy()
        self._ahead[where] = solve_position(self._arm, target[where], start[where]).q

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Solve for the targets of the arms in ``where`` (B,), searching from their last commands.

        A target out of reach gets the nearest posture found.
        """
        if len(self.position) != len(inputs.sent):
            self.position = inputs.sent.copy()
        if len(self._foreseen) == len(where):
            known = where & (self._foreseen == inputs.target).all(axis=1)
            self.position[known], self._foreseen[known] = self._ahead[known], np.nan
            where = where & ~known
        if where.any():
            turn = None if inputs.turn is None else inputs.turn[where]
            self.position[where] = find_postures(self._arm, inputs.target[where], inputs.sent[where], turn)
