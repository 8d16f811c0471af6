"""The arm's default: the inverse kinematics of the target is sent, and that is all (open loop).

Park et al. 2024, section IV-F, "default control method". The damped least-squares inverse
kinematics starts at the last command.
"""

from __future__ import annotations

from rejoint.arms import Arm, Array
from rejoint.control.controller import ControlInput
from rejoint.control.goal import Goal
from rejoint.control.robot import Mask


class DefaultController:
    """Commands one posture per target."""

    name = "default"
    heeds_turn = True

    def __init__(self, arm: Arm) -> None:
        self._goal = Goal(arm)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Solve for the new targets of the arms in ``where`` (B,)."""
        self._goal.reset(inputs, where)

    def command(self, inputs: ControlInput) -> Array:  # noqa: ARG002 - open loop: what happens does not matter
        """Return the goal postures (B, n) [rad]."""
        return self._goal.position.copy()
