"""Where joints and tool really are: displacements that the encoders do not see.

Behind the encoder of a worn joint lie its play, the flex of gear and link, and the error of its zero. A joint with
weight on it is pressed to one side of its play and bent by that weight, both by as much every time it stands there, so
the displacement can be computed from the posture; a joint without weight floats in its play, and at most its last
motion tells on which side: it runs ahead of its motor, or stays behind. Besides, the links themselves may differ from
their description, and the base may stand askew, so that gravity pulls along another direction.

The model of compliance and play is the usual one of elasto-geometric calibration (Khalil and Dombre, Modeling,
Identification and Control of Robots, 2002, chapter 11), with the smooth sign of the torque for the side of the play.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms.arm import Arm, Array, _freeze
from rejoint.arms.kinematics import GRAVITY, gravity_torque, tcp_pose, tcp_position
from rejoint.arms.rotations import rotation_about

FLOATING = 0.001
"""[N m] torque within which a joint is not sure to lie on one side of its play (chosen on emulated worn arms)"""

CARRIED = np.radians(1.0)
"""[rad] length of a joint's last motion from which its direction counts (chosen: about the play)"""


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
    carry: Array = field(default_factory=lambda: np.zeros(()))
    """(n,) or () share of half the play by which a joint that floats runs ahead of its last motion"""

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

    def joints(self, arm: Arm, position: Array, approach: Array | None = None) -> Array:
        """Where the links (..., n) [rad] are while the encoders say ``position`` (..., n) [rad], at rest.

        ``approach`` (..., n) [rad] is where the encoders were before the last motion; NaN, or None, where nobody knows.
        """
        torque = self.torque(arm, position)
        side = np.tanh(torque / FLOATING)
        side = side - self.carry * (1.0 - side**2) * direction(position, approach)
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

    def tool(self, arm: Arm, position: Array, approach: Array | None = None) -> Array:
        """Where the tool (..., 3) [m] is while the encoders say ``position`` (..., n) [rad], at rest; see `joints`."""
        return tcp_position(self.moved(arm), self.joints(arm, position, approach))

    def tool_pose(self, arm: Arm, position: Array, approach: Array | None = None) -> Array:
        """Its pose (..., 4, 4)."""
        return tcp_pose(self.moved(arm), self.joints(arm, position, approach))


def direction(position: Array, approach: Array | None) -> Array:
    """Return where joints came from (..., n): 1 upwards, -1 downwards, 0 for a short motion or an unknown one."""
    if approach is None:
        return np.zeros_like(position)
    return np.tanh(np.where(np.isfinite(approach), position - approach, 0.0) / CARRIED)
