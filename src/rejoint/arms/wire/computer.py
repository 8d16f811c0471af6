"""The computer of an arm, as requests see it; SI units and radians."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array

FULL_SPEED = float(np.radians(120.0))
"""[rad/s] of the fastest joint at 100 % (chosen: 80 % of the vendor's)"""
ACCELERATION = float(np.radians(200.0))
"""[rad/s^2] of interpolated moves (vendor's communication protocol page)"""

NO_SOLUTION = 32
NO_LINE = 33
COLLISION = 16
"""Error codes of the vendor's ``get_error_information``; 1..6 name the joint over its limit; 16 stands for every
contact"""

HAS_ARRIVED_ANGLE = float(np.radians(1.0))
HAS_ARRIVED_LENGTH = 0.003
"""[rad], [m] what counts as in position (chosen)."""

Mask = NDArray[np.bool_]


class Computer(Protocol):
    """An arm of n joints that moves as it is ordered."""

    arm: Arm
    lower: Array
    """(n,) [rad] limits in force, within those of the arm"""
    upper: Array
    """(n,) [rad]"""
    fresh: bool
    """whether a new move replaces the present one, or is queued"""
    powered: bool
    enabled: Mask
    """(n,) which servos hold"""
    error: int
    """as ``get_error_information`` tells it"""
    registers: dict[tuple[int, int], int]
    """(servo, address) -> value"""

    @property
    def angles(self) -> Array:
        """(n,) [rad] measured joint angles."""

    @property
    def planned_angles(self) -> Array:
        """(n,) [rad] where the reference is."""

    @property
    def destination(self) -> Array:
        """(n,) [rad] where the last of the planned moves ends."""

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
        """(n,) status bits of the servos."""

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
        """Go to ``angles`` (n,) [rad] at ``rate`` (0..1); False: refused."""

    def move_tool(self, pose: Array, rate: float, *, straight: bool, turned: bool = True) -> bool:
        """Bring the tool to ``pose`` (4, 4), or without ``turned`` to its place; False: refused."""

    def jog_joint(self, joint: int, direction: int, rate: float) -> bool:
        """Run one joint until its limit or a stop; False: refused."""

    def jog_tool(self, pose: Array, rate: float) -> bool:
        """Run the tool straight towards ``pose`` (4, 4); False: refused."""

    def stop(self, joint: int | None = None) -> None:
        """Hold: one joint, or the arm."""

    def pause(self) -> None:
        """Hold, to go on later."""

    def resume(self) -> None:
        """Go on."""

    def clear_queue(self) -> None:
        """Forget the waiting moves."""

    def power(self, on: bool) -> None:
        """Power all servos, or none."""

    def enable(self, wanted: Mask) -> None:
        """Let the servos in ``wanted`` (n,) hold; release the others."""

    def calibrate(self, joint: int) -> None:
        """Take the present position of a joint as its zero."""


def at_angles(here: Array, angles: Array) -> bool:
    """Whether ``here`` (n,) [rad] is within a degree of ``angles``."""
    return bool((np.abs(here - angles) < HAS_ARRIVED_ANGLE).all())


def at_place(here: Array, pose: Array) -> bool:
    """Whether pose ``here`` (4, 4) is within 3 mm and a degree of ``pose``."""
    cosine = (np.trace(pose[:3, :3] @ here[:3, :3].T) - 1.0) / 2.0
    near = np.linalg.norm(pose[:3, 3] - here[:3, 3]) < HAS_ARRIVED_LENGTH
    return bool(near and cosine > np.cos(HAS_ARRIVED_ANGLE))
