"""Pictures into views: the board's corners, and of every picture that is of no use, its name and why."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.arms.camera.board import Board, BoardView
from rejoint.diagnosis.calibration.camera.sighting import FEWEST
from rejoint.system.errors import FileError
from rejoint.system.extras import require

KINDS = (".png", ".jpg", ".jpeg")
"""Endings of the files that are read as pictures"""

SOFT = 6.0
"""[px] width of an edge from which a picture counts as blurred (chosen: sharp ones have 2 to 4; beyond it the markers
of a board on a tool are no longer read)"""

_SHARPEST = 99.0  # percentile of the gradient that stands for edges (chosen)


@dataclass(frozen=True, kw_only=True)
class Unusable:
    """A picture, or the view of one, that is left out."""

    name: str
    why: str


class Detector:
    """Looks for one board in pictures; MissingExtraError without OpenCV."""

    def __init__(self, board: Board) -> None:
        require("a camera", "camera")
        import cv2

        self.board = board
        searching = cv2.aruco.DetectorParameters()
        searching.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE  # of markers: the chessboard's are used
        self._opencv = cv2.aruco.CharucoDetector(board.opencv(), cv2.aruco.CharucoParameters(), searching)

    def find(self, name: str, picture: NDArray[np.uint8]) -> BoardView | Unusable:
        """Find the board in a grey or BGR ``picture``; `Unusable` where too little of it can be seen well."""
        import cv2

        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        corners, numbers, marker_corners, marker_numbers = self._opencv.detectBoard(grey)
        whole = len(self.board.corners)
        found = 0 if numbers is None else len(numbers)
        markers = 0 if marker_numbers is None else len(marker_numbers)
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
            )  # fmt: skip
        view = BoardView(
            name=name, number=np.ravel(numbers).astype(np.int64), pixel=np.reshape(corners, (-1, 2)).astype(float)
        )
        if np.linalg.matrix_rank(self.board.corners[view.number, :2] - self.board.corners[view.number[0], :2]) < 2:
            return Unusable(name=name, why="the corners of the board that are seen lie on one line")
        return view


def edge_width(grey: NDArray[np.uint8], corners: Array) -> float:
    """Width [px] of the sharpest edges around ``corners`` (K, 2): the contrast by the steepest gradient."""
    import cv2

    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 4, 0)
    high = np.ceil(corners.max(axis=0)).astype(int) + 5
    part = cv2.GaussianBlur(grey[low[1] : high[1], low[0] : high[0]], (0, 0), 0.8).astype(np.float32)  # against noise
    if min(part.shape) < 5:
        return np.inf
    contrast = float(np.ptp(np.percentile(part, [5, 95])))
    steep = np.hypot(cv2.Sobel(part, cv2.CV_32F, 1, 0), cv2.Sobel(part, cv2.CV_32F, 0, 1)) / 8.0
    return contrast / max(float(np.percentile(steep, _SHARPEST)), 1e-6)


def read_views(folder: Path, board: Board) -> tuple[list[BoardView], list[Unusable]]:
    """Find the board in every picture of a folder, in the order of their names; FileError without pictures."""
    return find_views(read_pictures(folder), board)


def find_views(
    pictures: Iterable[tuple[str, NDArray[np.uint8] | None]], board: Board
) -> tuple[list[BoardView], list[Unusable]]:
    """Find the board in pictures with names; None stands for one that cannot be read."""
    detector = Detector(board)
    views: list[BoardView] = []
    unusable: list[Unusable] = []
    for name, picture in pictures:
        if picture is None:
            unusable.append(Unusable(name=name, why="is no picture that OpenCV can read"))
            continue
        found = detector.find(name, picture)
        if isinstance(found, BoardView):
            views.append(found)
        else:
            unusable.append(found)
    return views, unusable


def read_pictures(folder: Path) -> Iterator[tuple[str, NDArray[np.uint8] | None]]:
    """Yield name and grey levels of the pictures of a folder, in the order of their names."""
    require("a camera", "camera")
    import cv2

    remedy = f"give a folder with pictures ({', '.join(KINDS)})"
    if not folder.is_dir():
        raise FileError(folder, "is no folder", remedy)
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in KINDS)
    if not paths:
        raise FileError(folder, "holds no pictures", remedy)
    for path in paths:
        yield path.name, cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
