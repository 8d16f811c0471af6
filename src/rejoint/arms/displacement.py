"""Where joints and tool really are: displacements that the encoders do not see.

Behind the encoder of a worn joint lie its play, the flex of gear and link, and the error of its zero. A joint with
weight on it is pressed to one side of its play and bent by that weight, both by as much every time it stands there, so
the displacement can be computed from the posture; a joint without weight floats in its play. Besides, the links
themselves may differ from their description, and the base may stand askew, so that gravity pulls along another
direction.

The model of compliance and play is the usual one of elasto-geometric calibration (Khalil and Dombre, Modeling,
Identification and Control of Robots, 2002, chapter 11), with the smooth sign of the torque for the side of the play.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms.arm import Arm, Array, _freeze
from rejoint.arms.kinematics import GRAVITY, gravity_torque, tcp_pose, tcp_position
from rejoint.arms.rotations import rotation_about

FLOATING = 0.004
"""[N m] torque within which a joint is not sure to lie on one side of its play (chosen on emulated worn arms)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Displacement:
    """What lies behind the encoders of an arm of n joints; zeros mean that nothing does."""

    offset: Array
    """(n,) [rad] added to what the encoders say: the error of their zeros"""
    compliance: Array
    """(n,) [rad/(N m)] of gear and link"""
    play: Array
    """(n,) [rad] whole width"""
    twist: Array
    """(n + 1, 6) small errors of the fixed transforms to each joint frame and to the TCP, in the frame before it:
    translation [m] and rotation vector [rad]"""
    gravity: Array
    """(3,) [m/s^2] in the frame of the base: askew where the base is"""
    mass: Array = field(default_factory=lambda: np.ones(()))
    """(n,) or () factor between the masses of the links and their description"""

    def __post_init__(self) -> None:
        _freeze(self)

    @classmethod
    def none(cls, arm: Arm) -> Displacement:
        """Displacement of an arm that stands upright and is what its encoders say."""
        n = arm.joints
        return cls(
            offset=np.zeros(n), compliance=np.zeros(n), play=np.zeros(n), twist=np.zeros((n + 1, 6)), gravity=GRAVITY
        )

    def torque(self, arm: Arm, position: Array) -> Array:
        """Torques (..., n) [N m] that hold ``arm`` against gravity where its encoders say ``position`` (..., n)."""
        loaded = arm if (self.mass == 1.0).all() else replace(arm, mass=arm.mass * self.mass)
        return gravity_torque(loaded, position, self.gravity)

    def joints(self, arm: Arm, position: Array) -> Array:
        """Where the links (..., n) [rad] are while the encoders say ``position`` (..., n) [rad], at rest."""
        torque = self.torque(arm, position)
        side = np.tanh(torque / FLOATING)
        return np.asarray(position + self.offset - self.compliance * torque - 0.5 * self.play * side)

    def moved(self, arm: Arm) -> Arm:
        """Return the arm with its links as they are: the same but for `twist`."""
        if not self.twist.any():
            return arm
        fixed = np.concatenate([arm.offset, arm.tip[None]])
        error = np.tile(np.eye(4), (len(fixed), 1, 1))
        error[:, :3, 3] = self.twist[:, :3]
        for pose, vector in zip(error, self.twist[:, 3:], strict=True):
            angle = float(np.linalg.norm(vector))
            if angle > 0.0:
                pose[:3, :3] = rotation_about(vector / angle, angle)
        fixed = error @ fixed
        return replace(arm, offset=fixed[:-1], tip=fixed[-1])

    def tool(self, arm: Arm, position: Array) -> Array:
        """Where the tool (..., 3) [m] is while the encoders say ``position`` (..., n) [rad], at rest."""
        return tcp_position(self.moved(arm), self.joints(arm, position))

    def tool_pose(self, arm: Arm, position: Array) -> Array:
        """Its pose (..., 4, 4)."""
        return tcp_pose(self.moved(arm), self.joints(arm, position))
