"""A camera before an emulated arm.

Each pixel is traced back to the drawing, without projected corners, so that images can test the detection.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_pose
from rejoint.arms.rotations import inverse
from rejoint.camera.board import ON_TOOL, Board
from rejoint.camera.detector import Picture
from rejoint.camera.lens import Lens
from rejoint.camera.rig import Rig

BLACK, WHITE, WALL = 35.0, 215.0, 120.0
"""Grey levels of print, paper and background (chosen)"""

_FINE = 3  # rays across a pixel (chosen)
_DOT = 0.25e-3  # [m] of the drawing's dots (chosen: a tenth of a cell; edges of cells are on them)
_QUIET = 5e-3  # [m] white paper around the board (chosen)
_MARGIN = 8  # [px] around the board that are rendered with it


class Looks(NamedTuple):
    """Disturbances of an image."""

    blur: float = 0.7
    """[px] standard deviation"""
    noise: float = 4.0
    """[grey levels] standard deviation of a pixel"""


@lru_cache(maxsize=8)
def drawn(board: Board) -> NDArray[np.float32]:
    """Draw a board with a white rim, dots of 0.25 mm."""
    rim = round(_QUIET / _DOT)
    ink = BLACK + (WHITE - BLACK) / 255.0 * board.drawing(1.0 / _DOT)
    picture = np.pad(ink.astype(np.float32), rim, constant_values=WHITE)
    picture.setflags(write=False)
    return picture


def render(board: Board, lens: Lens, pose: Array, seed: int | tuple[int, ...], looks: Looks) -> Picture:
    """Image of a board at ``pose`` (4, 4) in the camera frame."""
    rng = np.random.default_rng(seed)
    x, y = np.linspace(-1, 1, lens.width), np.linspace(-1, 1, lens.height)
    canvas = (WALL + 25.0 * x[None, :] - 10.0 * y[:, None]).astype(np.float32)
    window = _window(board, lens, pose)
    if window is not None:
        _paint(canvas, board, lens, pose, window)
    if looks.blur > 0.0:
        canvas = cv2.GaussianBlur(canvas, (0, 0), looks.blur)
    canvas += looks.noise * rng.standard_normal(canvas.shape, dtype=np.float32)
    return np.clip(np.rint(canvas), 0, 255).astype(np.uint8)


def _paint(
    canvas: NDArray[np.float32], board: Board, lens: Lens, pose: Array, window: tuple[int, int, int, int]
) -> None:
    x0, x1, y0, y1 = window
    size = (_FINE * (x1 - x0), _FINE * (y1 - y0))
    pixel = np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1)
    ends = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-10)
    ray = cv2.undistortPoints(pixel.reshape(-1, 1, 2).astype(float), lens.matrix, lens.distortion, criteria=ends)
    ray = cv2.resize(ray.reshape(pixel.shape), size, interpolation=cv2.INTER_LINEAR)
    ray = np.concatenate([ray, np.ones((*ray.shape[:-1], 1))], axis=-1)
    mapping = np.linalg.inv(np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    flat = ray @ mapping.T
    place = flat[..., :2] / flat[..., 2:]  # [m] on the print
    place = place / np.array([board.stretch_x, board.stretch_y]) + _QUIET
    dot = (place / _DOT - 0.5).astype(np.float32)  # the centre of the first dot is half a dot from its edge
    picture = drawn(board)
    shade = cv2.remap(
        picture, dot[..., 0], dot[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1
    )
    on = (dot > 0).all(axis=-1) & (dot[..., 0] < picture.shape[1] - 1) & (dot[..., 1] < picture.shape[0] - 1)
    part = canvas[y0:y1, x0:x1]
    fine = np.where(on, shade, cv2.resize(part, size, interpolation=cv2.INTER_NEAREST))
    canvas[y0:y1, x0:x1] = cv2.resize(fine, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)


def _window(board: Board, lens: Lens, pose: Array) -> tuple[int, int, int, int] | None:
    outline = board.outline + np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * _QUIET
    points = outline @ pose[:3, :3].T + pose[:3, 3]
    if (points[:, 2] < 0.05).any():
        return None
    edge = np.linspace(0, 1, 9)[:, None, None]
    pixel = lens.project((points * (1 - edge) + np.roll(points, 1, axis=0) * edge).reshape(-1, 3))
    low = np.maximum(np.floor(pixel.min(axis=0)).astype(int) - _MARGIN, 0)
    high = np.minimum(np.ceil(pixel.max(axis=0)).astype(int) + _MARGIN, [lens.width, lens.height])
    return None if (low >= high).any() else (int(low[0]), int(high[0]), int(low[1]), int(high[1]))


LENS = Lens(width=1920, height=1080, f=1400.0, cx=950.0, cy=545.0, k1=-0.08, k2=0.05, p1=8e-4, p2=-5e-4)
"""A web camera of 69 degrees (chosen)"""
AWAY = 0.6
"""[m] of the camera from the targets"""
# [rad] at which it stands beside the arm, about the vertical, from the front (chosen)
_AZIMUTH = np.radians(-60.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """An emulated camera and board on an arm."""

    arm: Arm
    rig: Rig
    looks: Looks = field(default_factory=Looks)

    def shows(self, tool: Array, seed: int | tuple[int, ...]) -> Picture:
        """Image with the tool at ``tool`` (4, 4) in the base."""
        return render(self.rig.board, self.rig.lens, self.rig.sight(tool), seed, self.looks)


def beside(arm: Arm, *, board: Board = ON_TOOL) -> Scene:
    """Camera beside an arm, and an upright board on its tool."""
    middle = 0.5 * (arm.targets.lower + arm.targets.upper)
    level = np.array([np.cos(_AZIMUTH), np.sin(_AZIMUTH), 0.0])
    standing = looking(middle + AWAY * (0.95 * level + [0.0, 0.0, 0.31]), middle)
    rest = tcp_pose(arm, arm.rest)
    towards = standing[:3, 3] - rest[:3, 3]
    hung = looking(rest[:3, 3] + 0.03 * towards / np.linalg.norm(towards), rest[:3, 3])
    hung[:3, 3] -= hung[:3, :2] @ board.size / 2
    return Scene(arm, Rig(lens=LENS, board=board, carried="board", standing=standing, mounted=inverse(rest) @ hung))


def on_tool(arm: Arm, *, board: Board) -> Scene:
    """Camera on an arm's tool, and a flat board below the targets."""
    middle = 0.5 * (arm.targets.lower + arm.targets.upper)
    floor = np.array([middle[0], middle[1], 0.0])
    lying = np.diag([1.0, -1.0, -1.0, 1.0])  # seen from above
    lying[:3, 3] = floor - lying[:3, :2] @ board.size / 2
    rest = tcp_pose(arm, arm.rest)
    camera = looking(rest[:3, 3] + [0.0, 0.0, 0.05], floor)
    return Scene(arm, Rig(lens=LENS, board=board, carried="camera", standing=lying, mounted=inverse(rest) @ camera))


def looking(place: Array, at: Array) -> Array:
    """Pose (4, 4) of an upright camera at ``place`` (3,)."""
    forwards = (at - place) / np.linalg.norm(at - place)
    right = np.cross(forwards, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forwards, right), forwards])
    pose[:3, 3] = place
    return pose
