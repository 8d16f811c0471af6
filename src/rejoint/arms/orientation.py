"""How a tool is to be turned: its direction alone or its whole orientation, and how much that counts beside its place.

The *direction* of a tool is where its axis points: that axis of its frame along which it stands off the last joint,
z for a myCobot 280 and x for the gripper of an SO-101. An orientation error is a rotation vector in the base frame; its
length is the angle, and `rows` are its derivatives. Place and orientation are weighed as lengths: a radian counts for
as many metres as its weight says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array
from rejoint.arms.inverse import rotation_error
from rejoint.arms.kinematics import frames, position_kinematics
from rejoint.arms.loaded import bare

WEIGHT = 0.05
"""[m/rad] that an orientation counts where nothing else is said, so that a degree counts 0.9 mm (chosen on seven worn
arms: 0.03 leaves 0.6 deg at rest instead of 0.3, 0.1 takes four millimetres from the place where a joint is stuck)"""
REACHED_TURN = float(np.radians(5.0))
"""[rad] within which an orientation counts as reached (chosen: as far from what a repaired arm leaves as the 10 mm)"""
_OPPOSITE = 1e-6  # [rad] from half a turn within which every axis is as good as another


@dataclass(frozen=True, kw_only=True, eq=False)
class Orientation:
    """Orientations that tools are to have; the leading shape (...) is that of their places."""

    rotation: Array
    """(..., 3, 3) of the frame of the tool in the base frame"""
    whole: NDArray[np.bool_]
    """(...) whether the turn about the tool's own axis counts as well, and not its direction alone"""
    weight: Array
    """(...) [m/rad] 0 where the tool may be turned as it likes"""
    axis: Array
    """(3,) direction of the tool in its own frame, see `tool_axis`"""

    def __getitem__(self, index: Any) -> Orientation:  # noqa: ANN401 - whatever arrays take
        """Return some of them, by an index of the leading shape."""
        return replace(self, rotation=self.rotation[index], whole=self.whole[index], weight=self.weight[index])

    @property
    def flat(self) -> Orientation:
        """The same in one row."""
        rotation = self.rotation.reshape(-1, 3, 3)
        return replace(self, rotation=rotation, whole=self.whole.ravel(), weight=self.weight.ravel())

    @property
    def counts(self) -> NDArray[np.bool_]:
        """(...) where an orientation is asked for at all."""
        return np.asarray(self.weight > 0.0)

    def error(self, rotation: Array) -> Array:
        """Rotation vectors (..., 3) [rad] in the base frame that turn tools of ``rotation`` (..., 3, 3) as wanted."""
        about = _between(rotation @ self.axis, self.rotation @ self.axis)
        return np.where(self.whole[..., None], _turn(rotation, self.rotation), about)

    def angle(self, rotation: Array) -> Array:
        """Orientation errors (...) [rad], 0 to pi; NaN where none is asked for."""
        size = np.linalg.norm(self.error(rotation), axis=-1)
        return np.where(self.counts, size, np.nan)

    def rows(self, axes: Array) -> Array:
        """Return by how much (..., 3, n) joint motions turn the tool, of what counts; ``axes`` (..., n, 3) of joints.

        Near the orientation that is wanted they are the derivatives of the error, with the other sign.
        """
        columns = np.swapaxes(axes, -1, -2)
        own = np.broadcast_to(self.rotation @ self.axis, (*self.weight.shape, 3))
        along = own[..., :, None] * (own[..., None, :] @ columns)
        return columns - np.where(self.whole[..., None, None], 0.0, along)


def stacked(parts: Sequence[Orientation], axis: int) -> Orientation:
    """Return orientations side by side along a new ``axis`` of the leading shape."""
    return Orientation(
        rotation=np.stack([one.rotation for one in parts], axis), whole=np.stack([one.whole for one in parts], axis),
        weight=np.stack([one.weight for one in parts], axis), axis=parts[0].axis,
    )  # fmt: skip


def tool_axis(arm: Arm) -> Array:
    """Direction (3,) of a tool in its own frame: the axis of it along which the bare arm's tip stands off its joint."""
    tip = bare(arm).tip
    off = tip[:3, :3].T @ tip[:3, 3]
    if np.linalg.norm(off) < 1e-9:
        return np.array([0.0, 0.0, 1.0])
    found = np.zeros(3)
    largest = int(np.argmax(np.abs(off)))
    found[largest] = np.sign(off[largest])
    return found


def task(arm: Arm, q: Array, target: Array, turn: Orientation | None) -> tuple[Array, Array]:
    """Return what is missed at ``q`` (..., n) [rad], (..., k) [m], and its derivatives (..., k, n) with the other sign.

    k is 3 for the place ``target`` (..., 3) [m] alone; with a ``turn`` 6, where the last three are radians times their
    weight.
    """
    tcp, jacobian = position_kinematics(arm, q)
    if turn is None:
        return target - tcp, jacobian
    f, weight = frames(arm, q), turn.weight[..., None]
    error = np.concatenate([target - tcp, weight * turn.error(f.tcp_rotation)], axis=-1)
    return error, np.concatenate([jacobian, weight[..., None] * turn.rows(f.axis)], axis=-2)


def _turn(current: Array, wanted: Array) -> Array:
    """Rotation vectors (..., 3) [rad] from ``current`` to ``wanted`` (..., 3, 3), also where they are half a turn."""
    vector = rotation_error(current, wanted)
    relative = wanted @ np.swapaxes(current, -1, -2)
    opposite = np.trace(relative, axis1=-2, axis2=-1) < -1.0 + _OPPOSITE**2
    if not opposite.any():
        return vector
    columns = relative + np.eye(3)
    largest = np.argmax(np.diagonal(columns, axis1=-2, axis2=-1), axis=-1)
    axis = np.take_along_axis(columns, largest[..., None, None], axis=-1)[..., 0]
    half = np.pi * axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-12)
    return np.where(opposite[..., None], half, vector)


def _between(current: Array, wanted: Array) -> Array:
    """Smallest rotation vectors (..., 3) [rad] that turn the unit vectors ``current`` into ``wanted`` (..., 3)."""
    cross = np.cross(current, wanted)
    sine, cosine = np.linalg.norm(cross, axis=-1, keepdims=True), (current * wanted).sum(axis=-1, keepdims=True)
    angle = np.arctan2(sine, cosine)
    vector = cross * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 1.0)
    side = np.cross(current, np.where(np.abs(current[..., :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    side = np.pi * side / np.linalg.norm(side, axis=-1, keepdims=True)
    return np.where((sine <= 1e-9) & (cosine < 0.0), side, vector)
