"""What the firmware needs of the arm that it moves."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array

Mask = NDArray[np.bool_]


class PlantLike(Protocol):
    """What the firmware needs of `rejoint.robots.lab.plant.plant.Plant`, for a batch of one arm."""

    @property
    def speed(self) -> Array:
        """(1, n) [rad/s]."""

    @property
    def torque(self) -> Array:
        """(1, n) [N m]."""

    @property
    def temperature(self) -> Array:
        """(1, n) [deg C]."""

    def command(self, position: Array) -> None:
        """Write goals (1, n) [rad]."""

    def advance(self, duration: float) -> None:
        """Let whole milliseconds pass; [s]."""

    def encoder(self) -> Array:
        """(1, n) [rad]."""

    def link_position(self) -> Array:
        """(1, n) [rad] behind play and flex."""

    def true_tcp(self) -> Array:
        """(1, 3) [m]."""

    @property
    def goal(self) -> Array:
        """(1, n) [rad] what the servos were told last."""

    def halt(self) -> None:
        """Freeze the servos' references where their ramps are."""

    def set_power(self, on: Mask) -> None:
        """Power the servos (1,); those newly powered hold where they are."""

    def set_speed_limit(self, speed: float) -> None:
        """Limit the servos' own ramps [rad/s]."""

    def freeze(self, joints: Mask) -> None:
        """Let the encoders of ``joints`` (1, n) tell what they tell now, for good; their servos still see."""

    def blind(self, joints: Mask) -> None:
        """Let the servos of ``joints`` (1, n) see what they see now, for good."""
