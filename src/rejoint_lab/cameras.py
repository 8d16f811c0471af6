"""A camera before an emulated arm.

Each pixel is traced back to the drawing, so that images can test the detection.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_pose
from rejoint.arms.rotations import inverse
from rejoint.camera.board import ON_TOOL, Board, Picture
from rejoint.camera.rig import Lens, Rig

BLACK, WHITE, WALL = 35.0, 215.0, 120.0
"""Grey levels of print, paper and background (chosen)"""

_FINE = 3  # rays across a pixel (chosen)
_DOT = 0.25e-3  # [m] of the drawing's dots (chosen: a tenth of a cell; edges of cells are on them)
_QUIET = 5e-3  # [m] white paper around the board (chosen)
_MARGIN = 30  # [px] around the projected outline that are rendered with it: distortion bends its edges
_EXACT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-10)


@lru_cache(maxsize=8)
def drawn(board: Board) -> NDArray[np.float32]:
    """Draw a board with a white rim, dots of 0.25 mm."""
    ink = BLACK + (WHITE - BLACK) / 255.0 * board.drawing(1.0 / _DOT)
    picture = np.pad(ink.astype(np.float32), round(_QUIET / _DOT), constant_values=WHITE)
    picture.setflags(write=False)
    return picture


def render(rig: Rig, tool: Array, seed: int | tuple[int, ...], *, blur: float = 0.7, noise: float = 4.0) -> Picture:
    """Image with the tool at ``tool`` (4, 4) in the base, noise by ``seed``.

    Standard deviations of ``blur`` [px] and ``noise`` [grey levels].
    """
    rng, lens = np.random.default_rng(seed), rig.lens
    x, y = np.linspace(-1, 1, lens.width), np.linspace(-1, 1, lens.height)
    canvas = (WALL + 25.0 * x[None, :] - 10.0 * y[:, None]).astype(np.float32)
    _paint(canvas, rig.board, lens, rig.sight(tool))
    canvas = cv2.GaussianBlur(canvas, (0, 0), blur)
    canvas += noise * rng.standard_normal(canvas.shape, dtype=np.float32)
    return np.clip(np.rint(canvas), 0, 255).astype(np.uint8)


def _paint(canvas: NDArray[np.float32], board: Board, lens: Lens, pose: Array) -> None:
    """Trace the pixels around the board to its drawing, where it is in sight."""
    outline = (board.outline + _QUIET * np.sign(board.outline - 1e-9)) @ pose[:3, :3].T + pose[:3, 3]
    corner = lens.project(outline)
    x0, y0 = np.maximum(corner.min(axis=0) - _MARGIN, 0).astype(int)
    x1, y1 = np.minimum(corner.max(axis=0) + _MARGIN, [lens.width, lens.height]).astype(int)
    if (outline[:, 2] < 0.05).any() or x0 >= x1 or y0 >= y1:
        return
    part, size = canvas[y0:y1, x0:x1], (_FINE * (x1 - x0), _FINE * (y1 - y0))
    pixel = np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1)
    ray = cv2.undistortPoints(pixel.reshape(-1, 1, 2).astype(float), lens.matrix, lens.distortion, criteria=_EXACT)
    ray = cv2.resize(ray.reshape(pixel.shape), size, interpolation=cv2.INTER_LINEAR)
    rim = _QUIET / _DOT - 0.5  # the centre of the first dot is half a dot from its edge
    dots = np.diag([1.0 / _DOT / board.stretch_x, 1.0 / _DOT / board.stretch_y, 1.0])
    dots[:2, 2] = rim
    dot = cv2.perspectiveTransform(ray, dots @ np.linalg.inv(pose[:3, [0, 1, 3]])).astype(np.float32)
    fine = cv2.resize(part, size, interpolation=cv2.INTER_NEAREST)
    cv2.remap(drawn(board), dot, None, cv2.INTER_LINEAR, dst=fine, borderMode=cv2.BORDER_TRANSPARENT)
    canvas[y0:y1, x0:x1] = cv2.resize(fine, part.shape[::-1], interpolation=cv2.INTER_AREA)


LENS = Lens(width=1920, height=1080, f=1400.0, cx=950.0, cy=545.0, k1=-0.08, k2=0.05, p1=8e-4, p2=-5e-4)
"""A web camera of 69 degrees (chosen)"""
AWAY = 0.6
"""[m] of the camera from the targets"""
# [rad] at which it stands beside the arm, about the vertical, from the front (chosen)
_AZIMUTH = np.radians(-60.0)


def beside(arm: Arm, *, board: Board = ON_TOOL) -> Rig:
    """Camera beside an arm, and an upright board on its tool."""
    middle = arm.targets.middle
    level = np.array([np.cos(_AZIMUTH), np.sin(_AZIMUTH), 0.0])
    standing = looking(middle + AWAY * (0.95 * level + [0.0, 0.0, 0.31]), middle)
    rest = tcp_pose(arm, arm.rest)
    towards = standing[:3, 3] - rest[:3, 3]
    hung = looking(rest[:3, 3] + 0.03 * towards / np.linalg.norm(towards), rest[:3, 3])
    hung[:3, 3] -= hung[:3, :2] @ board.size / 2
    return Rig(lens=LENS, board=board, carried="board", standing=standing, mounted=inverse(rest) @ hung)


def on_tool(arm: Arm, *, board: Board) -> Rig:
    """Camera on an arm's tool, and a flat board below the targets."""
    floor = arm.targets.middle * [1.0, 1.0, 0.0]
    lying = np.diag([1.0, -1.0, -1.0, 1.0])  # seen from above
    lying[:3, 3] = floor - lying[:3, :2] @ board.size / 2
    rest = tcp_pose(arm, arm.rest)
    camera = looking(rest[:3, 3] + [0.0, 0.0, 0.05], floor)
    return Rig(lens=LENS, board=board, carried="camera", standing=lying, mounted=inverse(rest) @ camera)


def looking(place: Array, at: Array) -> Array:
    """Pose (4, 4) of an upright camera at ``place`` (3,)."""
    forwards = (at - place) / np.linalg.norm(at - place)
    right = np.cross(forwards, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(forwards, right), forwards, place])
    return pose


@dataclass(eq=False)
class EmulatedCamera:
    """Rendered images; noise by seed and number."""

    rig: Rig
    tool: Callable[[], Array]
    """returns the tool's pose (4, 4) in the base"""
    seed: int

    def still(self, number: int) -> Picture:
        """Render image ``number``."""
        return render(self.rig, self.tool(), (self.seed, number))
