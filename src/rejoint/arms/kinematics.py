"""Kinematics, also with what encoders do not show; gravity torque; inverse kinematics by damped least squares.

Inverse kinematics: Park et al. 2024, eq. 11. Behind encoders are play, flex, zero errors, links and a tilted base:
weight presses a joint to one side of its play and bends it (Khalil and Dombre 2002, chapter 11).
"""

from __future__ import annotations

from dataclasses import field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rejoint.arms.arm import Arm, Array, Mask, freeze, frozen
from rejoint.arms.rotations import Orientation, moved
from rejoint.system.records import entity
from rejoint.system.shell import Late

GRAVITY = np.array([0.0, 0.0, -9.81])
"""[m/s^2] in the base frame, as in MuJoCo"""
DAMPING = 0.05
"""[m] lambda (Park et al. 2024, section III-C)"""
TOLERANCE, ROUNDS = 1e-5, 200
"""[m] and most steps (chosen)"""
MOST_STEP, REST_GAIN = float(np.radians(10.0)), 0.05
"""[rad] per joint and step; pull to rest per step (chosen)"""


class Frames(NamedTuple):
    """Frames of a posture, in the base frame."""

    rotation: Array
    """(..., n, 3, 3) joint frames"""
    position: Array
    """(..., n, 3) [m] joint origins"""
    axis: Array
    """(..., n, 3) joint axes"""
    tcp_rotation: Array
    """(..., 3, 3)"""
    tcp_position: Array
    """(..., 3) [m]"""


compiled = Late("rejoint.arms.compiled")


class Chain(NamedTuple):
    """A kinematic chain in compiled loops; see `Arm`."""

    terms: Array
    """(n, 3, 4, 4) as `joint_terms`"""
    tip: Array
    axes: Array
    limits: Array
    """(2, n) [rad]"""
    rest: Array
    mass: Array
    com: Array


@lru_cache
def chain_of(arm: Arm) -> Chain:
    """Return the chain of an arm."""
    limits = np.stack([arm.lower, arm.upper])
    return Chain(*map(frozen, (joint_terms(arm), arm.tip, arm.axis, limits, arm.rest, arm.mass, arm.com)))


def joint_terms(arm: Arm) -> Array:
    """Constants (n, 3, 4, 4) A, B, C: a frame in its parent is A + B sin q + C cos q."""
    along = arm.axis[:, :, None] * arm.axis[:, None, :]
    cross = np.cross(arm.axis[:, None], np.eye(3)).mT
    terms = np.zeros((arm.joints, 3, 4, 4))
    for i, rotation in enumerate((along, cross, np.eye(3) - along)):  # Rodrigues
        terms[:, i, :3, :3] = arm.offset[:, :3, :3] @ rotation
    terms[:, 0, :, 3] = arm.offset[:, :, 3]
    return terms


def rows_of(arm: Arm, q: Array) -> Array:
    """Postures (B, n) [rad] for compiled loops."""
    return np.ascontiguousarray(q.reshape(-1, arm.joints), dtype=float)


def all_poses(arm: Arm, q: Array) -> Array:
    """Poses (..., n + 1, 4, 4) of joints and TCP at ``q`` (..., n)."""
    return compiled.place_all(chain_of(arm), rows_of(arm, q)).reshape(*q.shape[:-1], arm.joints + 1, 4, 4)


def frames(arm: Arm, q: Array) -> Frames:
    """All frames at ``q`` (..., n) [rad]."""
    poses = all_poses(arm, q)
    rotation, place = poses[..., :3, :3], poses[..., :3, 3]
    joints = rotation[..., :-1, :, :]
    axis = (joints * arm.axis[:, None]).sum(axis=-1)
    return Frames(joints, place[..., :-1, :], axis, rotation[..., -1, :, :], place[..., -1, :])


def heights(arm: Arm, q: Array) -> Array:
    """Heights (..., n + 1) [m] of joint frames and TCP at ``q`` (..., n) [rad]."""
    return all_poses(arm, q)[..., 2, 3]


def tcp_position(arm: Arm, q: Array) -> Array:
    """TCP positions (..., 3) [m] at ``q`` (..., n) [rad]."""
    return all_poses(arm, q)[..., -1, :3, 3]


def tcp_pose(arm: Arm, q: Array) -> Array:
    """TCP poses (..., 4, 4) at ``q`` (..., n) [rad]."""
    return all_poses(arm, q)[..., -1, :, :]


def task(arm: Arm, q: Array, target: Array, turn: Orientation | None) -> tuple[Array, Array]:
    """Error at ``q`` (..., n) [rad], (..., k) [m], and minus its derivatives (..., k, n).

    k is 3 for ``target`` (..., 3) [m], 6 with a ``turn`` (weighted radians).
    """
    shape, rows = np.broadcast_shapes(q.shape[:-1], target.shape[:-1]), 3 if turn is None else 6
    each = np.zeros((*shape, 1))
    postures, goals = rows_of(arm, q + each), goals_of(target + each, turn).reshape(-1, 17)
    errors, jacobians = np.zeros((len(goals), rows)), np.zeros((len(goals), rows, arm.joints))
    compiled.fill_tasks(chain_of(arm), goals, postures, errors, jacobians)
    return errors.reshape(*shape, rows), jacobians.reshape(*shape, rows, arm.joints)


def position_kinematics(arm: Arm, q: Array) -> tuple[Array, Array]:
    """TCP (..., 3) [m] and its derivatives (..., 3, n) [m/rad] at ``q`` (..., n) [rad]."""
    missed, jacobian = task(arm, q, np.zeros(3), None)
    return 0.0 - missed, jacobian  # without a minus zero


