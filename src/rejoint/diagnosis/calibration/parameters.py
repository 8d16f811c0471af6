"""What a calibration fits, as one vector: which entries mean what, what is believed beforehand, and within what bounds.

Beliefs are those that hold for any arm of this class before anything was measured. Torques, and with them compliances,
go with the size of the arm; lengths with its reach (`rejoint.arms.size`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import rotation_about
from rejoint.arms.size import length_size, torque_size

OFFSET = np.radians(0.6)
"""[rad] standard deviation of the error of an encoder's zero (chosen: what homing marks and one gear tooth leave)"""
COMPLIANCE = 0.015
"""[rad/(N m)] mean and standard deviation of the compliance of a joint of a myCobot 280 (chosen: 25 to 500 N m/rad,
what healthy and worn arms of that size have)"""
PLAY, PLAY_SIGMA = np.radians(0.9), np.radians(0.7)
"""[rad] mean and standard deviation of the play of a joint (SO-ARM100 issue 134: about 1 deg on healthy servos)"""
LEVEL, ASKEW = np.radians(0.1), np.radians(6.0)
"""[rad] standard deviations of how far a base on a table, and one that stands askew, is turned about each horizontal
axis (chosen: a spirit level, and a wedge)"""
MASS = 0.12
"""[1] standard deviation of each link's mass by what its description says (chosen)"""
CARRY, CARRY_SIGMA = 0.2, 0.3
"""[1] mean and standard deviation of the share of half its play by which a floating joint runs ahead of its last motion
(chosen on emulated worn arms, where inertia does that; friction in a joint has it stay behind)"""
SHIFT, TURN = 1e-3, np.radians(0.3)
"""[m] on an arm of the reach of a myCobot 280, and [rad]: standard deviations of the errors of each link's description
(chosen: printed parts and press fits)"""
PLACE, ORIENTATION = 1.0, 3.0
"""[m] and [rad] standard deviations of the pose of a measuring frame around its first estimate: nothing is believed"""

MOST = {"offset": np.radians(6.0), "compliance": 0.3, "play": np.radians(8.0), "tilt": np.radians(20.0), "mass": 0.5,
        "carry": 1.0}  # fmt: skip
"""Bounds, in the units of above (chosen: beyond them something else is wrong)"""


KINDS = ("offset", "compliance", "play", "carry", "mass", "tilt", "twist")
"""Parameters of an arm, in order"""


@dataclass(frozen=True, kw_only=True)
class DisplacementLayout:
    """Places of the parameters of an arm of n joints in the vector."""

    joints: int
    frame: bool = False
    """whether the pose of the measuring frame is fitted along, as the last six parameters"""

    @property
    def size(self) -> int:
        """Length k of the vector."""
        return self.body + 6 * self.frame

    @property
    def body(self) -> int:
        """Number of those parameters that belong to the arm: all but the pose of the frame."""
        return 5 * self.joints + 2 + 6 * (self.joints + 1)

    def at(self, name: str) -> slice:
        """Return where a kind of parameters stands: one of `KINDS`, or ``frame``."""
        n = self.joints
        ends = {"offset": n, "compliance": 2 * n, "play": 3 * n, "carry": 4 * n, "mass": 5 * n, "tilt": 5 * n + 2,
                "twist": self.body, "frame": self.size}  # fmt: skip
        names = list(ends)
        place = names.index(name)
        return slice(ends[names[place - 1]] if place else 0, ends[name])

    def names(self) -> tuple[str, ...]:
        """Name every parameter of the arm, such as ``play 2``."""
        return tuple(f"{kind} {i + 1}" for kind in KINDS for i in range(self.at(kind).stop - self.at(kind).start))


@dataclass(frozen=True, kw_only=True, eq=False)
class Belief:
    """A normal distribution over the vector (k,), cut off at bounds."""

    mean: Array
    """(k,)"""
    precision: Array
    """(k, k) inverse of the covariance"""
    lower: Array
    """(k,)"""
    upper: Array
    """(k,)"""


