"""A lens with Brown's distortion as in OpenCV, and the pose of a board before it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from rejoint.arms import Array
from rejoint.arms.rotations import pose_of, rotation_error, turned

TERMS = ("f", "cx", "cy", "k1", "k2", "p1", "p2")
"""Names in `Lens.numbers`"""
CORNER = 0.15
"""[px] deviation of a coordinate in a sharp image"""
FLAT = 0.6
"""[px] rms residual that a view of a flat board may have in any case; chosen"""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A camera of square pixels."""

    width: int
    """[px]"""
    height: int
    """[px]"""
    f: float
    """[px]"""
    cx: float
    """[px] optical axis"""
    cy: float
    k1: float = 0.0
    """radial distortion"""
    k2: float = 0.0
    p1: float = 0.0
    """tangential"""
    p2: float = 0.0

    @classmethod
    def usual(cls, width: int, height: int) -> Lens:
        """Lens of a web camera, 70 degrees wide."""
        return cls(width=width, height=height, f=0.72 * width, cx=0.5 * (width - 1), cy=0.5 * (height - 1))

    @property
    def numbers(self) -> Array:
        """(7,) its `TERMS`."""
        return np.array([getattr(self, name) for name in TERMS])

    def with_numbers(self, numbers: Array) -> Lens:
        """Return same image, other `TERMS` (7,)."""
        return replace(self, **dict(zip(TERMS, map(float, numbers), strict=True)))

    @property
    def matrix(self) -> Array:
        """(3, 3) as in OpenCV."""
        return np.array([[self.f, 0.0, self.cx], [0.0, self.f, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Array:
        """(4,) as in OpenCV."""
        return self.numbers[3:]

    def project(self, point: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) [m] in the camera frame."""
        flat = np.reshape(point, (-1, 3))
        return self.slopes(flat, np.eye(4))[0].reshape(*np.shape(point)[:-1], 2) if len(flat) else np.zeros((0, 2))

    def slopes(self, corners: Array, pose: Array) -> tuple[Array, Array, Array]:
        """Pixels (K, 2) of ``corners`` (K, 3) [m] of a board at ``pose`` (4, 4) in the camera frame.

        Also derivatives by shift [m] and turn [rad] on the spot in camera axes, (2 K, 6), and by `TERMS`, (2 K, 7).
        """
        points, place = corners @ pose[:3, :3].T, pose[:3, 3]
        points[:, 2] = np.maximum(points[:, 2], 1e-3 - place[2])  # behind the camera nothing is seen
        pixel, slope = cv2.projectPoints(points, np.zeros(3), place, self.matrix, self.distortion)
        by_pose = np.concatenate([slope[:, 3:6], slope[:, :3]], axis=1)
        return pixel[:, 0], by_pose, np.concatenate([slope[:, 6:7] + slope[:, 7:8], slope[:, 8:14]], axis=1)

    def shows(self, pixel: Array, margin: float = 0.0) -> Array:
        """Which pixels (..., 2) are ``margin`` [px] inside the image."""
        size = np.array([self.width, self.height]) - 1.0
        return np.asarray(((pixel >= margin) & (pixel <= size - margin)).all(axis=-1))


class Placed(NamedTuple):
    """A board before a camera."""

    pose: Array
    """(4, 4) in the camera frame"""
    covariance: Array
    """(6, 6) of shift [m] and turn [rad], camera axes, for `CORNER`"""
    rms: float
    """[px] residual per coordinate"""


def place(lens: Lens, corners: Array, pixel: Array, near: Array | None = None) -> Placed:
    """Pose of a board with ``corners`` (K, 3) [m], not on a line, at ``pixel`` (K, 2).

    A flat board far away looks alike in two tilts (Schweighofer and Pinz, 2006). Both are tried. Of those that fit, the
    nearest to ``near`` (4, 4) wins; without it the best.
    """
    seen = (np.asarray(corners), np.asarray(pixel), lens.matrix, lens.distortion)
    _, turns, shifts, _ = cv2.solvePnPGeneric(*seen, flags=cv2.SOLVEPNP_IPPE)
    starts = list(zip(turns, shifts, strict=True))
    if near is not None:
        starts.append((cv2.Rodrigues(near[:3, :3])[0], near[:3, 3:].copy()))
    found = [_placed(lens, corners, pixel, *cv2.solvePnPRefineLM(*seen, *start)) for start in starts]
    best = min(found, key=lambda one: one.rms)
    if near is None:
        return best
    fitting = [one for one in found if one.rms <= max(best.rms, FLAT)]
    return min(fitting, key=lambda one: float(np.linalg.norm(rotation_error(one.pose[:3, :3], near[:3, :3]))))


def _placed(lens: Lens, corners: Array, pixel: Array, turn: Array, shift: Array) -> Placed:
    pose = pose_of(turned(turn[:, 0]), shift[:, 0])
    told, slope, _ = lens.slopes(corners, pose)
    residual = (told - pixel).ravel()
    spread = CORNER**2 * np.linalg.inv(slope.T @ slope + 1e-12 * np.eye(6))
    rms = float(np.sqrt(residual @ residual / max(len(residual) - 6, 1)))
    return Placed(pose=pose, covariance=np.asarray(spread), rms=rms)