def levers(arm: Arm, q: Array) -> Array:
    """Distances (..., n) [m/rad] by which the TCP moves per angle of each joint at ``q`` (..., n) [rad]."""
    return np.linalg.norm(position_kinematics(arm, q)[1], axis=-2)


def jacobian(arm: Arm, q: Array) -> Array:
    """Geometric Jacobian (..., 6, n) in the base frame: linear above angular velocity."""
    return np.concatenate([position_kinematics(arm, q)[1], frames(arm, q).axis.mT], axis=-2)


def gravity_torque(arm: Arm, q: Array, gravity: Array = GRAVITY) -> Array:
    """Return holding torques (..., n) [N m] against ``gravity`` (3,) [m/s^2] at ``q`` (..., n)."""
    return compiled.torques_all(chain_of(arm), rows_of(arm, q), np.array(gravity, dtype=float)).reshape(q.shape)


def link_inertia(arm: Arm, q: Array) -> Array:
    """Inertias (..., n) [kg m^2] about each joint axis, of all that it moves, at ``q`` (..., n) [rad]."""
    f = frames(arm, q)
    com = f.position + np.einsum("...nij,nj->...ni", f.rotation, arm.com)
    inertia = f.rotation @ arm.inertia @ f.rotation.mT
    own = np.einsum("...ji,...kil,...jl->...jk", f.axis, inertia, f.axis)
    lever = np.cross(f.axis[..., :, None, :], com[..., None, :, :] - f.position[..., :, None, :])
    about = own + arm.mass * (lever**2).sum(axis=-1)
    return np.triu(about).sum(axis=-1)


@entity
class Solution:
    """Result of an inverse-kinematics search."""

    q: Array
    """(..., n) [rad] within the joint limits"""
    converged: Mask
    """(...) error, and wanted orientation, within tolerance"""


def dls(jacobian: Array, error: Array, damping: float | Array = DAMPING) -> Array:
    """Damped least-squares step J'(JJ' + lambda^2 I)^-1 e, (..., n) [rad].

    ``jacobian`` (..., k, n), ``error`` (..., k), ``damping`` a number or (...).
    """
    transpose = jacobian.mT
    ridge = np.asarray(damping)[..., None, None] ** 2 * np.eye(jacobian.shape[-2])
    gram = jacobian @ transpose + ridge
    return (transpose @ np.linalg.solve(gram, error[..., None]))[..., 0]


def clip_norm(step: Array, limit: float | Array) -> Array:
    """Scale vectors (..., n) down to elements of ``limit`` at most, a number or (..., 1)."""
    largest = np.maximum.reduce(np.abs(step), axis=-1, keepdims=True)
    return step * np.minimum(1.0, limit / np.maximum(largest, 1e-12))


def goals_of(places: Array, turn: Orientation | None) -> Array:
    """Goals (..., 17), see `rejoint.arms.compiled`, of ``places`` (..., 3) [m] and orientations (...)."""
    goals = np.zeros((*places.shape[:-1], 17))
    goals[..., :3] = places
    if turn is not None:
        goals[..., 3:12] = turn.rotation.reshape(*turn.rotation.shape[:-2], 9)
        goals[..., 12:15], goals[..., 15] = turn.axis, turn.weight
        goals[..., 16] = turn.counts * np.where(turn.whole, 2.0, 1.0)
    return goals


def solve_position(
    arm: Arm,
    target: Array,
    start: Array,
    *,
    turn: Orientation | None = None,
    tolerance: float = TOLERANCE,
    iterations: int = ROUNDS,
    rest_gain: float = REST_GAIN,
) -> Solution:
    """Search joint positions of the TCP at ``target`` (..., 3) [m], from ``start`` (..., n) [rad].

    ``turn`` (...): wanted orientation. The null space pulls to rest. ``tolerance`` [m], weighted radians. Without a
    solution it ends at the least weighted sum of squares nearby.
    """
    shape = np.broadcast_shapes(target.shape[:-1], start.shape[:-1])
    q = rows_of(arm, start + np.zeros((*shape, arm.joints)))  # a copy, which the search moves
    goals, missed = goals_of(np.broadcast_to(target, (*shape, 3)), turn).reshape(-1, 17), np.empty(len(q))
    compiled.solve_all(chain_of(arm), goals, q, rest_gain, iterations, tolerance, missed)
    return Solution(q=q.reshape(*shape, arm.joints), converged=(missed < tolerance).reshape(shape))


FLOATING = 0.01
"""[m/s^2] of gravity that leaves a joint floating; chosen: in a base tilted by 0.06 degrees"""


@lru_cache
def floating(arm: Arm) -> float:
    """[N m] below which weight holds no joint at one side of its play, by the arm's mass and length."""
    length = np.linalg.norm([*arm.offset[:, :3, 3], arm.tip[:3, 3]], axis=1).sum()
    return FLOATING * (arm.mass.sum() * length) + np.finfo(float).tiny


@entity
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
        freeze(self)

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
        return position + self.offset - self.compliance * torque - 0.5 * self.play * np.tanh(torque / floating(arm))

    def floats(self, arm: Arm, position: Array) -> Array:
        """How far joints float (..., n) at encoder ``position`` (..., n) [rad]: 1 without load, 0 at one side."""
        return 1.0 - np.tanh(self.torque(arm, position) / floating(arm)) ** 2

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
