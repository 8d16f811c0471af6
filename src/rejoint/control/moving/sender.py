"""The path sent as it comes: the inverse kinematics of the moving target at every cycle, and nothing else."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.controller import ControlInput
from rejoint.control.moving.posture import PathPostures
from rejoint.control.robot import Mask


class Sender:
    """What a program does that knows nothing of its arm: the yardstick of all that follow."""

    name = "default"

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._postures: PathPostures | None = None

    def reset(self, inputs: ControlInput, where: Mask) -> None:  # noqa: ARG002 - nothing is remembered that grows old
        """Begin at the first target."""
        if self._postures is None:
            self._postures = PathPostures(self._arm, inputs.target, inputs.turn)

    def command(self, inputs: ControlInput) -> Array:
        """Return the postures (B, n) [rad] of the targets now."""
        assert self._postures is not None  # noqa: S101 - the loop resets before it asks
        return np.asarray(self._postures.at(inputs.aims(np.zeros(1)), inputs.turns(np.zeros(1)))[0])
