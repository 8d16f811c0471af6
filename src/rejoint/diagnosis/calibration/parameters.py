"""The parameter vector of a calibration: entries, prior and bounds.

Torques and compliances scale with the arm's size, lengths with its reach (`rejoint.arms.workspace`).

Gravity presses a loaded joint to one flank of its play. An unloaded joint floats: its play is anisotropic scatter, not
a shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from rejoint.arms import Arm, Array, Displacement, frames, position_kinematics
from rejoint.arms.displacement import FLOATING
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import between_directions, turned
from rejoint.arms.workspace import length_size, torque_size

OFFSET = np.radians(0.6)
"""[rad] sigma of an encoder's zero; chosen"""
COMPLIANCE = 0.015
"""[rad/(N m)] mean and sigma of a joint's compliance on a myCobot 280; chosen"""
PLAY, PLAY_SIGMA = np.radians(0.9), np.radians(0.7)
"""[rad] mean and sigma of a joint's play (SO-ARM100 issue 134: about 1 deg on healthy servos)"""
LEVEL, ASKEW = np.radians(0.1), np.radians(6.0)
"""[rad] sigma of the tilt per horizontal axis, on a table and tilted; chosen"""
MASS = 0.12
"""Relative sigma of each link's mass; chosen"""
SHIFT, TURN = 1e-3, np.radians(0.3)
"""[m] over a myCobot 280's reach, and [rad]: sigma of each link's description; chosen"""
PLACE, ORIENTATION = 1.0, 3.0
"""[m] and [rad] sigma of a measuring frame around its first estimate"""

KINDS = ("offset", "compliance", "play", "mass", "tilt", "twist")
"""Parameters of an arm, in order"""


@dataclass(frozen=True, kw_only=True)
class DisplacementLayout:
    """Indices of the parameters of an arm of n joints."""

    joints: int
    frame: bool = False
    """whether the measuring frame's six parameters come last"""

    @property
    def size(self) -> int:
        """Length k of the vector."""
        return self.at("frame").stop

    @property
    def body(self) -> int:
        """Number of the arm's parameters."""
        return self.at("frame").start

    def at(self, name: str) -> slice:
        """Slice of one of `KINDS`, or ``frame``."""
        sizes = (*[self.joints] * 4, 2, 6 * (self.joints + 1), 6 * self.frame)
        place = (*KINDS, "frame").index(name)
        return slice(sum(sizes[:place]), sum(sizes[: place + 1]))

    def names(self) -> tuple[str, ...]:
        """Names of the arm's parameters, such as ``play 2``."""
        return tuple(f"{kind} {i + 1}" for kind in KINDS for i in range(self.at(kind).stop - self.at(kind).start))


@dataclass(frozen=True, kw_only=True, eq=False)
class Belief:
    """A normal distribution over the vector (k,), truncated at bounds."""

    mean: Array
    """(k,)"""
    precision: Array
    """(k, k) inverse covariance"""
    lower: Array
    """(k,)"""
    upper: Array
    """(k,)"""


@dataclass(frozen=True, kw_only=True)
class PriorCase:
    """A kind of arm with its prior."""

    play: float = PLAY
    """[rad]"""
    play_sigma: float = PLAY_SIGMA
    """[rad]"""
    compliance: float = COMPLIANCE
    """[rad/(N m)] mean and sigma for a myCobot 280's size"""
    tilt: float = LEVEL
    """[rad] sigma"""
    twist: float = 0.0
    """scale of the errors of the arm's description"""
    odds: float = 0.0
    """log odds against the others"""


