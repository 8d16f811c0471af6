"""Finds the board's corners in images."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.arms.camera.board import Board, BoardView
from rejoint.arms.camera.lens import FEWEST
from rejoint.system.extras import require
from rejoint.system.files import MEGABYTE, read_bounded

KINDS = (".png", ".jpg", ".jpeg")
"""File endings"""

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
    """Detector of a board; MissingExtraError."""

    def __init__(self, board: Board) -> None:
        require("a camera", "camera")
        import cv2

        self.board = board
        searching = cv2.aruco.DetectorParameters()
        searching.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE  # of markers: the chessboard's are used
        self._searching = searching
        self._shown = False  # whether it has been seen: then it is the right board, and any fault is of one picture
        self._opencv = cv2.aruco.CharucoDetector(board.opencv(), cv2.aruco.CharucoParameters(), searching)

    def find(self, name: str, picture: NDArray[np.uint8]) -> BoardView | Unusable:
        """Find the board in a grey or BGR ``picture``."""
        import cv2

        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        corners, numbers, marker_corners, marker_numbers = self._opencv.detectBoard(grey)
        whole = len(self.board.corners)
        found = 0 if numbers is None else len(numbers)
        markers = 0 if marker_numbers is None else len(marker_numbers)
        if found == 0 and not self._shown and (why := self._unlike(grey)):
            return Unusable(name=name, why=why)
        if markers == 0:
            soft = edge_width(grey, np.array([[0.0, 0.0], np.array(grey.shape[::-1]) - 1.0])) > SOFT
            return Unusable(
                name=name,
                why="the board cannot be seen: none of its markers is found"
                + (", and nothing in the picture is sharp" if soft else ""),
            )
        softness = edge_width(grey, np.concatenate([np.reshape(corner, (-1, 2)) for corner in marker_corners]))
        if softness > SOFT:
            return Unusable(
                name=name,
                why=f"blurred: its edges are {softness:.1f} px wide, expected at most {SOFT:g}; "
                "hold still, focus, add light",
            )
        if found < FEWEST:
            return Unusable(
                name=name, why=f"{found} of {whole} corners of the board are seen, expected at least {FEWEST}"
            )
        view = BoardView(
            name=name, number=np.ravel(numbers).astype(np.int64), pixel=np.reshape(corners, (-1, 2)).astype(float)
        )
        if np.linalg.matrix_rank(self.board.corners[view.number, :2] - self.board.corners[view.number[0], :2]) < 2:
            return Unusable(name=name, why="the corners of the board that are seen lie on one line")
        self._shown = True
        return view

    def _unlike(self, grey: NDArray[np.uint8]) -> str:
        import cv2

        numbers = self._opencv.getBoard().getDictionary()
        told = cv2.aruco.ArucoDetector(numbers, self._searching).detectMarkers(grey)[1]
        seen = np.zeros(0) if told is None else np.ravel(told)
        if len(seen) >= FEWEST_MARKERS and len(np.unique(seen)) < len(seen):
            return "markers are seen twice: take every other board out of the picture"
        legacy = self.board.opencv()
        legacy.setLegacyPattern(True)
        for other, picture, why in (
            (
                self.board.opencv(),
                np.ascontiguousarray(grey[:, ::-1]),
                "the picture is mirrored: switch that off where it is taken",
            ),
            (legacy, grey, "the board has the pattern of OpenCV before 4.6: print one with `rejoint board`"),
        ):
            detector = cv2.aruco.CharucoDetector(other, cv2.aruco.CharucoParameters(), self._searching)
            corners = detector.detectBoard(picture)[1]
            if corners is not None and len(corners) >= FEWEST:
                return why
        if len(seen) < FEWEST_MARKERS:
            return ""
        return "markers are seen, but not where the board's description has them: is it of this print?"


def edge_width(grey: NDArray[np.uint8], corners: Array) -> float:
    """Width [px] of the sharpest edges at ``corners`` (K, 2): contrast over gradient."""
    import cv2

    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 4, 0)
    high = np.ceil(corners.max(axis=0)).astype(int) + 5
    part = cv2.GaussianBlur(grey[low[1] : high[1], low[0] : high[0]], (0, 0), 0.8).astype(np.float32)  # against noise
    if min(part.shape) < 5:
        return np.inf
    contrast = float(np.ptp(np.percentile(part, [5, 95])))
    steep = np.hypot(cv2.Sobel(part, cv2.CV_32F, 1, 0), cv2.Sobel(part, cv2.CV_32F, 0, 1)) / 8.0
    return contrast / max(float(np.percentile(steep, _SHARPEST)), 1e-6)


def read_picture(path: Path) -> NDArray[np.uint8] | None:
    """Grey levels of an image, or None."""
    import cv2

    data = np.frombuffer(read_bounded(path, PICTURE_MOST, "take a smaller picture"), np.uint8)
    # a phone that looks down turns its pictures by what it takes for upright, its lens does not turn
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
