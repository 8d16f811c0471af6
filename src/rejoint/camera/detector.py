"""Finds the board's corners in images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.camera.board import Board, BoardView
from rejoint.system.files import MEGABYTE, read_bounded

Picture = NDArray[np.uint8]
"""(height, width) grey levels"""

KINDS = (".png", ".jpg", ".jpeg")
"""File endings"""

FEWEST = 8
"""Corners for a pose (chosen)"""

SOFT = 6.0
"""[px] edge width of a blurred image (chosen)"""

FEWEST_MARKERS = 4
"""Markers that show another board (chosen)"""

PICTURE_MOST = 100 * MEGABYTE
"""[bytes] (chosen)"""

_SHARPEST = 99.0  # percentile of the gradient that stands for edges (chosen)


class Unusable(NamedTuple):
    """A rejected image."""

    name: str
    why: str


class Detector:
    """Detector of a board."""

    def __init__(self, board: Board) -> None:
        self.board = board
        searching = cv2.aruco.DetectorParameters()
        searching.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE  # of markers: the chessboard's are used
        self._opencv = cv2.aruco.CharucoDetector(board.opencv(), cv2.aruco.CharucoParameters(), searching)
        self._shown = False  # whether it has been seen: then it is the right board, and any fault is of one picture

    def find(self, name: str, picture: Picture) -> BoardView | Unusable:
        """Find the board in a grey or BGR ``picture``."""
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        corners, numbers, markers, _ = self._opencv.detectBoard(grey)
        count = 0 if numbers is None else len(numbers)
        why = next(filter(None, self._doubts(grey, markers or (), count)), "")
        if why:
            return Unusable(name=name, why=why)
        number = np.ravel(numbers).astype(np.int64)
        known = self.board.corners[number, :2]
        if np.linalg.matrix_rank(known - known[0]) < 2:
            return Unusable(name=name, why="the corners of the board that are seen lie on one line")
        self._shown = True
        return BoardView(name=name, number=number, pixel=np.reshape(corners, (-1, 2)).astype(float))

    def _doubts(self, grey: Picture, markers: Sequence[Array], count: int) -> Iterator[str]:
        if not count and not self._shown:
            yield self._unlike(grey)
        around = [np.reshape(one, (-1, 2)) for one in markers] or [np.array([[0.0, 0.0], grey.shape[::-1]])]
        softness = edge_width(grey, np.concatenate(around))
        if not markers:
            soft = ", and nothing in the picture is sharp" if softness > SOFT else ""
            yield f"the board cannot be seen: none of its markers is found{soft}"
        if softness > SOFT:
            wide = f"its edges are {softness:.1f} px wide, expected at most {SOFT:g}"
            yield f"blurred: {wide}; hold still, focus, add light"
        if count < FEWEST:
            yield f"{count} of {len(self.board.corners)} corners of the board are seen, expected at least {FEWEST}"

    def _unlike(self, grey: Picture) -> str:
        """Whether the picture shows markers, but another board, or this one mirrored."""
        numbers = self._opencv.getBoard().getDictionary()
        for picture in (grey, np.ascontiguousarray(grey[:, ::-1])):
            found = cv2.aruco.ArucoDetector(numbers).detectMarkers(picture)[1]
            seen = np.zeros(0) if found is None else np.ravel(found)
            if len(seen) >= FEWEST_MARKERS and len(np.unique(seen)) < len(seen):
                return "markers are seen twice: take every other board out of the picture"
            if len(seen) >= FEWEST_MARKERS:
                return (
                    "markers are seen, but not where the board's description has them: is it of this print, by "
                    "`rejoint board`, and is the picture not mirrored?"
                )
        return ""


def edge_width(grey: Picture, corners: Array) -> float:
    """Width [px] of the sharpest edges at ``corners`` (K, 2): contrast over gradient."""
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 4, 0)
    high = np.ceil(corners.max(axis=0)).astype(int) + 5
    part = cv2.GaussianBlur(grey[low[1] : high[1], low[0] : high[0]], (0, 0), 0.8).astype(np.float32)  # against noise
    contrast = float(np.ptp(np.percentile(part, [5, 95])))
    steep = np.hypot(cv2.Sobel(part, cv2.CV_32F, 1, 0), cv2.Sobel(part, cv2.CV_32F, 0, 1)) / 8.0
    return contrast / max(float(np.percentile(steep, _SHARPEST)), 1e-6)


def read_picture(path: Path) -> Picture | None:
    """Grey levels of an image, or None."""
    data = np.frombuffer(read_bounded(path, PICTURE_MOST, "take a smaller picture"), np.uint8)
    # a phone that looks down turns its pictures by what it takes for upright, its lens does not turn
    found = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    return None if found is None else np.asarray(found, np.uint8)
