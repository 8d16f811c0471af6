"""The parameter vector of a calibration: entries, prior and bounds.

Torques and compliances scale with the arm's size, lengths with its reach (`rejoint.arms.workspace`).

The play of an unloaded joint is scatter, not a shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from rejoint.arms import Arm, Array, Displacement, frames, jacobian, tcp_pose
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
ANYWHERE = 3.0
"""[m] and [rad] sigma of a pose outside the arm around its first estimate"""

KINDS = ("offset", "compliance", "play", "mass", "tilt", "twist")
"""Parameters of an arm, in order"""


@dataclass(frozen=True, kw_only=True)
class DisplacementLayout:
    """Indices of the parameters of an arm of n joints."""

    joints: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of parameters of each of `KINDS`."""
        return *[self.joints] * 4, 2, 6 * (self.joints + 1)

    @property
    def body(self) -> int:
        """Number of the arm's parameters, with which the vector begins."""
        return sum(self.sizes)

    def at(self, name: str) -> slice:
        """Slice of one of `KINDS`."""
        place = KINDS.index(name)
        return slice(sum(self.sizes[:place]), sum(self.sizes[: place + 1]))

    def names(self) -> tuple[str, ...]:
        """Names of the arm's parameters, such as ``play 2``."""
        return tuple(f"{kind} {i + 1}" for kind, size in zip(KINDS, self.sizes, strict=True) for i in range(size))


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
    odds: float
    """log odds against the others"""


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


def belief(arm: Arm, case: PriorCase, outside: Array | None = None) -> Belief:
    """Prior of an arm in a case: mean, sigma and bounds of each kind; bounds are chosen.

    ``outside`` (o, o): precision of the parameters of the measuring device, zero and unbounded.
    """
    layout = DisplacementLayout(joints=arm.joints)
    mean, sigma, lower, upper = np.zeros((4, layout.body))
    stiff = torque_size(arm)
    soft, each = case.compliance / stiff, np.array([SHIFT * length_size(arm)] * 3 + [TURN] * 3)
    links = np.inf if case.twist else 0.0
    rows = {
        "offset": (0.0, OFFSET, -np.radians(6.0), np.radians(6.0)),
        "compliance": (soft, soft, 0.0, 0.3 / stiff),
        "play": (case.play, case.play_sigma, 0.0, np.radians(8.0)),
        "mass": (0.0, MASS, -0.5, 0.5),
        "tilt": (0.0, case.tilt, -np.radians(20.0), np.radians(20.0)),
        "twist": (0.0, np.tile(max(case.twist, 1e-3) * each, arm.joints + 1), -links, links),
    }
    for name, row in rows.items():
        for column, value in zip((mean, sigma, lower, upper), row, strict=True):
            column[layout.at(name)] = value
    more = np.zeros((0, 0)) if outside is None else outside
    free = np.full(len(more), np.inf)
    return Belief(
        mean=np.append(mean, np.zeros(len(more))),
        precision=block_diag(np.diag(sigma**-2.0), more),
        lower=np.append(lower, -free),
        upper=np.append(upper, free),
        odds=case.odds,
    )


def gravity_of(tilt: Array) -> Array:
    """Gravity (3,) [m/s^2] in a base tilted by ``tilt`` (2,) [rad]."""
    return turned(np.append(tilt, 0.0)) @ GRAVITY


def displacement_of(layout: DisplacementLayout, vector: Array) -> Displacement:
    """Displacement of the vector (k,)."""
    offset, compliance, play, mass, tilt, twist = (vector[layout.at(name)] for name in KINDS)
    links = twist.reshape(layout.joints + 1, 6)
    return Displacement(
        offset=offset, compliance=compliance, play=play, twist=links, gravity=gravity_of(tilt), mass=1.0 + mass
    )


def vector_of(layout: DisplacementLayout, displacement: Displacement) -> Array:
    """Turn a displacement into the arm's part of the vector."""
    own, down = displacement, [one / np.linalg.norm(one) for one in (GRAVITY, displacement.gravity)]
    parts = own.offset, own.compliance, own.play, own.mass - 1.0, between_directions(*down)[:2], own.twist.ravel()
    return np.concatenate([np.broadcast_to(part, size) for part, size in zip(parts, layout.sizes, strict=True)])


