"""The interface of robots: B arms, each with its own clock; arrays lead with B."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array

Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class JointState:
    """Reading of the joints."""

    time: Array
    """(B,) [s] of the answer, robot clock"""
    position: Array
    """(B, n) [rad]"""
    age: Array
    """(B,) [s] since the last fresh answer"""
    temperature: Array | None = None
    """(B, n) [deg C]; None: unknown"""
    fault: NDArray[np.bool_] | None = None
    """(B, n) servo faults; None: unknown"""
    trouble: tuple[str, ...] | None = None
    """(n,) servo faults of one arm in words"""
    load: Array | None = None
    """(B, n) torque over the largest, -1 to 1, positive with the joint; None: unknown"""
    voltage: Array | None = None
    """(B, n) [V]; None: unknown"""
    elsewhere: Mask | None = None
    """(B,) others moved the arm in a pause; None: unknown"""


@runtime_checkable
class Robot(Protocol):
    """One arm, or a batch."""

    @property
    def arm(self) -> Arm:
        """Kinematics, limits and masses."""

    @property
    def address(self) -> str:
        """Address as the user wrote it."""

    @property
    def count(self) -> int:
        """Number of arms."""

    def read(self) -> JointState:
        """Newest state; RobotError."""

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad], wait a period, read; arms not ``active`` (B,) repeat their state."""

    def true_tcp(self) -> Array:
        """Return true tool positions (B, 3) [m]; NaN: unknown."""

    def stop(self) -> None:
        """Hold; the power stays on."""

    def close(self) -> None:
        """Close the connection; the arm holds."""
