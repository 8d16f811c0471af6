"""Cameras that a simulated robot brings."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from rejoint.control.robot import Robot, part_of
from rejoint.control.seeing import Eye
from rejoint.system.errors import InputError


@runtime_checkable
class Simulated(Protocol):
    """A simulated robot, which brings the cameras that see it."""

    def eye(self, seed: int) -> Eye:
        """Detector of the tool; noise by ``seed``."""

    def camera(self, board: Any, carried: str, seed: int) -> Any:  # noqa: ANN401 - the camera's room knows both
        """Camera that sees the ``board``; the tool has ``carried``, which is ``board`` or ``camera``."""


def simulated(robot: Robot) -> Simulated:
    """Return the robot that brings its cameras; InputError without."""
    found = part_of(robot, Simulated)
    if found is None:
        raise InputError(
            f"camera emulated: it sees one arm that is emulated in this process, not {robot.address}; give the number "
            "of a camera, or emulated:WEAR as the robot"
        )
    return found