def belief(arm: Arm, layout: DisplacementLayout, case: PriorCase) -> Belief:
    """Prior of an arm in a case: mean, sigma and bounds of each kind; bounds are chosen."""
    mean, sigma, lower, upper = np.zeros((4, layout.size))
    stiff = torque_size(arm)
    soft, each = case.compliance / stiff, np.array([SHIFT * length_size(arm)] * 3 + [TURN] * 3)
    wide, links = np.inf, np.inf if case.twist else 0.0
    told: dict[str, tuple[float, float | Array, float, float]] = {
        "offset": (0.0, OFFSET, -np.radians(6.0), np.radians(6.0)),
        "compliance": (soft, soft, 0.0, 0.3 / stiff),
        "play": (case.play, case.play_sigma, 0.0, np.radians(8.0)),
        "mass": (0.0, MASS, -0.5, 0.5),
        "tilt": (0.0, case.tilt, -np.radians(20.0), np.radians(20.0)),
        "twist": (0.0, np.tile(max(case.twist, 1e-3) * each, arm.joints + 1), -links, links),
        "frame": (0.0, np.array([PLACE] * 3 + [ORIENTATION] * 3)[: 6 * layout.frame], -wide, wide),
    }
    for name, row in told.items():
        for column, value in zip((mean, sigma, lower, upper), row, strict=True):
            column[layout.at(name)] = value
    return Belief(mean=mean, precision=np.diag(sigma**-2.0), lower=lower, upper=upper)


def tilt_of(gravity: Array) -> Array:
    """Rotation (2,) [rad] about the base's x and y axes from `GRAVITY` to ``gravity`` (3,)."""
    return between_directions(GRAVITY / np.linalg.norm(GRAVITY), gravity / np.linalg.norm(gravity))[:2]


def gravity_of(tilt: Array) -> Array:
    """Gravity (3,) [m/s^2] in a base tilted by ``tilt`` (2,) [rad]."""
    return turned(np.append(tilt, 0.0)) @ GRAVITY


def displacement_of(layout: DisplacementLayout, vector: Array) -> Displacement:
    """Displacement of the vector (k,)."""
    return Displacement(
        offset=vector[layout.at("offset")],
        compliance=vector[layout.at("compliance")],
        play=vector[layout.at("play")],
        twist=vector[layout.at("twist")].reshape(layout.joints + 1, 6),
        gravity=gravity_of(vector[layout.at("tilt")]),
        mass=1.0 + vector[layout.at("mass")],
    )


def vector_of(layout: DisplacementLayout, displacement: Displacement) -> Array:
    """Turn a displacement into the vector, with zero pose."""
    own, vector = displacement, np.zeros(layout.size)
    parts = (own.offset, own.compliance, own.play, own.mass - 1.0, tilt_of(own.gravity), own.twist.ravel())
    for name, part in zip(KINDS, parts, strict=True):
        vector[layout.at(name)] = part
    return vector


FLOOR = 0.5e-3
"""[m] over a myCobot 280's reach, sigma of unexplained displacement; chosen"""
SCATTER = 1.0 / 3.0
"""Variance of a floating joint over half its play squared: uniform distribution; chosen"""
_STEP = 1e-6  # [rad] for the derivative of the direction of gravity
_DRAWS = ndtri((np.arange(64) + 0.5) / 64)  # of a torque that is not known exactly


def linearised(
    arm: Arm,
    layout: DisplacementLayout,
    vector: Array,
    position: Array,
    *,
    flanks: bool = True,
) -> tuple[Array, Array]:
    """Tool (M, 3) [m] at ``position`` (M, n) [rad] and its derivative (M, 3, k) by the parameters.

    ``flanks``: with changes of flank, whose slope holds within `FLOATING`.
    """
    displacement = displacement_of(layout, vector)
    moved, loads = displacement.moved(arm), link_loads(arm, position)
    torque = loads @ displacement.gravity @ displacement.mass
    side = np.tanh(torque / FLOATING)
    joints = position + displacement.offset - displacement.compliance * torque - 0.5 * displacement.play * side
    tool, lever = position_kinematics(moved, joints)
    derivative = np.zeros((*position.shape[:-1], 3, layout.body))
    derivative[..., layout.at("offset")] = lever
    derivative[..., layout.at("compliance")] = -lever * torque[:, None, :]
    derivative[..., layout.at("play")] = -0.5 * lever * side[:, None, :]
    # torque moves joints by flex and by the side of the play
    turning = 0.5 * displacement.play * (1.0 - side**2) / FLOATING
    yielding = -lever * (displacement.compliance + flanks * turning)[:, None, :]
    slopes = torque_slopes(layout, vector, loads)
    for name in ("mass", "tilt"):
        derivative[..., layout.at(name)] = yielding @ slopes[..., layout.at(name)]
    if len(position):
        derivative[..., layout.at("twist")] = _by_twist(moved, joints, tool)
    return tool, derivative