@dataclass(frozen=True, kw_only=True)
class PriorCase:
    """What kind of arm one may have before oneself; the measurements decide which it is."""

    play: float = PLAY
    """[rad] mean"""
    play_sigma: float = PLAY_SIGMA
    """[rad]"""
    compliance: float = COMPLIANCE
    """[rad/(N m)] mean and standard deviation on an arm of the size of a myCobot 280"""
    tilt: float = LEVEL
    """[rad] standard deviation"""
    twist: float = 0.0
    """scale of the errors of the arm's description"""
    odds: float = 0.0
    """logarithm of how much more likely than others, before anything was measured"""


def belief(arm: Arm, layout: DisplacementLayout, case: PriorCase) -> Belief:
    """Return what is believed of an arm of some case, on a base that stands upright or nearly so."""
    n, sigma, mean = arm.joints, np.zeros(layout.size), np.zeros(layout.size)
    lower, upper = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
    if case.twist == 0.0:
        lower[layout.at("twist")] = upper[layout.at("twist")] = 0.0
    soft = case.compliance / torque_size(arm)
    mean[layout.at("compliance")], mean[layout.at("play")] = soft, case.play
    sigma[layout.at("offset")], sigma[layout.at("compliance")], sigma[layout.at("play")] = (
        OFFSET, soft, case.play_sigma
    )  # fmt: skip
    sigma[layout.at("mass")], sigma[layout.at("tilt")] = MASS, case.tilt
    mean[layout.at("carry")], sigma[layout.at("carry")] = CARRY, CARRY_SIGMA
    each = np.array([SHIFT * length_size(arm)] * 3 + [TURN] * 3)
    sigma[layout.at("twist")] = np.tile(max(case.twist, 1e-3) * each, n + 1)
    sigma[layout.at("frame")] = np.array([PLACE] * 3 + [ORIENTATION] * 3)[: 6 * layout.frame]
    for name, most in MOST.items():
        bound = most / torque_size(arm) if name == "compliance" else most
        upper[layout.at(name)] = bound
        lower[layout.at(name)] = 0.0 if name in ("compliance", "play") else -bound
    return Belief(mean=mean, precision=np.diag(sigma**-2.0), lower=lower, upper=upper)


def tilt_of(gravity: Array) -> Array:
    """Rotation (2,) [rad] about the base's x and y axes that brings `GRAVITY` to the direction of ``gravity`` (3,)."""
    down = gravity / np.linalg.norm(gravity)
    axis = np.cross(GRAVITY / np.linalg.norm(GRAVITY), down)
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, -down[2]))
    return np.asarray(axis[:2] / sine * angle) if sine > 0.0 else np.zeros(2)


def gravity_of(tilt: Array) -> Array:
    """Direction and size (3,) [m/s^2] of gravity in the frame of a base that stands askew by ``tilt`` (2,) [rad]."""
    angle = float(np.hypot(*tilt))
    if angle == 0.0:
        return GRAVITY.copy()
    return rotation_about(np.array([tilt[0], tilt[1], 0.0]) / angle, angle) @ GRAVITY


def displacement_of(layout: DisplacementLayout, vector: Array) -> Displacement:
    """Turn the vector (k,) into a displacement."""
    return Displacement(
        offset=vector[layout.at("offset")], compliance=vector[layout.at("compliance")], play=vector[layout.at("play")],
        twist=vector[layout.at("twist")].reshape(layout.joints + 1, 6), gravity=gravity_of(vector[layout.at("tilt")]),
        mass=1.0 + vector[layout.at("mass")], carry=vector[layout.at("carry")],
    )  # fmt: skip


def vector_of(layout: DisplacementLayout, displacement: Displacement) -> Array:
    """Turn a displacement into the vector; the pose of a frame is zero."""
    vector = np.zeros(layout.size)
    for name in ("offset", "compliance", "play", "carry"):
        vector[layout.at(name)] = getattr(displacement, name)
    vector[layout.at("mass")] = displacement.mass - 1.0
    vector[layout.at("tilt")] = tilt_of(displacement.gravity)
    vector[layout.at("twist")] = displacement.twist.ravel()
    return vector