FLOOR = 0.5e-3
"""[m] over a myCobot 280's reach, sigma of unexplained displacement; chosen"""
SCATTER = 1.0 / 3.0
"""Variance of a floating joint over half its play squared: uniform distribution; chosen"""


_STEP = 1e-6  # [rad] for the derivative of the direction of gravity


def linearised(arm: Arm, layout: DisplacementLayout, vector: Array, position: Array) -> tuple[Array, Array]:
    """Tool (M, 4, 4) at ``position`` (M, n) [rad], and derivative (M, 6, body) of its shift and turn, base axes."""
    own, loads = displacement_of(layout, vector), link_loads(arm, position)
    torque = loads @ own.gravity @ own.mass
    side = np.tanh(torque / FLOATING)
    one, tilt = np.eye(arm.joints), vector[layout.at("tilt")]
    turns = [gravity_of(tilt + step) - gravity_of(tilt - step) for step in _STEP * np.eye(2)]
    by_load = [loads @ own.gravity, np.stack([loads @ turn @ own.mass for turn in turns], axis=-1) / (2 * _STEP)]
    # torque moves joints by flex and by the side of the play
    yielding = own.compliance + 0.5 * own.play * (1.0 - side**2) / FLOATING
    by_joint = [
        np.broadcast_to(one, (*torque.shape, arm.joints)),
        -torque[..., None] * one,
        -0.5 * side[..., None] * one,
    ]
    by_joint += [-yielding[..., None] * each for each in by_load]
    moved, joints = own.moved(arm), position + own.offset - own.compliance * torque - 0.5 * own.play * side
    slope = jacobian(moved, joints) @ np.concatenate(by_joint, axis=-1)
    return tcp_pose(moved, joints), np.concatenate([slope, _by_twist(moved, joints)], axis=-1)


def link_loads(arm: Arm, position: Array) -> Array:
    """Each link's weight on each joint: (M, n joints, n links, 3) [N m / (m/s^2)]."""
    f = frames(arm, position)
    com = f.position + np.einsum("mnij,nj->mni", f.rotation, arm.com)
    carried = np.triu(np.ones((arm.joints, arm.joints)))[..., None] * arm.mass[:, None]
    return -carried * np.cross(f.axis[:, :, None], com[:, None] - f.position[:, :, None])


def _by_twist(arm: Arm, joints: Array) -> Array:
    """Return derivative (M, 6, 6 n + 6) of the tool by small errors of the transforms."""
    f, first = frames(arm, joints), np.zeros((len(joints), 1, 3))
    before = np.concatenate([first[..., None] + np.eye(3), f.rotation], axis=1)  # frame before each transform
    lever = f.tcp_position[:, None] - np.concatenate([first, f.position], axis=1)
    swing = np.cross(lever[..., None], before, axisa=-2, axisb=-2, axisc=-2) * -1.0
    both = np.block([[before, swing], [np.zeros_like(before), before]])  # (M, n + 1, 6, 6)
    return np.moveaxis(both, 1, 2).reshape(len(joints), 6, 6 * (arm.joints + 1))


def scatter(arm: Arm, displacement: Displacement, position: Array, joint: float = 0.0) -> Array:
    """Covariance (..., 6, 6) of the tool's shift [m] and turn [rad] by floating joints at ``position`` (..., n) [rad].

    ``joint`` [rad]: unexplained sigma of every joint.
    """
    lever, free = jacobian(arm, position), 1.0 - np.tanh(displacement.torque(arm, position) / FLOATING) ** 2
    variance = SCATTER * (0.5 * displacement.play) ** 2 * free + joint**2
    return (lever * variance[..., None, :]) @ np.swapaxes(lever, -1, -2)


def floor_of(arm: Arm) -> float:
    """[m] sigma of each coordinate by unexplained displacement."""
    return FLOOR * length_size(arm)
