"""The ChArUco board: a chessboard whose white squares hold markers, so that a part of it is enough to know which."""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.extras import require
from rejoint.system.files import TOML_MOST, read_bounded, write_whole

if TYPE_CHECKING:
    import cv2

DICTIONARY = "DICT_4X4_50"
"""Markers of 4 x 4 cells, 50 of them (chosen: the coarsest that OpenCV has, and so the best seen from afar)"""

RULER = 100.0
"""[mm] length of the rulers on the print (chosen: a calliper reads it to 0.05 %)"""

_STRETCH = 0.05
"""Share by which a print may be off before a slip of the pen is more likely (printers: 0.005, "fit to page": 0.04)"""

_SETTLED = 1e-9  # [m] what rounding may leave


@dataclass(frozen=True, kw_only=True)
class Board:
    """A ChArUco board as it is printed; the same numbers belong to the print and to the search for it."""

    columns: int = 7
    """squares along x"""
    rows: int = 5
    """squares along y"""
    square: float = 0.030
    """[m] edge of a square as drawn"""
    marker: float = 0.022
    """[m] edge of a marker as drawn"""
    dictionary: str = DICTIONARY
    """name of the markers in OpenCV"""
    stretch_x: float = 1.0
    """[1] how much longer the print is than the drawing, along x"""
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
        """(2,) [m] of the whole board as printed."""
        return self.square * np.array([self.columns * self.stretch_x, self.rows * self.stretch_y])

    @property
    def corners(self) -> Array:
        """(C, 3) [m] the inner corners of the chessboard in the board's frame, by their numbers."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        flat = np.stack([x.ravel() * self.stretch_x, y.ravel() * self.stretch_y, np.zeros(x.size)], axis=-1)
        return np.asarray(self.square * flat)

    @property
    def outline(self) -> Array:
        """(4, 3) [m] its outer corners in the board's frame, in a circle."""
        width, height = self.size
        return np.array([[0.0, 0.0, 0.0], [width, 0.0, 0.0], [width, height, 0.0], [0.0, height, 0.0]])

    def printed(self, measured_x: float | None = None, measured_y: float | None = None) -> Board:
        """Return the board whose rulers of 100 mm measure so many millimetres along x and y on the print."""
        return replace(
            self,
            stretch_x=self.stretch_x if measured_x is None else measured_x / RULER,
            stretch_y=self.stretch_y if measured_y is None else measured_y / RULER,
        )

    def drawing(self) -> tuple[Any, NDArray[np.int64], NDArray[np.uint8]]:
        """Return OpenCV's board as drawn, its markers' upper left corners (M, 2) [um] and cells (M, 6, 6), 0 black."""
        board = self.opencv()
        dictionary = board.getDictionary()
        cells = dictionary.markerSize + 2
        corners = np.array(board.getObjPoints())[:, 0, :2]
        ids = np.ravel(board.getIds())
        pictures = [dictionary.generateImageMarker(int(number), cells, borderBits=1) for number in ids]
        return board, np.rint(1e6 * corners).astype(np.int64), np.array(pictures, dtype=np.uint8)

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's board as drawn; MissingExtraError without OpenCV, InputError for unknown markers."""
        require("a camera", "camera")
        import cv2

        number = getattr(cv2.aruco, self.dictionary, None) if self.dictionary.startswith("DICT_") else None
        if not isinstance(number, int):
            raise InputError(f"board: OpenCV knows no markers {self.dictionary!r}; the usual ones are {DICTIONARY}")
        markers = cv2.aruco.getPredefinedDictionary(number)
        needed, known = self.columns * self.rows // 2, len(markers.bytesList)
        if needed > known:
            raise InputError(
                f"board: {self.columns} x {self.rows} squares need {needed} markers, {self.dictionary} has {known}; "
                "take fewer squares"
            )
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, markers)


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardView:
    """What one picture shows of the board."""

    name: str
    number: NDArray[np.int64]
    """(K,) which corners of the board"""
    pixel: Array
    """(K, 2) where they are; pixels have their centres at whole numbers"""

    def __post_init__(self) -> None:
        if self.pixel.shape != (len(self.number), 2):
            raise InputError(f"view {self.name}: {len(self.number)} corners, but pixels of shape {self.pixel.shape}")


ON_TABLE = Board()
"""210 x 150 mm: on A4 with its rulers, for the table under a camera that the tool carries"""

ON_TOOL = Board(square=0.020, marker=0.015)
"""140 x 100 mm: small enough for a tool, and 5 px a cell at 0.6 m in a picture of 1920 px"""


def write_board(path: Path, board: Board) -> None:
    """Write the description of a board as TOML, sizes in mm; `read_board` reads it."""
    told = asdict(board)
    square, marker = 1e3 * told.pop("square"), 1e3 * told.pop("marker")
    told |= {"square_mm": round(square, 6), "marker_mm": round(marker, 6)}
    lines = [f"{name} = {msgspec.json.encode(value).decode()}" for name, value in told.items()]
    text = "# A ChArUco board: the board that `rejoint board` drew, and how its print came out.\n" + "\n".join(lines)
    write_whole(path, lambda temporary: temporary.write_text(text + "\n", encoding="utf-8"))


def read_board(path: Path) -> Board:
    """Read what `write_board` wrote; FileError if it is no description of a board."""
    remedy = "write it with `rejoint board`"
    try:
        told = tomllib.loads(read_bounded(path, TOML_MOST, remedy).decode())
        told["square"], told["marker"] = told.pop("square_mm") / 1e3, told.pop("marker_mm") / 1e3
        return msgspec.convert(told, Board, strict=True)
    except FileNotFoundError as error:
        raise FileError(path, "no such file", remedy) from error
    except KeyError as error:
        raise FileError(path, f"is no board: {error.args[0]} is missing", remedy) from error
    except (OSError, ValueError, TypeError, msgspec.MsgspecError) as error:
        raise FileError(path, f"is no board ({first_line(error)})", remedy) from error
