"""A lens with Brown's distortion as in OpenCV, and the pose of a board.

A flat board far away looks alike in two tilts (Schweighofer and Pinz, 2006): both are tried.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rejoint.arms import Array
from rejoint.arms.rotations import turned
from rejoint.system.errors import InputError
from rejoint.system.extras import require

TERMS = ("f", "cx", "cy", "k1", "k2", "p1", "p2")
"""Names in `Lens.numbers`"""


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

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or not self.f > 0.0:
            raise InputError(
                f"lens: expected a picture and a focal length above 0 px, got {self.width} x {self.height}, f {self.f}"
            )

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
        return Lens(width=self.width, height=self.height, **dict(zip(TERMS, map(float, numbers), strict=True)))

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
        return self.slopes(np.reshape(point, (-1, 3)), np.zeros(3))[0].reshape(*np.shape(point)[:-1], 2)

    def slopes(self, lever: Array, place: Array) -> tuple[Array, Array, Array]:
        """Pixels (K, 2) of points at ``lever`` (K, 3) from ``place`` (3,) [m], camera axes.

        Also derivatives by shift [m] and turn [rad], (K, 2, 6), and by `TERMS`, (K, 2, 7).
        """
        require("a camera", "camera")
        import cv2

        if not len(lever):
            return np.zeros((0, 2)), np.zeros((0, 2, 6)), np.zeros((0, 2, 7))
        points = np.array(lever, dtype=float)
        points[:, 2] = np.maximum(points[:, 2], 1e-3 - place[2])  # behind the camera nothing is seen
        pixel, slope = cv2.projectPoints(points, np.zeros(3), place, self.matrix, self.distortion)
        slope = slope.reshape(-1, 2, slope.shape[1])
        by_terms = np.concatenate([slope[..., 6:7] + slope[..., 7:8], slope[..., 8:14]], axis=-1)
        return pixel[:, 0], np.concatenate([slope[..., 3:6], slope[..., :3]], axis=-1), by_terms

    def rays(self, pixel: Array) -> Array:
        """Points (..., 2) at distance 1 on the optical axis, of ``pixel`` (..., 2)."""
        require("a camera", "camera")
        import cv2

        ends = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-10)
        flat = np.reshape(pixel, (-1, 1, 2)).astype(float)
        return cv2.undistortPoints(flat, self.matrix, self.distortion, criteria=ends).reshape(np.shape(pixel))

    def shows(self, pixel: Array, margin: float = 0.0) -> Array:
        """Which pixels (..., 2) are ``margin`` [px] inside the image."""
        size = np.array([self.width, self.height]) - 1.0
        return np.asarray(((pixel >= margin) & (pixel <= size - margin)).all(axis=-1))


CORNER = 0.15
"""[px] deviation of a coordinate in a sharp image"""

FEWEST = 8
"""Corners for a pose (chosen)"""


class Placed(NamedTuple):
    """A board before a camera."""

    pose: Array
    """(4, 4) in the camera frame"""
    covariance: Array
    """(6, 6) of shift [m] and turn [rad], camera axes, for `CORNER`"""
    rms: float
    """[px] residual per coordinate"""


def place(lens: Lens, corners: Array, pixel: Array, start: Array | None = None) -> Placed:
    """Pose of a board with ``corners`` (K, 3) [m] at ``pixel`` (K, 2), from ``start`` (4, 4) or both tilts.

    InputError for few corners, or corners on a line.
    """
    require("a camera", "camera")
    import cv2

    if len(corners) < FEWEST:
        raise InputError(f"{len(corners)} corners of the board, expected at least {FEWEST}")
    if np.linalg.matrix_rank(corners - corners[0], tol=1e-6) < 2:
        raise InputError("the corners of the board that are seen lie on one line, which leaves its pose open")
    seen = (np.asarray(corners), np.asarray(pixel), lens.matrix, lens.distortion)
    if start is None:
        _, turns, shifts, _ = cv2.solvePnPGeneric(*seen, flags=cv2.SOLVEPNP_IPPE)
    else:
        turns, shifts = [cv2.Rodrigues(start[:3, :3])[0]], [start[:3, 3:].copy()]
    return min(
        (
            _placed(lens, corners, pixel, *cv2.solvePnPRefineLM(*seen, turn, shift))
            for turn, shift in zip(turns, shifts, strict=True)
        ),
        key=lambda one: one.rms,
    )


def _placed(lens: Lens, corners: Array, pixel: Array, turn: Array, shift: Array) -> Placed:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turned(turn[:, 0]), shift[:, 0]
    told, slope, _ = lens.slopes(corners @ pose[:3, :3].T, pose[:3, 3])
    residual, slope = (told - pixel).ravel(), slope.reshape(-1, 6)
    spread = CORNER**2 * np.linalg.inv(slope.T @ slope + 1e-12 * np.eye(6))
    rms = float(np.sqrt(residual @ residual / max(len(residual) - 6, 1)))
    return Placed(pose=pose, covariance=np.asarray(spread), rms=rms)
