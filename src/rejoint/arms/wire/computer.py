"""The computer of an arm, as requests see it; SI units and radians."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array

FULL_SPEED = float(np.radians(120.0))
"""[rad/s] of the fastest joint at 100 % (chosen: 80 % of the vendor's)"""
ACCELERATION = float(np.radians(200.0))
"""[rad/s^2] (vendor's communication protocol page)"""

NO_SOLUTION = 32
NO_LINE = 33
COLLISION = 16
"""Error codes of the vendor's ``get_error_information``; 1..6: joint over its limit; 16: any contact"""

HAS_ARRIVED_ANGLE = float(np.radians(1.0))
HAS_ARRIVED_LENGTH = 0.003
"""[rad], [m] (chosen)"""

Mask = NDArray[np.bool_]


class Computer(Protocol):
    """An arm of n joints under orders."""

    arm: Arm
    lower: Array
    """(n,) [rad] within those of the arm"""
    upper: Array
    """(n,) [rad]"""
    fresh: bool
    """a new move replaces the present one, else is queued"""
    powered: bool
    enabled: Mask
    """(n,)"""
    error: int
    """as in ``get_error_information``"""
    registers: dict[tuple[int, int], int]
    """(servo, address) -> value"""

    @property
    def angles(self) -> Array:
        """(n,) [rad] measured."""

    @property
    def planned_angles(self) -> Array:
        """(n,) [rad]."""

    @property
    def destination(self) -> Array:
        """(n,) [rad] last planned end."""

    @property
    def pose(self) -> Array:
        """(4, 4) TCP pose."""

    @property
    def speed(self) -> Array:
        """(n,) [rad/s]."""

    @property
    def current(self) -> Array:
        """(n,) [A]."""

    @property
    def voltage(self) -> Array:
        """(n,) [V]."""

    @property
    def temperature(self) -> Array:
        """(n,) [deg C]."""

    @property
    def alarms(self) -> NDArray[np.uint8]:
        """(n,) servo status bits."""

    @property
    def moving(self) -> bool:
        """Whether a move is under way."""

    @property
    def paused(self) -> bool:
        """Whether a move is suspended."""

    def in_position(self, angles: Array) -> bool:
        """Whether the arm is at ``angles`` (n,) [rad]."""

    def at_pose(self, pose: Array) -> bool:
        """Whether the TCP is at ``pose`` (4, 4)."""

    def move_joints(self, angles: Array, rate: float) -> bool:
        """Move to ``angles`` (n,) [rad] at ``rate`` (0..1); False: refused."""

    def move_tool(self, pose: Array, rate: float, *, straight: bool, turned: bool = True) -> bool:
        """Bring the tool to ``pose`` (4, 4), or without ``turned`` to its place; False: refused."""

    def jog_joint(self, joint: int, direction: int, rate: float) -> bool:
        """Run one joint to its limit or a stop; False: refused."""

    def jog_tool(self, pose: Array, rate: float) -> bool:
        """Run the tool straight to ``pose`` (4, 4); False: refused."""

    def stop(self, joint: int | None = None) -> None:
        """Hold: one joint, or the arm."""

    def pause(self) -> None:
        """Hold until `resume`."""

    def resume(self) -> None:
        """Continue."""

    def clear_queue(self) -> None:
        """Drop waiting moves."""

    def power(self, on: bool) -> None:
        """Power all servos."""

    def enable(self, wanted: Mask) -> None:
        """Hold with the servos in ``wanted`` (n,); release the others."""

    def calibrate(self, joint: int) -> None:
        """Set a joint's zero here."""


def at_angles(here: Array, angles: Array) -> bool:
    """Whether ``here`` (n,) [rad] is within a degree of ``angles``."""
    return bool((np.abs(here - angles) < HAS_ARRIVED_ANGLE).all())


def at_place(here: Array, pose: Array) -> bool:
    """Whether pose ``here`` (4, 4) is within 3 mm and a degree of ``pose``."""
    cosine = (np.trace(pose[:3, :3] @ here[:3, :3].T) - 1.0) / 2.0
    near = np.linalg.norm(pose[:3, 3] - here[:3, 3]) < HAS_ARRIVED_LENGTH
    return bool(near and cosine > np.cos(HAS_ARRIVED_ANGLE))
