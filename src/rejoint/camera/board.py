"""The ChArUco board: its PDF, and its corners in images."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from rejoint.arms import Array
from rejoint.system.errors import InputError
from rejoint.system.files import MEGABYTE, read_bounded, read_toml, toml_of, write_text, write_whole
from rejoint.system.records import entity, value_type

DICTIONARY = "DICT_4X4_50"
"""Markers of 4 x 4 cells, by their name in OpenCV"""

RULER = 100.0
"""[mm] (chosen)"""

_STRETCH = 0.05
"""Largest error of a print (chosen: "fit to page" makes 0.04)"""


@value_type
class Board:
    """A ChArUco board as printed."""

    columns: int = 7
    """along x"""
    rows: int = 5
    """along y"""
    square: float = 0.030
    """[m] as drawn"""
    marker: float = 0.022
    """[m] as drawn"""
    stretch_x: float = 1.0
    """print over drawing, along x"""
    stretch_y: float = 1.0

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise InputError(f"board: expected at least 3 x 3 squares, got {self.columns} x {self.rows}")
        if not 0.0 < self.marker < self.square:
            raise InputError(
                f"board: markers must be smaller than squares, got {1e3 * self.marker:g} in {1e3 * self.square:g} mm"
            )
        for stretch in (self.stretch_x, self.stretch_y):
            if not abs(stretch - 1.0) <= _STRETCH:
                raise InputError(
                    f"board: {RULER:g} mm of ruler were measured as {RULER * stretch:.1f} mm, expected within "
                    f"{100 * _STRETCH:g} %; print it again at 100 %, not fitted to the page"
                )

    @property
    def size(self) -> Array:
        """(2,) [m] as printed."""
        return self.square * np.array([self.columns * self.stretch_x, self.rows * self.stretch_y])

    @property
    def corners(self) -> Array:
        """(C, 3) [m] inner, board frame."""
        down, across = np.mgrid[1 : self.rows, 1 : self.columns].reshape(2, -1)
        return self.square * np.stack([across * self.stretch_x, down * self.stretch_y, 0.0 * down], axis=-1)

    @property
    def outline(self) -> Array:
        """(4, 3) [m] outer, board frame."""
        return np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * [*self.size, 0.0]

    def drawing(self, dots: float) -> NDArray[np.uint8]:
        """Draw the board, (height, width) grey levels, ``dots`` per metre."""
        across, down = (round(dots * self.square * count) for count in (self.columns, self.rows))
        return np.asarray(self.opencv().generateImage((across, down)), dtype=np.uint8)

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board; InputError for too many squares."""
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
        needed, known = self.columns * self.rows // 2, len(markers.bytesList)
        if needed > known:
            raise InputError(
                f"board: {self.columns} x {self.rows} squares need {needed} markers, {DICTIONARY} has {known}; "
                "take fewer squares"
            )
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, markers)


@entity
class BoardView:
    """Corners of the board in one image."""

    name: str
    number: NDArray[np.int64]
    """(K,) corner numbers"""
    pixel: Array
    """(K, 2)"""
    why: str = ""
    """why it tells no pose, or empty"""


ON_TABLE = Board()
"""210 x 150 mm, for A4"""

ON_TOOL = Board(square=0.020, marker=0.015)
"""140 x 100 mm"""


def write_board(path: Path, board: Board) -> None:
    """Write a board as TOML [m]."""
    about = "# A ChArUco board [m]: the board that `rejoint board` drew, and how its print came out.\n"
    write_text(path, about + toml_of(asdict(board)))


def read_board(path: Path) -> Board:
    """Read a board; FileError."""
    return read_toml(path, Board, "write it with `rejoint board`")


PAGES = {"A4": (297.0, 210.0), "A3": (420.0, 297.0), "letter": (279.4, 215.9)}
"""[mm] landscape (ISO 216, ANSI Y14.1)"""
DOTS = 24
"""Dots per millimetre (chosen)"""

_BORDER = 8.0  # [mm] that printers leave white (chosen: most leave 3 to 6)
_QUIET = 6.0  # [mm] white around the board, as markers need (chosen: two cells)
_TICK = 4.0  # [mm] length of the ticks of a ruler (chosen)
_LINE = 0.2  # [mm] width of lines (chosen)
_TEXT = 3.2  # [mm] size of letters (chosen)


def write_pdf(path: Path, board: Board, page: str) -> None:
    """Draw ``board`` as a PDF; InputError where it does not fit."""
    picture = page_of(board, page)
    write_whole(path, lambda temporary: picture.save(temporary, format="PDF", resolution=DOTS * 25.4))


