"""A lens with Brown's distortion as in OpenCV; the poses of camera, board and arm; ``camera.toml`` (SI units, px)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.rotations import difference, inverse, moved, pose_of, rotation_error, turned
from rejoint.camera.board import Board, BoardView
from rejoint.diagnosis.calibration.calibration import require_finite
from rejoint.system.errors import ContractError
from rejoint.system.files import array_of, read_sealed, toml_of, write_sealed
from rejoint.system.records import entity, value_type

TERMS = ("f", "cx", "cy", "k1", "k2", "p1", "p2")
"""Names in `Lens.numbers`"""
CORNER = 0.15
"""[px] deviation of a coordinate in a sharp image"""
FLAT = 0.6
"""[px] rms residual that a view of a flat board may have in any case; chosen"""


@value_type
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
    def size(self) -> tuple[int, int]:
        """[px] width and height."""
        return self.width, self.height

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


class Placed(NamedTuple):
    """A board before a camera."""

    pose: Array
    """(4, 4) in the camera frame"""
    covariance: Array
    """(6, 6) of shift [m] and turn [rad], camera axes, for `CORNER`"""
    rms: float
    """[px] residual per coordinate"""


def place(lens: Lens, board: Board, view: BoardView, near: Array | None = None) -> Placed:
    """Pose of a board in a view.

    A flat board far away looks alike in two tilts (Schweighofer and Pinz, 2006); of those that fit, the nearest to
    ``near`` (4, 4) wins, else the best.
    """
    corners, pixel = board.corners[view.number], view.pixel
    seen = (corners, pixel, lens.matrix, lens.distortion)
    _, turns, shifts, _ = cv2.solvePnPGeneric(*seen, flags=cv2.SOLVEPNP_IPPE)
    starts = list(zip(turns, shifts, strict=True))
    if near is not None:
        starts.append((cv2.Rodrigues(near[:3, :3])[0], near[:3, 3:].copy()))
    found = []
    for start in starts:
        turn, shift = cv2.solvePnPRefineLM(*seen, *start)
        pose = pose_of(turned(turn[:, 0]), shift[:, 0])
        told, slope, _ = lens.slopes(corners, pose)
        residual = (told - pixel).ravel()
        spread = CORNER**2 * np.linalg.inv(slope.T @ slope + 1e-12 * np.eye(6))
        rms = float(np.sqrt(residual @ residual / max(len(residual) - 6, 1)))
        found.append(Placed(pose=pose, covariance=np.asarray(spread), rms=rms))
    best = min(found, key=lambda one: one.rms)
    if near is None:
        return best
    fitting = [one for one in found if one.rms <= max(best.rms, FLAT)]
    return min(fitting, key=lambda one: np.linalg.norm(rotation_error(one.pose[:3, :3], near[:3, :3])))


_STEP = 1e-6  # [m] and [rad] of numerical derivatives
EDGE, STEEPEST = 20.0, np.radians(55.0)
"""[px] of a shown board from the edge of the picture, and most [rad] between line of sight and normal; chosen"""


@entity
class Rig:
    """A camera, a board and an arm."""

    lens: Lens
    board: Board
    carried: str
    """by the tool: ``board`` or ``camera``"""
    standing: Array
    """(4, 4) of the other one, base frame"""
    mounted: Array
    """(4, 4) of the carried one, TCP frame"""

    def carried_in(self, pose: Array) -> Array:
        """Carried one in the frame of the standing one, for the board in the camera, (..., 4, 4); or the reverse."""
        return pose if self.carried == "board" else inverse(pose)

    def tool(self, board: Array) -> Array:
        """Tool poses (..., 4, 4) in the base, for ``board`` (..., 4, 4) in the camera."""
        return self.standing @ self.carried_in(board) @ inverse(self.mounted)

    def spread(self, board: Array, covariance: Array) -> Array:
        """Covariance (V, 6, 6) of the tool's pose, base axes, from that of ``board`` (V, 4, 4), camera axes."""
        base = self.tool(board)
        rows = [difference(self.tool(moved(board, _STEP * row)), base) / _STEP for row in np.eye(6)]
        slope = np.stack(rows, axis=-1)
        return slope @ covariance @ slope.mT

    def sight(self, tool: Array) -> Array:
        """Board poses (..., 4, 4) in the camera, for ``tool`` (..., 4, 4)."""
        return self.carried_in(inverse(self.standing) @ tool @ self.mounted)

    def shows(self, tool: Array) -> Array:
        """Whether the whole board is visible at ``tool`` (..., 4, 4)."""
        pose = self.sight(tool)
        outline = np.einsum("...ij,cj->...ci", pose[..., :3, :3], self.board.outline) + pose[..., None, :3, 3]
        middle = outline.mean(axis=-2)
        facing = (pose[..., :3, 2] * middle).sum(axis=-1) / np.linalg.norm(middle, axis=-1)
        ahead = (outline[..., 2] > 0.05).all(axis=-1)
        pixel = self.lens.project(np.where(ahead[..., None, None], outline, [0.0, 0.0, 1.0]))
        inside = (pixel >= EDGE) & (pixel <= np.array(self.lens.size) - 1.0 - EDGE)
        return ahead & (facing > np.cos(STEEPEST)) & inside.all(axis=(-2, -1))


def point_sigma(spread: Array) -> Array:
    """Sigma (...) [m] of a coordinate, for covariances (..., 6, 6) of poses."""
    return np.sqrt(np.trace(spread[..., :3, :3], axis1=-2, axis2=-1) / 3.0)


FORMAT = 2
"""Version; others are refused"""

_ABOUT = """A camera, a board and one robot arm. SI units and px.
standing: pose of what stands, in the base
mounted: pose of what the tool carries, in its frame
sigma: standard deviations of the lens (f, cx, cy, k1, k2, p1, p2), then shift and turn of both poses"""


def write_rig(path: Path, arm: Arm, rig: Rig, sigma: Array, date: str) -> None:
    """Write a rig; ``sigma`` (19,): deviations of `TERMS`, `Rig.standing` and `Rig.mounted`."""
    told = {"format": FORMAT, "arm": arm.name, "date": date, **vars(rig), "sigma": sigma}
    write_sealed(path, toml_of(told), _ABOUT)


def read_rig(path: Path, arm: Arm) -> Rig:
    """Read a rig; FileError, ContractError for another arm."""

    def build(data: dict[str, Any]) -> Rig:
        if data["arm"] != arm.name:
            raise ContractError(f"camera of arm {data['arm']!r}, expected one of {arm.name!r}; calibrate this arm")
        rig = msgspec.convert(data, Rig, dec_hook=array_of)
        require_finite(rig.tool(np.eye(4)), (4, 4))
        return rig

    return read_sealed(path, build, name="rig of a camera", version=FORMAT, again="calibrate with the camera")
