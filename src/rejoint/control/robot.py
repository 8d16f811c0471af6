"""What a robot promises. It may be a batch of B arms in lockstep, each with its own clock; arrays lead with B."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array

Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class JointState:
    """What the encoders said, and when."""

    time: Array
    """(B,) [s] on the robot's own clock, when the answer arrived"""
    position: Array
    """(B, n) [rad] measured joint positions"""
    age: Array
    """(B,) [s] since the last fresh answer"""
    temperature: Array | None = None
    """(B, n) [deg C]; None: not reported"""
    fault: NDArray[np.bool_] | None = None
    """(B, n) whether a servo reports a fault; None: not reported"""
    trouble: tuple[str, ...] | None = None
    """(n,) complaints of a single arm's servos in words"""
    load: Array | None = None
    """(B, n) reported torque over the largest, -1 to 1, positive with the joint; None: not reported"""
    voltage: Array | None = None
    """(B, n) [V]; None: not reported"""
    elsewhere: Mask | None = None
    """(B,) whether others moved the arm during a pause; None: not known"""


@runtime_checkable
class Robot(Protocol):
    """One arm, or a batch, that can be read and commanded."""

    @property
    def arm(self) -> Arm:
        """The arm's kinematics, limits and masses."""

    @property
    def address(self) -> str:
        """Where the robot is, as the user wrote it."""

    @property
    def count(self) -> int:
        """Number B of arms."""

    def read(self) -> JointState:
        """Newest state; RobotError without."""

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad], wait a period, read; arms not ``active`` (B,) repeat their state."""

    def true_tcp(self) -> Array:
        """Return true tool positions (B, 3) [m]; NaN: not known."""

    def stop(self) -> None:
        """Make the arm hold; the power stays on."""

    def close(self) -> None:
        """Release the connection; the arm keeps holding."""
