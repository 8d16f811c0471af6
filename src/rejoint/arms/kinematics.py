"""Forward kinematics, Jacobian and gravity torque, vectorised over any leading shape."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rejoint.arms.arm import Arm, Array
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


@lru_cache(maxsize=32)
def joint_terms(arm: Arm) -> Array:
    """Constants (n, 16, 3) A, B, C: a frame in its parent is A + B sin q + C cos q."""
    cross = np.zeros((arm.joints, 3, 3))
    x, y, z = arm.axis.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = z, -y, x
    square = cross @ cross  # Rodrigues: R = I + sin q K + (1 - cos q) K^2
    terms = np.zeros((arm.joints, 4, 4, 3))
    for i, rotation in enumerate((np.eye(3) + square, cross, -square)):
        terms[:, :3, :3, i] = arm.offset[:, :3, :3] @ rotation
    terms[..., 3, 0] = arm.offset[:, :, 3]
    return terms.reshape(arm.joints, 16, 3)


def all_poses(arm: Arm, q: Array, rows: slice) -> Array:
    """``rows`` of the frames of joints and TCP, (n + 1, r, 4, B), at ``q`` (..., n)."""
    angles = q.reshape(-1, arm.joints).T
    waves = np.empty((2, *angles.shape))
    np.sin(angles, out=waves[0])
    np.cos(angles, out=waves[1])
    poses = np.empty((arm.joints + 1, rows.stop - rows.start, 4, angles.shape[1]))
    compiled.fill_poses(joint_terms(arm), arm.tip, waves[0], waves[1], rows.start, poses)
    return poses


def frames(arm: Arm, q: Array) -> Frames:
    """All frames at ``q`` (..., n) [rad]."""
    n, lead = arm.joints, q.shape[:-1]
    poses = all_poses(arm, q, slice(0, 3))
    axes = (arm.axis[:, None, None] @ poses[:n, :, :3])[:, :, 0]
    joints = poses[:n].transpose(3, 0, 1, 2).reshape(*lead, n, 3, 4)
    tcp = poses[n].transpose(2, 0, 1).reshape(*lead, 3, 4)
    axis = axes.transpose(2, 0, 1).reshape(*lead, n, 3)
    return Frames(joints[..., :3], joints[..., 3], axis, tcp[..., :3], tcp[..., 3])


def heights(arm: Arm, q: Array) -> Array:
    """Heights (..., n + 1) [m] of joint frames and TCP at ``q`` (..., n) [rad]."""
    return all_poses(arm, q, slice(2, 3))[:, 0, 3].T.reshape(*q.shape[:-1], arm.joints + 1)


def tcp_position(arm: Arm, q: Array) -> Array:
    """TCP positions (..., 3) [m] at ``q`` (..., n) [rad]."""
    return all_poses(arm, q, slice(0, 3))[arm.joints, :, 3].T.reshape(*q.shape[:-1], 3)


def tcp_pose(arm: Arm, q: Array) -> Array:
    """TCP poses (..., 4, 4) at ``q`` (..., n) [rad]."""
    f = frames(arm, q)
    pose = np.zeros((*q.shape[:-1], 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = f.tcp_rotation, f.tcp_position, 1.0
    return pose


def position_kinematics(arm: Arm, q: Array) -> tuple[Array, Array]:
    """TCP (..., 3) [m] and its derivatives (..., 3, n) [m/rad] at ``q`` (..., n) [rad]."""
    n, lead = arm.joints, q.shape[:-1]
    poses = all_poses(arm, q, slice(0, 3))
    columns = np.empty((3, n, poses.shape[-1]))
    compiled.fill_columns(arm.axis, poses, columns)
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
    """Inertias (n,) [kg m^2] about each joint axis, of all that it moves, at ``q`` (n,) [rad]."""
    f = frames(arm, q)
    com = f.position + np.einsum("nij,nj->ni", f.rotation, arm.com)
    inertia = f.rotation @ arm.inertia @ np.swapaxes(f.rotation, -1, -2)
    own = np.einsum("ji,kil,jl->jk", f.axis, inertia, f.axis)
    lever = np.cross(f.axis[:, None, :], com[None, :, :] - f.position[:, None, :])
    about = own + arm.mass * (lever**2).sum(axis=-1)
    return np.triu(about).sum(axis=1)


def _cross(a: Array, b: Array) -> Array:
    """Vector products (..., 3), coordinates first inside; faster than `numpy.cross`."""
    x, y = a.T[_CYCLE], b.T[_CYCLE]
    return (x[:-1] * y[1:] - x[1:] * y[:-1]).T
