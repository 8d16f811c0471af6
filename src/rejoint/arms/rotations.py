"""Rotations, poses and quaternions (w, x, y, z)."""

from __future__ import annotations

import numpy as np

from rejoint.arms.arm import Array


def cross_matrix(vector: Array) -> Array:
    """Matrix (3, 3) that forms the cross product with ``vector`` (3,)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_about(axis: Array, angle: float) -> Array:
    """Rotation (3, 3) by ``angle`` [rad] about the unit vector ``axis`` (3,), after Rodrigues."""
    cross = cross_matrix(axis)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def rotation_of(quaternion: Array) -> Array:
    """Rotation (3, 3) of a quaternion (4,) of any length but zero."""
    w, *vector = quaternion / np.linalg.norm(quaternion)
    cross = cross_matrix(np.array(vector))
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def quaternion_of(rotation: Array) -> Array:
    """Find the unit quaternion (4,) of a rotation (3, 3).

    Each row of the matrix below is four times the quaternion times one of its components; the row of
    the largest component loses no digits.
    """
    r = rotation
    xx, yy, zz = r.diagonal()
    products = np.array([
        [1 + xx + yy + zz, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], 1 + xx - yy - zz, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 - xx + yy - zz, r[1, 2] + r[2, 1]],
        [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - xx - yy + zz],
    ])  # fmt: skip
    row = products[np.argmax(products.diagonal())]
    return row / np.linalg.norm(row)


def same_side(quaternions: Array) -> Array:
    """Return quaternions (K, 4), each with the sign that is nearer to the one before it: both signs mean the same."""
    turned = (quaternions[1:] * quaternions[:-1]).sum(axis=-1) < 0.0
    return quaternions * np.concatenate([[1.0], np.cumprod(np.where(turned, -1.0, 1.0))])[:, None]


def pose_of(rotation: Array, position: Array) -> Array:
    """Pose (4, 4) from a rotation (3, 3) and a position (3,) [m]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def inverse(pose: Array) -> Array:
    """Inverse (4, 4) of a pose (4, 4)."""
    turn = pose[:3, :3].T
    return pose_of(turn, -turn @ pose[:3, 3])
