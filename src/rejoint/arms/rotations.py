"""Rotations, poses, quaternions (w, x, y, z), and wanted orientations of tools.

The *direction* of a tool is its axis away from the last joint. Orientation errors are rotation vectors in the base
frame, weighted in m/rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rejoint.arms.arm import Arm, Array, Mask
from rejoint.arms.inertia import bare
from rejoint.system.records import entity, taken


def turned(vector: Array) -> Array:
    """Rotations (..., 3, 3) by rotation vectors (..., 3) [rad]."""
    flat = np.array(vector, dtype=float).reshape(-1, 3)  # a copy: scipy takes no read-only array
    return Rotation.from_rotvec(flat).as_matrix().reshape(*np.shape(vector), 3)


def rotation_error(current: Array, wanted: Array) -> Array:
    """Rotation vectors (..., 3) [rad] from ``current`` to ``wanted`` (..., 3, 3)."""
    rotation = wanted @ current.mT
    flat = rotation.reshape(-1, 3, 3)
    found, known = np.full((len(flat), 3), np.nan), np.isfinite(flat).all(axis=(1, 2))
    found[known] = Rotation.from_matrix(flat[known]).as_rotvec()
    return found.reshape(rotation.shape[:-1])


def between_directions(current: Array, wanted: Array) -> Array:
    """Smallest rotation vectors (..., 3) [rad] from ``current`` to ``wanted`` unit vectors (..., 3)."""
    cross = np.cross(current, wanted)
    sine, cosine = np.linalg.norm(cross, axis=-1, keepdims=True), (current * wanted).sum(axis=-1, keepdims=True)
    vector = cross * np.where(sine > 1e-9, np.arctan2(sine, cosine) / np.maximum(sine, 1e-12), 1.0)
    side = np.cross(current, np.where(np.abs(current[..., :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    half = np.pi * side / np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-12)
    return np.where((sine <= 1e-9) & (cosine < 0.0), half, vector)


def rotation_of(quaternion: Array) -> Array:
    """Rotations (..., 3, 3) of quaternions (..., 4) of any length."""
    flat = Rotation.from_quat(np.reshape(quaternion, (-1, 4)), scalar_first=True)
    return flat.as_matrix().reshape(*np.shape(quaternion)[:-1], 3, 3)


def quaternion_of(rotation: Array) -> Array:
    """Return unit quaternions (..., 4) of rotations (..., 3, 3)."""
    flat = Rotation.from_matrix(np.reshape(rotation, (-1, 3, 3)))
    return flat.as_quat(scalar_first=True).reshape(*np.shape(rotation)[:-2], 4)


def same_side(quaternions: Array) -> Array:
    """Quaternions (K, 4), each on the side of the one before."""
    opposite = (quaternions[1:] * quaternions[:-1]).sum(axis=-1) < 0.0
    return quaternions * np.append(1.0, np.cumprod(np.where(opposite, -1.0, 1.0)))[:, None]


def pose_of(rotation: Array, position: Array) -> Array:
    """Poses (..., 4, 4) of rotations (..., 3, 3) and positions (..., 3)."""
    pose = np.zeros((*np.shape(position)[:-1], 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rotation, position, 1.0
    return pose


def inverse(pose: Array) -> Array:
    """Inverses (..., 4, 4) of poses (..., 4, 4)."""
    return np.asarray(np.linalg.inv(pose))


def moved(pose: Array, change: Array) -> Array:
    """Poses (..., 4, 4) shifted [m] and turned on the spot [rad] by ``change`` (..., 6)."""
    return pose_of(turned(change[..., 3:]) @ pose[..., :3, :3], pose[..., :3, 3] + change[..., :3])


def difference(seen: Array, told: Array) -> Array:
    """Shift [m] and turn [rad] (..., 6), base axes, from poses ``told`` to ``seen`` (..., 4, 4)."""
    turn = rotation_error(told[..., :3, :3], seen[..., :3, :3])
    return np.concatenate([seen[..., :3, 3] - told[..., :3, 3], turn], axis=-1)


WEIGHT = 0.05
"""[m/rad] default (chosen: a degree counts 0.9 mm)"""
REACHED_TURN = float(np.radians(5.0))
"""[rad] (chosen)"""


_EACH = ("rotation", "whole", "weight")
"""Fields of `Orientation` with its leading shape"""


@entity
class Orientation:
    """Wanted tool orientations; leading shape (...)."""

    rotation: Array
    """(..., 3, 3) tool frame in the base frame"""
    whole: Mask
    """(...) the turn about the tool axis counts"""
    weight: Array
    """(...) [m/rad] 0: any orientation"""
    axis: Array
    """(3,) tool axis in the tool frame, see `tool_axis`"""

    def __getitem__(self, index: Any) -> Orientation:  # noqa: ANN401 - whatever arrays take
        """Select by an index of the leading shape."""
        return taken(self, _EACH, index)

    @property
    def counts(self) -> Mask:
        """(...) where an orientation is wanted."""
        return self.weight > 0.0


def stacked(parts: Sequence[Orientation], axis: int) -> Orientation:
    """Stack along a new leading ``axis``."""
    each = {name: np.stack([getattr(one, name) for one in parts], axis) for name in _EACH}
    return replace(parts[0], **each)


def tool_axis(arm: Arm) -> Array:
    """Tool axis (3,) in the tool frame."""
    tip = bare(arm).tip
    off = tip[:3, :3].T @ tip[:3, 3]
    largest = np.argmax(np.abs(off)) if np.linalg.norm(off) >= 1e-9 else 2
    return np.eye(3)[largest] * (-1.0 if off[largest] < -1e-9 else 1.0)


def roll_pitch_yaw(rotation: Array) -> Array:
    """Angles (3,) rx, ry, rz [rad] of a rotation R = Rz Ry Rx, as in URDF; rx is 0 at ry = +-90 deg."""
    rx = np.arctan2(rotation[2, 1], rotation[2, 2]) if np.hypot(*rotation[2, 1:]) > 1e-9 else 0.0
    rest = rotation @ turned(np.array([-rx, 0.0, 0.0]))
    return np.array([rx, np.arctan2(-rest[2, 0], rest[2, 2]), np.arctan2(-rest[0, 1], rest[1, 1])])


def to_coords(pose: Array) -> Array:
    """Position [m] and `roll_pitch_yaw` [rad] of a pose, (6,)."""
    return np.concatenate([pose[:3, 3], roll_pitch_yaw(pose[:3, :3])])


def to_pose(coords: Array) -> Array:
    """Inverse of `to_coords`."""
    return pose_of(Rotation.from_euler("xyz", np.array(coords[3:])).as_matrix(), coords[:3])
