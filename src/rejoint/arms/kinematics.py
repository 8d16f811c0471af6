"""Forward kinematics, Jacobian and gravity torque, vectorised over any leading shape."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rejoint.arms.arm import Arm, Array, frozen
from rejoint.system.shell import Late

GRAVITY = np.array([0.0, 0.0, -9.81])
"""[m/s^2] in the base frame, as in MuJoCo"""


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

_CYCLE = np.array([1, 2, 0, 1])  # coordinates in the order of a vector product: each with the one before it


class Chain(NamedTuple):
    """A kinematic chain in compiled loops; see `Arm`."""

    terms: Array
    """(n, 16, 3) as `joint_terms`"""
    tip: Array
    axes: Array
    limits: Array
    """(2, n) [rad]"""
    rest: Array
    mass: Array
    com: Array


@lru_cache(maxsize=32)
def chain_of(arm: Arm) -> Chain:
    """Return the chain of an arm."""
    limits = np.stack([arm.lower, arm.upper])
    return Chain(*map(frozen, (joint_terms(arm), arm.tip, arm.axis, limits, arm.rest, arm.mass, arm.com)))


def joint_terms(arm: Arm) -> Array:
    """Constants (n, 16, 3) A, B, C: a frame in its parent is A + B sin q + C cos q."""
    along = arm.axis[:, :, None] * arm.axis[:, None, :]
    cross = np.swapaxes(np.cross(arm.axis[:, None], np.eye(3)), 1, 2)
    terms = np.zeros((arm.joints, 4, 4, 3))
    for i, rotation in enumerate((along, cross, np.eye(3) - along)):  # Rodrigues
        terms[:, :3, :3, i] = arm.offset[:, :3, :3] @ rotation
    terms[..., 3, 0] = arm.offset[:, :, 3]
    return terms.reshape(arm.joints, 16, 3)


def all_poses(arm: Arm, q: Array, rows: int = 3) -> Array:
    """First ``rows`` of the frames of joints and TCP, (n + 1, r, 4, B), at ``q`` (..., n)."""
    angles = np.ascontiguousarray(q.reshape(-1, arm.joints).T)
    poses, chain = np.empty((arm.joints + 1, rows, 4, angles.shape[1])), chain_of(arm)
    compiled.fill_poses(chain.terms, chain.tip, np.sin(angles), np.cos(angles), poses)
    return poses


def frames(arm: Arm, q: Array) -> Frames:
    """All frames at ``q`` (..., n) [rad]."""
    n, lead = arm.joints, q.shape[:-1]
    poses = all_poses(arm, q)
    axes = (arm.axis[:, None, None] @ poses[:n, :, :3])[:, :, 0]
    joints = poses[:n].transpose(3, 0, 1, 2).reshape(*lead, n, 3, 4)
    tcp = poses[n].transpose(2, 0, 1).reshape(*lead, 3, 4)
    axis = axes.transpose(2, 0, 1).reshape(*lead, n, 3)
    return Frames(joints[..., :3], joints[..., 3], axis, tcp[..., :3], tcp[..., 3])


def heights(arm: Arm, q: Array) -> Array:
    """Heights (..., n + 1) [m] of joint frames and TCP at ``q`` (..., n) [rad]."""
    return _by_posture(arm, q)[..., 2, 3]


def tcp_position(arm: Arm, q: Array) -> Array:
    """TCP positions (..., 3) [m] at ``q`` (..., n) [rad]."""
    return _by_posture(arm, q)[..., -1, :, 3]


def tcp_pose(arm: Arm, q: Array) -> Array:
    """TCP poses (..., 4, 4) at ``q`` (..., n) [rad]."""
    return _by_posture(arm, q, 4)[..., -1, :, :]


def _by_posture(arm: Arm, q: Array, rows: int = 3) -> Array:
    """First ``rows`` of the frames of joints and TCP, (..., n + 1, r, 4)."""
    return all_poses(arm, q, rows).transpose(3, 0, 1, 2).reshape(*q.shape[:-1], arm.joints + 1, rows, 4)


def position_kinematics(arm: Arm, q: Array) -> tuple[Array, Array]:
    """TCP (..., 3) [m] and its derivatives (..., 3, n) [m/rad] at ``q`` (..., n) [rad]."""
    n, lead = arm.joints, q.shape[:-1]
    poses = all_poses(arm, q)
    columns = np.empty((3, n, poses.shape[-1]))
    compiled.fill_columns(chain_of(arm).axes, poses, columns)
    return poses[n, :, 3].T.reshape(*lead, 3), columns.transpose(2, 0, 1).reshape(*lead, 3, n)


def jacobian(arm: Arm, q: Array) -> Array:
    """Geometric Jacobian (..., 6, n) in the base frame: linear above angular velocity."""
    return np.concatenate([position_kinematics(arm, q)[1], np.swapaxes(frames(arm, q).axis, -1, -2)], axis=-2)


def gravity_torque(arm: Arm, q: Array, gravity: Array = GRAVITY) -> Array:
    """Return holding torques (..., n) [N m] against ``gravity`` (3,) [m/s^2] at ``q`` (..., n)."""
    f = frames(arm, q)
    com = f.position + np.einsum("...nij,nj->...ni", f.rotation, arm.com)
    # Of all that hangs on each joint: mass, and mass times lever.
    mass = np.cumsum(arm.mass[::-1])[::-1, None]
    first_moment = np.cumsum((arm.mass[:, None] * com)[..., ::-1, :], axis=-2)[..., ::-1, :] - mass * f.position
    return -(_cross(f.axis, first_moment) @ gravity)


def link_inertia(arm: Arm, q: Array) -> Array:
    """Inertias (..., n) [kg m^2] about each joint axis, of all that it moves, at ``q`` (..., n) [rad]."""
    f = frames(arm, q)
    com = f.position + np.einsum("...nij,nj->...ni", f.rotation, arm.com)
    inertia = f.rotation @ arm.inertia @ np.swapaxes(f.rotation, -1, -2)
    own = np.einsum("...ji,...kil,...jl->...jk", f.axis, inertia, f.axis)
    lever = np.cross(f.axis[..., :, None, :], com[..., None, :, :] - f.position[..., :, None, :])
    about = own + arm.mass * (lever**2).sum(axis=-1)
    return np.triu(about).sum(axis=-1)


def _cross(a: Array, b: Array) -> Array:
    """Vector products (..., 3), coordinates first inside; faster than `numpy.cross`."""
    x, y = a.T[_CYCLE], b.T[_CYCLE]
    return (x[:-1] * y[1:] - x[1:] * y[:-1]).T
