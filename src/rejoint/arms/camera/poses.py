"""Poses of many things at once: rotation vectors, their derivatives, and inverses, over any leading shape."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array

_SMALL = 1e-6
"""[rad] below which series take the place of quotients (their next term is below the rounding)"""


def skew(vector: Array) -> Array:
    """Matrices (..., 3, 3) that form the vector products with ``vector`` (..., 3)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def turned(vector: Array) -> Array:
    """Rotations (..., 3, 3) by rotation vectors (..., 3) [rad]."""
    sine, versine, _ = _factors(vector)
    cross = skew(vector)
    return np.asarray(np.eye(3) + sine * cross + versine * cross @ cross)


def turning(vector: Array) -> Array:
    """Matrices (..., 3, 3): turning from base axes for each change of ``vector`` (..., 3) (left Jacobian of SO(3))."""
    _, versine, rest = _factors(vector)
    cross = skew(vector)
    return np.asarray(np.eye(3) + versine * cross + rest * cross @ cross)


def rotation_vector(rotation: Array) -> Array:
    """Rotation vectors (..., 3) [rad] of rotations (..., 3, 3), for angles below pi."""
    r = rotation
    sine = 0.5 * np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], axis=-1
    )
    size = np.linalg.norm(sine, axis=-1, keepdims=True)
    angle = np.arctan2(size, 0.5 * (np.trace(r, axis1=-2, axis2=-1)[..., None] - 1.0))
    return np.asarray(sine * np.where(size > _SMALL, angle / np.maximum(size, _SMALL), 1.0))


def moved(pose: Array, change: Array) -> Array:
    """Poses (..., 4, 4) shifted by the first three of ``change`` (..., 6) [m], turned on the spot by the rest [rad]."""
    new = np.array(np.broadcast_to(pose, (*np.broadcast_shapes(pose.shape[:-2], change.shape[:-1]), 4, 4)))
    new[..., :3, :3] = turned(change[..., 3:]) @ pose[..., :3, :3]
    new[..., :3, 3] = pose[..., :3, 3] + change[..., :3]
    return new


def inverse(pose: Array) -> Array:
    """Inverses (..., 4, 4) of poses (..., 4, 4)."""
    back = np.array(pose)
    back[..., :3, :3] = np.swapaxes(pose[..., :3, :3], -1, -2)
    back[..., :3, 3] = -(back[..., :3, :3] @ pose[..., :3, 3:])[..., 0]
    return back


def nearest_rotation(matrix: Array) -> Array:
    """Rotation (..., 3, 3) nearest to a matrix (..., 3, 3)."""
    left, _, right = np.linalg.svd(matrix)
    left[..., :, 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


def _factors(vector: Array) -> tuple[Array, Array, Array]:
    """Factors sin a / a, (1 - cos a) / a^2 and (a - sin a) / a^3, each (..., 1, 1), of the angles a of vectors."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    safe = np.maximum(angle, _SMALL)
    small = angle < _SMALL
    sine = np.where(small, 1.0, np.sin(safe) / safe)
    versine = np.where(small, 0.5, 2.0 * np.sin(0.5 * safe) ** 2 / safe**2)
    rest = np.where(angle < 1e-3, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    return sine, versine, rest
