"""An emulated camera: the board's picture seen through a known lens, with blur, noise, and something in the way.

Each pixel of the picture is followed backwards: along its ray through the lens to the plane of the board, and to where
it meets the board's drawing. It shares nothing with OpenCV's projection but the law of the lens, so that it can judge
the detection. The same seed gives the same picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.arms.camera.board import Board
from rejoint.arms.camera.drawing import areas
from rejoint.arms.camera.lens import Lens

Picture = NDArray[np.uint8]
"""(height, width) grey levels"""

BLACK, WHITE, SKIN, WALL = 35.0, 215.0, 140.0, 120.0
"""Grey levels of print, paper, a hand, and what is behind (chosen: a board in a room)"""

_FINE = 3  # rays across a pixel (chosen)
_DOT = 0.25e-3  # [m] of the drawing's dots (chosen: a tenth of a cell; edges of cells are on them)
_QUIET = 5e-3  # [m] white paper around the board (chosen)
_MARGIN = 8  # [px] around the board that are rendered with it


@dataclass(frozen=True, kw_only=True)
class Looks:
    """What befalls a picture."""

    blur: float = 0.7
    """[px] standard deviation of the blur of lens and focus"""
    noise: float = 4.0
    """standard deviation of a pixel [grey levels]"""
    shake: float = 0.0
    """[px] length of the way that the board moves during the exposure"""
    hidden: float = 0.0
    """share of the board's width that something covers"""


@lru_cache(maxsize=8)
def drawn(board: Board) -> NDArray[np.float32]:
    """Draw a board, grey levels in dots of a quarter of a millimetre, with a rim of white paper."""
    rim = round(_QUIET / _DOT)
    dots = [round(board.square * count / _DOT) + 2 * rim for count in (board.rows, board.columns)]
    picture = np.full(dots, WHITE, np.float32)
    for left, top, width, height, black in areas(board):
        x0, x1, y0, y1 = (round(edge / (1e3 * _DOT)) + rim for edge in (left, left + width, top, top + height))
        picture[y0:y1, x0:x1] = BLACK if black else WHITE
    picture.setflags(write=False)
    return picture


def render(board: Board, lens: Lens, pose: Array, seed: int | tuple[int, ...], looks: Looks | None = None) -> Picture:
    """Picture of a board at ``pose`` (4, 4) in the frame of the camera; the wall alone where it is out of sight."""
    import cv2

    looks = looks or Looks()
    rng = np.random.default_rng(seed)
    canvas = _wall(lens)
    window = _window(board, lens, pose)
    if window is not None:
        _paint(canvas, board, lens, pose, window)
        if looks.hidden > 0.0:
            _cover(canvas, lens, board, pose, looks.hidden, rng)
    if looks.shake > 0.0:
        canvas = cv2.filter2D(canvas, -1, _track(looks.shake, rng), borderType=cv2.BORDER_REPLICATE)
    if looks.blur > 0.0:
        canvas = cv2.GaussianBlur(canvas, (0, 0), looks.blur)
    canvas += looks.noise * rng.standard_normal(canvas.shape, dtype=np.float32)
    return np.clip(np.rint(canvas), 0, 255).astype(np.uint8)


def _paint(
    canvas: NDArray[np.float32], board: Board, lens: Lens, pose: Array, window: tuple[int, int, int, int]
) -> None:
    """Put the board into the picture: rays of a fine grid, averaged over each pixel."""
    import cv2

    x0, x1, y0, y1 = window
    ray = _fine(lens.rays(np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1)))
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
    behind = np.repeat(np.repeat(canvas[y0:y1, x0:x1], _FINE, axis=0), _FINE, axis=1)
    fine = np.where(on, shade, behind)
    canvas[y0:y1, x0:x1] = fine.reshape(y1 - y0, _FINE, x1 - x0, _FINE).mean(axis=(1, 3))


def _fine(ray: Array) -> Array:
    """Rays (3 h, 3 w, 2) across the pixels whose centres have ``ray`` (h, w, 2), along the slopes between pixels."""
    down, right = np.gradient(ray, axis=0), np.gradient(ray, axis=1)
    inside = (np.arange(_FINE) + 0.5) / _FINE - 0.5  # of a pixel, whose centre is at a whole number
    shift = inside[:, None, None, None] * down[:, None, :, None] + inside[:, None] * right[:, None, :, None]
    return np.asarray((ray[:, None, :, None] + shift).reshape(_FINE * ray.shape[0], _FINE * ray.shape[1], 2))


def _window(board: Board, lens: Lens, pose: Array) -> tuple[int, int, int, int] | None:
    """Columns and rows of the picture in which the board may be; None where there are none."""
    outline = board.outline + np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * _QUIET
    points = outline @ pose[:3, :3].T + pose[:3, 3]
    if (points[:, 2] < 0.05).any():
        return None
    edge = np.linspace(0, 1, 9)[:, None, None]
    pixel = lens.project((points * (1 - edge) + np.roll(points, 1, axis=0) * edge).reshape(-1, 3))
    low = np.maximum(np.floor(pixel.min(axis=0)).astype(int) - _MARGIN, 0)
    high = np.minimum(np.ceil(pixel.max(axis=0)).astype(int) + _MARGIN, [lens.width, lens.height])
    return None if (low >= high).any() else (int(low[0]), int(high[0]), int(low[1]), int(high[1]))


def _wall(lens: Lens) -> NDArray[np.float32]:
    """Paint what is behind the board: a wall that is darker towards one side."""
    x, y = np.linspace(-1, 1, lens.width), np.linspace(-1, 1, lens.height)
    return np.asarray(WALL + 25.0 * x[None, :] - 10.0 * y[:, None], dtype=np.float32)


def _cover(
    canvas: NDArray[np.float32], lens: Lens, board: Board, pose: Array, share: float, rng: np.random.Generator
) -> None:
    """Lay a hand over the board from one of its sides."""
    import cv2

    side = int(rng.integers(4))
    corners = np.roll(board.outline, side, axis=0)
    reach = np.stack([corners[0], corners[1], corners[1] + share * (corners[2] - corners[1]),
                      corners[0] + share * (corners[3] - corners[0])])  # fmt: skip
    middle = board.outline.mean(axis=0)
    outwards = np.where(np.arange(4)[:, None] < 2, 0.5 * (reach - middle), 0.0)
    pixel = lens.project((reach + outwards) @ pose[:3, :3].T + pose[:3, 3])
    cv2.fillConvexPoly(canvas, np.rint(pixel).astype(np.int32), SKIN, lineType=cv2.LINE_AA)


def _track(length: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Kernel of a straight movement of ``length`` [px] in some direction."""
    angle, reach = rng.uniform(0, np.pi), int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    along = np.linspace(-length / 2, length / 2, 8 * reach + 1)
    np.add.at(
        kernel,
        (reach + np.rint(along * np.sin(angle)).astype(int), reach + np.rint(along * np.cos(angle)).astype(int)),
        1,
    )
    return np.asarray(kernel / kernel.sum())
