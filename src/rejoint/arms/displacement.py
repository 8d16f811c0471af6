"""Displacements behind encoders: play, flex, zero errors, links, a tilted base.

Weight presses a joint to one side of its play and bends it (Khalil and Dombre 2002, chapter 11).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms.arm import Arm, Array, _freeze
from rejoint.arms.kinematics import GRAVITY, gravity_torque, tcp_pose, tcp_position
from rejoint.arms.rotations import moved

FLOATING = 0.001
"""[N m] of a floating joint (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Displacement:
    """Displacement of n joints; zeros: none."""

    offset: Array
    """(n,) [rad] of the encoders' zeros"""
    compliance: Array
    """(n,) [rad/(N m)] of gear and link"""
    play: Array
    """(n,) [rad] whole width"""
    twist: Array
    """(n + 1, 6) errors [m, rad] of the transforms to joints and TCP"""
    gravity: Array
    """(3,) [m/s^2] in the base frame"""
    mass: Array = field(default_factory=lambda: np.ones(()))
    """(n,) or () factor on masses"""

    def __post_init__(self) -> None:
        _freeze(self)

    @classmethod
    def none(cls, arm: Arm) -> Displacement:
        """No displacement."""
        n = arm.joints
        return cls(
            offset=np.zeros(n), compliance=np.zeros(n), play=np.zeros(n), twist=np.zeros((n + 1, 6)), gravity=GRAVITY
        )

    def torque(self, arm: Arm, position: Array) -> Array:
        """Torques (..., n) [N m] against gravity at encoder ``position`` (..., n)."""
        loaded = arm if (self.mass == 1.0).all() else replace(arm, mass=arm.mass * self.mass)
        return gravity_torque(loaded, position, self.gravity)

    def joints(self, arm: Arm, position: Array) -> Array:
        """Return true joint positions (..., n) [rad] at rest, at encoder ``position`` (..., n) [rad]."""
        torque = self.torque(arm, position)
        return position + self.offset - self.compliance * torque - 0.5 * self.play * np.tanh(torque / FLOATING)

    def rigid(self, arm: Arm, position: Array) -> Displacement:
        """Without play and flex: their mean over ``position`` (M, n) goes to `offset`."""
        shift = (self.joints(arm, position) - position).mean(axis=0)
        return replace(self, offset=shift, compliance=np.zeros(arm.joints), play=np.zeros(arm.joints))

    def moved(self, arm: Arm) -> Arm:
        """Arm with `twist` in its links."""
        if not self.twist.any():
            return arm
        fixed = moved(np.eye(4), self.twist) @ np.concatenate([arm.offset, arm.tip[None]])
        return replace(arm, offset=fixed[:-1], tip=fixed[-1])

    def tool(self, arm: Arm, position: Array) -> Array:
        """Return true tool (..., 3) [m] at encoder ``position`` (..., n) [rad]."""
        return tcp_position(self.moved(arm), self.joints(arm, position))

    def tool_pose(self, arm: Arm, position: Array) -> Array:
        """Return true tool poses (..., 4, 4)."""
        return tcp_pose(self.moved(arm), self.joints(arm, position))