def page_of(board: Board, page: str) -> Image.Image:
    """Draw the page, `DOTS` per millimetre."""
    if page not in PAGES:
        raise InputError(f"board: no page is called {page!r}; known pages: {', '.join(PAGES)}")
    width, height = PAGES[page]
    across, down = 1e3 * board.square * board.columns, 1e3 * board.square * board.rows
    beside, below = 2 * _QUIET + 2 * _TICK, 2 * _QUIET + 2 * _TICK + _TEXT
    left = width - 2 * _BORDER - max(across + beside, RULER)
    over = height - 2 * _BORDER - max(down, RULER) - below
    if left < 0 or over < 0:
        raise InputError(
            f"board: {across:g} x {down:g} mm with its rulers does not fit on {page} ({width:g} x {height:g} mm); "
            "take fewer or smaller squares, or a larger page"
        )
    x, y = (round(DOTS * (_BORDER + room / 2)) / DOTS for room in (left, over))
    sheet = Image.new("1", (round(DOTS * width), round(DOTS * height)), 1)
    sheet.paste(Image.fromarray(board.drawing(1e3 * DOTS)), (round(DOTS * x), round(DOTS * y)))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(round(DOTS * _TEXT))

    starts = np.array([[x, y + down + _QUIET], [x + across + _QUIET, y]])
    for name, start, along in zip("xy", starts, np.eye(2), strict=True):
        marks = start + np.linspace(0.0, RULER, 11)[:, None] * along
        for ends in ((marks[0], marks[-1]), *zip(marks, marks + _TICK * along[::-1], strict=True)):
            pen.line(np.rint(DOTS * np.ravel(ends)).tolist(), fill=0, width=round(DOTS * _LINE))
        at = DOTS * (start + (RULER + 2) * along)
        pen.text((at[0], at[1]), f"{RULER:g} mm in {name}", fill=0, font=font)
    caption = (
        f"ChArUco {board.columns} x {board.rows}, squares {1e3 * board.square:g} mm, "
        f"markers {1e3 * board.marker:g} mm, {DICTIONARY}. "
        "Print at 100 %, then measure both rulers between their first and last tick."
    )
    pen.text((DOTS * x, DOTS * (height - _BORDER - _TEXT)), caption, fill=0, font=font)
    return sheet


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


class Detector:
    """Detector of a board."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self._opencv = cv2.aruco.CharucoDetector(board.opencv())
        self._shown = False  # whether it has been seen: then it is the right board, and any fault is of one picture

    def find(self, name: str, picture: Picture) -> BoardView:
        """Find the board in a ``picture``."""
        corners, numbers, markers, _ = self._opencv.detectBoard(picture)
        number = np.ravel([] if numbers is None else numbers).astype(np.int64)
        pixel = np.reshape([] if corners is None else corners, (-1, 2)).astype(float)
        why = next(filter(None, self._doubts(picture, markers or (), number)), "")
        self._shown |= not why
        return BoardView(name=name, number=number, pixel=pixel, why=why)

    def _doubts(self, grey: Picture, markers: Sequence[Array], number: NDArray[np.int64]) -> Iterator[str]:
        if not len(number) and not self._shown:
            yield self._unlike(grey)
        around = [np.reshape(one, (-1, 2)) for one in markers] or [np.array([[0.0, 0.0], grey.shape[1::-1]])]
        softness = edge_width(grey, np.concatenate(around))
        if not markers:
            soft = ", and nothing in the picture is sharp" if softness > SOFT else ""
            yield f"the board cannot be seen: none of its markers is found{soft}"
        if softness > SOFT:
            wide = f"its edges are {softness:.1f} px wide, expected at most {SOFT:g}"
            yield f"blurred: {wide}; hold still, focus, add light"
        if len(number) < FEWEST:
            seen = f"{len(number)} of {len(self.board.corners)} corners of the board are seen"
            yield f"{seen}, expected at least {FEWEST}"
        known = self.board.corners[number, :2]
        if np.linalg.matrix_rank(known - known[0]) < 2:
            yield "the corners of the board that are seen lie on one line"

    def _unlike(self, grey: Picture) -> str:
        """Whether the picture shows markers, but another board, or this one mirrored."""
        numbers = self._opencv.getBoard().getDictionary()
        for picture in (grey, np.ascontiguousarray(grey[:, ::-1])):
            found = cv2.aruco.ArucoDetector(numbers).detectMarkers(picture)[1]
            seen = np.ravel([] if found is None else found)
            if len(seen) >= FEWEST_MARKERS:
                if len(np.unique(seen)) < len(seen):
                    return "markers are seen twice: take every other board out of the picture"
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
    data = np.frombuffer(read_bounded(path, "take a smaller picture", PICTURE_MOST), np.uint8)
    # a phone that looks down turns its pictures by what it takes for upright, its lens does not turn
    found = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    return None if found is None else np.asarray(found, np.uint8)
