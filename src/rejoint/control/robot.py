"""The interface of robots: B arms, each with its own clock; arrays lead with B."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array

Mask = NDArray[np.bool_]
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, eq=False)
class JointState:
    """Reading of the joints; None: unknown."""

    time: Array
    """(B,) [s] robot clock"""
    position: Array
    """(B, n) [rad]"""
    age: Array
    """(B,) [s] since the last fresh answer"""
    temperature: Array | None = None
    """(B, n) [deg C]"""
    fault: Mask | None = None
    """(B, n)"""
    trouble: tuple[str, ...] | None = None
    """(n,) servo faults in words"""
    load: Array | None = None
    """(B, n) torque over the largest, -1 to 1, positive with the joint"""
    voltage: Array | None = None
    """(B, n) [V]"""
    elsewhere: Mask | None = None
    """(B,) others moved the arm in a pause"""


@runtime_checkable
class Robot(Protocol):
    """One arm, or a batch."""

    @property
    def arm(self) -> Arm:
        """Kinematics, limits and masses."""

    @property
    def address(self) -> str:
        """As the user wrote it."""

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


@runtime_checkable
class Relaying(Protocol):
    """Relays words to other devices on its wire, such as a gripper."""

    def relay(self, command: int, payload: bytes) -> bytes | None:
        """Ask a device; None: no answer."""


def part_of(robot: Robot, kind: type[T]) -> T | None:
    """Find the ``robot`` or wrapped robot of a ``kind``; or None."""
    inner: object = robot
    while inner is not None and not isinstance(inner, kind):
        inner = getattr(inner, "robot", None)
    return inner
