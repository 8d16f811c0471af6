"""What a robot promises: arms one can command. A robot may be a batch of arms in lockstep.

Every array has a leading axis of B arms; a single arm, real or emulated, has B = 1. Lockstep
means that all arms of a batch are in the same control cycle, not that their clocks agree: each
arm has its own period and its own clock.
"""

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
    """(B,) [s] how long ago the last fresh answer arrived; 0 where this one is fresh"""
    temperature: Array | None = None
    """(B, n) [deg C] servo temperatures, None where the robot does not report them"""
    fault: NDArray[np.bool_] | None = None
    """(B, n) whether a servo reports a fault, None where the robot does not report it"""
    trouble: tuple[str, ...] | None = None
    """(n,) what the servos of a single arm complain of, in words, empty for nothing; None where nobody tells"""
    load: Array | None = None
    """(B, n) torque that each servo says it gives, as a share of its largest, -1 to 1, positive with the joint; None
    where the robot does not report it"""
    voltage: Array | None = None
    """(B, n) [V] supply that each servo measures, None where the robot does not report it"""
    elsewhere: Mask | None = None
    """(B,) whether an arm stands, after a pause, where its last command did not bring it: moved by hand, switched off
    and on, or another one; None where nobody tells"""


@runtime_checkable
class Robot(Protocol):
    """One arm, or a batch of arms, that can be read and commanded."""

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
        """Return the newest joint state; RobotError if there is none to be had."""

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad], wait one control period, read.

        Arms that are not ``active`` (B,) are neither commanded nor advanced; their state repeats.
        """

    def true_tcp(self) -> Array:
        """(B, 3) [m] where the tools really are; NaN where nobody knows (every real arm)."""

    def stop(self) -> None:
        """Make the arm hold where it is. Never cuts the power: a worn arm would collapse."""

    def close(self) -> None:
        """Release the connection; the arm keeps holding."""
