"""What a conversation, its faults and its log need of the arm that is emulated, whatever its wire speaks."""

from __future__ import annotations

from typing import Protocol

from rejoint.arms import Arm, Array
from rejoint.robots.lab.emulator.ailments import Ailments
from rejoint.robots.lab.emulator.plantlike import Mask


class ArmLike(Protocol):
    """An emulated arm of n joints."""

    arm: Arm
    ailments: Ailments

    @property
    def angles(self) -> Array:
        """(n,) [rad] joint angles as the encoders tell them."""

    @property
    def temperature(self) -> Array:
        """(n,) [deg C]."""

    @property
    def true_tcp(self) -> Array:
        """(3,) [m] where the tool really is."""

    @property
    def true_links(self) -> Array:
        """(n,) [rad] angles of the links, behind play and flex."""

    def advance(self, duration: float) -> None:
        """Let [s] pass."""

    def freeze(self, joints: Mask) -> None:
        """Let the encoders of ``joints`` (n,) tell what they tell now, for good; their servos still see."""

    def blind(self, joints: Mask) -> None:
        """Let the servos of ``joints`` (n,) see what they see now, for good."""
