"""What a follower knows of the servos that it commands, and which command a motion needs by that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, frames
from rejoint.arms.kinematics import GRAVITY
from rejoint.system.errors import InputError

TURNING = 0.015
"""[rad/s] speed at which friction has turned round to three quarters (chosen: the slowest joint of a circle in 20 s
moves several times as fast)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Servos:
    """Parameters of the servos of B arms, as an identified twin has them."""

    stiffness: Array
    """(B, n) [N m/rad]"""
    damping: Array
    """(B, n) [N m s/rad]"""
    coulomb: Array
    """(B, n) [N m]"""
    armature: Array
    """(B, n) [kg m^2]"""
    torque_limit: Array
    """(B, n) [N m]"""
    offset: Array
    """(B, n) [rad] the joint's position under no load, minus the command"""
    delay: Array
    """(B,) [s] from sending a command to reading its first effect"""

    def __post_init__(self) -> None:
        shape = np.shape(self.stiffness)
        joints = (self.damping, self.coulomb, self.armature, self.torque_limit, self.offset)
        if len(shape) != 2 or any(np.shape(one) != shape for one in joints) or np.shape(self.delay) != shape[:1]:
            raise InputError(f"servos: stiffness has shape {shape}, expected (arms, joints), and all others as many")
        if not ((self.stiffness > 0.0).all() and (self.torque_limit > 0.0).all()):
            raise InputError("servos: stiffness and torque limits must be positive")

    def most(self) -> Array:
        """Return the largest angles (B, n) [rad] between command and joint that a servo makes more torque of."""
        return self.torque_limit / self.stiffness


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """A motion of B arms at one moment, known a little before and after it."""

    around: Array
    """(3, B, n) [rad] postures ``step`` before, now, and after"""
    step: float
    """[s]"""

    @property
    def position(self) -> Array:
        """PathPostures (B, n) [rad]."""
        return np.asarray(self.around[1])

    @property
    def speed(self) -> Array:
        """Speeds (B, n) [rad/s]."""
        return (self.around[2] - self.around[0]) / (2.0 * self.step)

    @property
    def acceleration(self) -> Array:
        """Accelerations (B, n) [rad/s^2]."""
        return (self.around[2] - 2.0 * self.around[1] + self.around[0]) / self.step**2


def command_for(arm: Arm, servos: Servos, motion: Moment) -> Array:
    """Commands (B, n) [rad] under which servos would move so: the inverse of the twin."""
    speed = motion.speed
    torque = (
        link_torque(arm, motion)
        + servos.coulomb * np.tanh(speed / TURNING)
        + servos.damping * speed
        + servos.armature * motion.acceleration
    )
    return motion.position - servos.offset + torque / servos.stiffness


def link_torque(arm: Arm, motion: Moment) -> Array:
    """Torques (B, n) [N m] that carry and accelerate the links, taken as points at their centres of mass."""
    f = frames(arm, motion.around)
    centre = f.position + np.einsum("tbnij,nj->tbni", f.rotation, arm.com)
    pull = (centre[2] - 2.0 * centre[1] + centre[0]) / motion.step**2 - GRAVITY
    force = arm.mass[:, None] * pull
    moment = np.cross(centre[1], force)
    # Of all that hangs on each joint: force and moment, the latter about the joint's own place.
    force, moment = (np.cumsum(part[:, ::-1], axis=1)[:, ::-1] for part in (force, moment))
    return (f.axis[1] * (moment - np.cross(f.position[1], force))).sum(axis=-1)
