"""Forward kinematics, Jacobian and gravity torque, vectorised over any leading shape."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rejoint.arms.arm import Arm, Array

GRAVITY = np.array([0.0, 0.0, -9.81])
"""[m/s^2] in the base frame; MuJoCo's default value, so that models agree."""


class Frames(NamedTuple):
    """Joint frames and TCP frame of a posture, in the base frame."""

    rotation: Array
    """(..., n, 3, 3) orientation of the joint frames"""
    position: Array
    """(..., n, 3) [m] origins of the joint frames"""
    tcp_rotation: Array
    """(..., 3, 3)"""
    tcp_position: Array
    """(..., 3) [m]"""


@lru_cache(maxsize=32)
def _rotation_terms(arm: Arm) -> tuple[Array, Array, Array]:
    """Per joint the constants A, B, C with offset rotation @ Rot(axis, q) = A + B sin q + C cos q."""
    cross = np.zeros((arm.joints, 3, 3))
    x, y, z = arm.axis.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = z, -y, x
    square = cross @ cross  # Rodrigues: R = I + sin q K + (1 - cos q) K^2
    rotation = arm.offset[:, :3, :3]
    return rotation @ (np.eye(3) + square), rotation @ cross, -rotation @ square


def frames(arm: Arm, q: Array) -> Frames:
    """Compute all frames for joint positions ``q`` (..., n) [rad]."""
    fixed, sine, cosine = _rotation_terms(arm)
    local = np.empty((*q.shape, 3, 4))  # rotation and offset in the frame before
    local[..., :3] = fixed + np.sin(q)[..., None, None] * sine + np.cos(q)[..., None, None] * cosine
    local[..., 3] = arm.offset[:, :3, 3]
    pose = np.empty_like(local)
    pose[..., 0, :, :] = local[..., 0, :, :]
    for i in range(1, arm.joints):
        before = pose[..., i - 1, :, :]
        here = np.matmul(before[..., :3], local[..., i, :, :], out=pose[..., i, :, :])
        here[..., 3] += before[..., 3]
    rotation, position = pose[..., :3], pose[..., 3]
    last = rotation[..., -1, :, :]
    return Frames(rotation, position, last @ arm.tip[:3, :3], position[..., -1, :] + last @ arm.tip[:3, 3])


@lru_cache(maxsize=32)
def _height_terms(arm: Arm) -> Array:
    """Per joint the constants (n, 3, 10) A | B | C | offset that the last row of a rotation is multiplied with."""
    return np.concatenate([*_rotation_terms(arm), arm.offset[:, :3, 3:]], axis=-1)


def heights(arm: Arm, q: Array) -> Array:
    """Heights (..., n + 1) [m] of the joint frames and the TCP at ``q`` (..., n) [rad].

    These are the z of `frames`, for a quarter of the time where there are many postures.
    """
    flat = q.reshape(-1, arm.joints)
    sine, cosine = np.sin(flat)[..., None], np.cos(flat)[..., None]
    result = np.empty((len(flat), arm.joints + 1))
    row, height = np.broadcast_to([0.0, 0.0, 1.0], (len(flat), 3)), 0.0
    for i, terms in enumerate(_height_terms(arm)):
        product = row @ terms
        result[:, i] = height = height + product[:, 9]
        row = product[:, :3] + sine[:, i] * product[:, 3:6] + cosine[:, i] * product[:, 6:9]
    result[:, -1] = height + row @ arm.tip[:3, 3]
    return result.reshape(*q.shape[:-1], arm.joints + 1)


def tcp_position(arm: Arm, q: Array) -> Array:
    """TCP position (..., 3) [m] at joint positions ``q`` (..., n) [rad]."""
    return frames(arm, q).tcp_position


def tcp_pose(arm: Arm, q: Array) -> Array:
    """TCP pose (..., 4, 4) at joint positions ``q`` (..., n) [rad]."""
    f = frames(arm, q)
    pose = np.zeros((*q.shape[:-1], 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = f.tcp_rotation, f.tcp_position, 1.0
    return pose


def _axes(arm: Arm, f: Frames) -> Array:
    return np.einsum("...nij,nj->...ni", f.rotation, arm.axis)


def position_jacobian(arm: Arm, f: Frames) -> Array:
    """d(TCP position)/dq (..., 3, n) [m/rad] from already computed frames."""
    lever = np.swapaxes(f.tcp_position[..., None, :] - f.position, -1, -2)
    axes = np.swapaxes(_axes(arm, f), -1, -2)
    # axes x lever, written out: np.cross costs twice as much for a single arm
    result = np.empty_like(lever)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[..., i, :] = axes[..., j, :] * lever[..., k, :] - axes[..., k, :] * lever[..., j, :]
    return result


def jacobian(arm: Arm, q: Array) -> Array:
    """Geometric Jacobian (..., 6, n): linear velocity [m/rad] above angular velocity, base frame."""
    f = frames(arm, q)
    angular = np.swapaxes(_axes(arm, f), -1, -2)
    return np.concatenate([position_jacobian(arm, f), angular], axis=-2)


def gravity_torque(arm: Arm, q: Array) -> Array:
    """Torque (..., n) [N m] with which the motors hold the arm against gravity at ``q`` (..., n)."""
    f = frames(arm, q)
    axes = _axes(arm, f)
    com = f.position + np.einsum("...nij,nj->...ni", f.rotation, arm.com)
    torque = np.zeros(q.shape)
    for i in range(arm.joints):
        weight = arm.mass[i:, None] * GRAVITY
        moment = np.cross(com[..., i:, :] - f.position[..., i : i + 1, :], weight).sum(axis=-2)
        torque[..., i] = -(axes[..., i, :] * moment).sum(axis=-1)
    return torque
