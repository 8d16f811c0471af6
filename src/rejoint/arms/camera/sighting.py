"""Where a board is before a camera, from its corners in one picture: a first estimate, and the best one.

A flat board seen from afar looks almost the same when it is tilted the other way (Schweighofer and Pinz, Robust pose
estimation from a planar target, 2006): both are tried, and the one that fits better is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.arms.camera.lens import Lens, projected
from rejoint.arms.camera.poses import moved, nearest_rotation, rotation_vector, skew, turned
from rejoint.system.errors import InputError

CORNER = 0.15
"""[px] standard deviation of a corner's coordinates in a sharp picture (rendered pictures: 0.05 to 0.15)"""

FEWEST = 8
"""Corners of which a pose is estimated (chosen: four fix it, and half of them show whether something is wrong)"""

_STEPS = 15  # of Gauss and Newton; they end much earlier
_SMALL = 1e-9  # [m] and [rad] of a step after which the pose is settled
_SHALLOW = 1e-3  # [rad] between line of sight and board's normal below which there is no other tilt to try


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A board before a camera."""

    pose: Array
    """(4, 4) of the board in the frame of the camera"""
    covariance: Array
    """(6, 6) of a shift [m] and a turn on the spot [rad], camera axes, for corners as good as `CORNER`"""
    rms: float
    """[px] of what is left between corners and projection, per coordinate"""


def place(lens: Lens, corners: Array, pixel: Array, start: Array | None = None) -> Placed:
    """Find where a board with ``corners`` (K, 3) [m] is that are seen at ``pixel`` (K, 2).

    ``start`` (4, 4) is where it is looked for; without it both tilts are. InputError for fewer than `FEWEST` corners
    or corners on a line.
    """
    if len(corners) < FEWEST:
        raise InputError(f"{len(corners)} corners of the board, expected at least {FEWEST}")
    if start is not None:
        return _refined(lens, corners, pixel, start)
    first = _refined(lens, corners, pixel, pose_of_homography(homography(corners[:, :2], lens.rays(pixel))))
    other = _tilted_back(first.pose, corners.mean(axis=0))
    if other is None:
        return first
    second = _refined(lens, corners, pixel, other)
    return second if second.rms < first.rms else first


def homography(flat: Array, seen: Array) -> Array:
    """Matrix (3, 3) that maps points (K, 2) to points (K, 2), by least squares on scaled points (Hartley 1997)."""
    into, out = _scaling(flat), _scaling(seen)
    a, b = flat * into[0, 0] + into[:2, 2], seen * out[0, 0] + out[:2, 2]
    ones, zeros = np.ones((len(a), 1)), np.zeros((len(a), 3))
    p = np.hstack([a, ones])
    rows = np.vstack([np.hstack([p, zeros, -b[:, :1] * p]), np.hstack([zeros, p, -b[:, 1:] * p])])
    _, size, right = np.linalg.svd(rows, full_matrices=True)
    if size[7] < 1e-6 * size[0]:
        raise InputError("the corners of the board that are seen lie on one line, which leaves its pose open")
    return np.asarray(np.linalg.inv(out) @ right[-1].reshape(3, 3) @ into)


def pose_of_homography(mapping: Array) -> Array:
    """Pose (4, 4) of a plane whose points are seen at distance 1 where ``mapping`` (3, 3) brings them."""
    scale = 2.0 / (np.linalg.norm(mapping[:, 0]) + np.linalg.norm(mapping[:, 1]))
    mapping = mapping * (scale * np.sign(mapping[2, 2]))
    pose = np.eye(4)
    pose[:3, :3] = nearest_rotation(
        np.column_stack([mapping[:, 0], mapping[:, 1], np.cross(mapping[:, 0], mapping[:, 1])])
    )
    pose[:3, 3] = mapping[:, 2]
    return pose


def focal_length(mappings: list[Array]) -> float | None:
    """Focal length from homographies (3, 3) of boards to pixels about the optical axis; None if they leave it open.

    A board's two directions are at right angles and of one scale (Zhang, A flexible new technique, 2000, section 3.1).
    """
    rows, wanted = [], []
    for mapping in mappings:
        (a, b, c), (d, e, f) = (
            (mapping[:, 0] / np.linalg.norm(mapping[:, 0])),
            mapping[:, 1] / np.linalg.norm(mapping[:, 0]),
        )
        rows += [a * d + b * e, a**2 + b**2 - d**2 - e**2]
        wanted += [-c * f, f**2 - c**2]
    column, right = np.array(rows), np.array(wanted)
    inverse_square = float(column @ right / max(column @ column, 1e-300))
    return inverse_square**-0.5 if inverse_square > 0.0 else None


def _refined(lens: Lens, corners: Array, pixel: Array, pose: Array) -> Placed:
    """Gauss-Newton steps, halved where they do not help."""
    residual, slope = _reprojection(lens, corners, pixel, pose)
    for _ in range(_STEPS):
        step = np.asarray(-np.linalg.lstsq(slope, residual, rcond=None)[0])
        for _ in range(8):
            trial = moved(pose, step)
            new, new_slope = _reprojection(lens, corners, pixel, trial)
            if new @ new <= residual @ residual:
                break
            step = 0.5 * step
        else:
            break
        pose, residual, slope = trial, new, new_slope
        if np.abs(step).max() < _SMALL:
            break
    curvature = slope.T @ slope + 1e-12 * np.eye(6)
    freedom = max(len(residual) - 6, 1)
    spread = np.asarray(CORNER**2 * np.linalg.inv(curvature))
    return Placed(pose=pose, covariance=spread, rms=float(np.sqrt(residual @ residual / freedom)))


def _reprojection(lens: Lens, corners: Array, pixel: Array, pose: Array) -> tuple[Array, Array]:
    """Residuals (2 K,) [px] and their derivative (2 K, 6) by shift and turn."""
    arm = corners @ pose[:3, :3].T
    point = arm + pose[:3, 3]
    point[:, 2] = np.maximum(point[:, 2], 1e-3)  # behind the camera nothing is seen: a wrong pose stays a bad one
    seen, by_point, _ = projected(lens.numbers, point)
    slope = np.concatenate([by_point, by_point @ -skew(arm)], axis=-1)
    return (seen - pixel).ravel(), slope.reshape(-1, 6)


def _tilted_back(pose: Array, centre: Array) -> Array | None:
    """Tilt a board to the other side of the line of sight to its ``centre`` (3,); None for one that is not tilted."""
    middle = pose[:3, :3] @ centre + pose[:3, 3]
    sight, normal = middle / np.linalg.norm(middle), pose[:3, 2]
    axis = np.cross(normal, sight)
    sine = float(np.linalg.norm(axis))
    if sine < _SHALLOW:
        return None
    angle = np.arctan2(sine, float(normal @ sight))
    other = pose.copy()
    other[:3, :3] = turned(axis / sine * 2.0 * angle) @ pose[:3, :3]
    other[:3, 3] = middle - other[:3, :3] @ centre
    return other


def _scaling(points: Array) -> Array:
    """Similarity (3, 3) that brings points (K, 2) around zero at a distance of about one."""
    centre = points.mean(axis=0)
    scale = 1.0 / max(float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())), 1e-12)
    return np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])


def turn_between(first: Array, second: Array) -> Array:
    """Angle (...) [rad] between the orientations of poses (..., 4, 4)."""
    relative = np.swapaxes(first[..., :3, :3], -1, -2) @ second[..., :3, :3]
    return np.asarray(np.linalg.norm(rotation_vector(relative), axis=-1))