def torque_slopes(layout: DisplacementLayout, vector: Array, loads: Array) -> Array:
    """Return derivative (M, n, k) [N m] of the torques, from `link_loads`."""
    displacement, tilt = displacement_of(layout, vector), vector[layout.at("tilt")]
    slopes = np.zeros((*loads.shape[:2], layout.body))
    slopes[..., layout.at("mass")] = loads @ displacement.gravity
    for i, step in enumerate(_STEP * np.eye(2)):
        turn = (gravity_of(tilt + step) - gravity_of(tilt - step)) / (2 * _STEP)
        slopes[..., layout.at("tilt").start + i] = loads @ turn @ displacement.mass
    return slopes


def link_loads(arm: Arm, position: Array) -> Array:
    """Each link's weight on each joint: (M, n joints, n links, 3) [N m / (m/s^2)]."""
    f = frames(arm, position)
    com = f.position + np.einsum("mnij,nj->mni", f.rotation, arm.com)
    away = com[:, None] - f.position[:, :, None]
    carried = np.triu(np.ones((arm.joints, arm.joints)))[..., None] * arm.mass[:, None]
    return -carried * np.cross(f.axis[:, :, None], away)


def _by_twist(arm: Arm, joints: Array, tool: Array) -> Array:
    """Return derivative (M, 3, 6 n + 6) of the tool by small errors of the transforms."""
    f, count = frames(arm, joints), len(joints)
    first = np.broadcast_to(np.eye(3), (count, 1, 3, 3))
    turned = np.concatenate([first, f.rotation], axis=1)  # frame before each transform
    place = np.concatenate([np.zeros((count, 1, 3)), f.position], axis=1)
    axes = np.swapaxes(turned, -1, -2)  # (M, n + 1, 3 axes, 3)
    swing = np.cross(axes, (tool[:, None] - place)[:, :, None, :])
    both = np.concatenate([axes, swing], axis=2)  # (M, n + 1, 6, 3)
    return np.moveaxis(both.reshape(count, 6 * (arm.joints + 1), 3), 1, 2)


def scatter(arm: Arm, displacement: Displacement, position: Array, doubt: Array | None = None) -> Array:
    """Covariance (..., 3, 3) [m^2] of the tool by floating joints at ``position`` (..., n) [rad].

    ``doubt`` (..., n) [N m], sigma of each torque, adds joints that may be on the other flank.
    """
    lever = position_kinematics(arm, position)[1]
    variance = play_variance(displacement, displacement.torque(arm, position), doubt)
    return np.asarray((lever * variance[..., None, :]) @ np.swapaxes(lever, -1, -2))


def play_variance(displacement: Displacement, torque: Array, doubt: Array | None = None) -> Array:
    """Variance (..., n) [rad^2] of floating joints under ``torque`` (..., n) [N m]; ``doubt``: see `scatter`."""
    side = np.tanh(torque / FLOATING)
    free, other = 1.0 - side**2, np.zeros_like(side)
    if doubt is not None:
        sides = np.tanh((torque[..., None] + doubt[..., None] * _DRAWS) / FLOATING)
        free = (1.0 - sides**2).mean(axis=-1)
        other = ((sides - side[..., None]) ** 2).mean(axis=-1)
    return np.asarray((0.5 * displacement.play) ** 2 * (SCATTER * free + other))


def floor_of(arm: Arm) -> float:
    """[m] sigma of each coordinate by unexplained displacement."""
    return FLOOR * length_size(arm)
