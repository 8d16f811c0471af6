"""The board as a PDF in true size, with two rulers to check the print; lines and areas only, so nothing is rescaled."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rejoint.arms.camera.board import RULER, Board
from rejoint.system.errors import InputError
from rejoint.system.files import write_whole

PAGES = {"A4": (297.0, 210.0), "A3": (420.0, 297.0), "letter": (279.4, 215.9)}
"""[mm] width and height of pages, landscape (ISO 216, ANSI Y14.1)"""

POINT = 25.4 / 72.0
"""[mm] the unit of PDF (ISO 32000-1, 8.3.2.3)"""

_BORDER = 8.0  # [mm] that printers leave white (chosen: most leave 3 to 6)
_QUIET = 6.0  # [mm] white around the board, as markers need (chosen: two cells)
_TICK = 4.0  # [mm] length of the ticks at the ends of a ruler, half of it between them (chosen)
_LINE = 0.2  # [mm] width of lines (chosen)
_TEXT = 3.2  # [mm] size of letters (chosen)


def write_pdf(path: Path, board: Board, page: str = "A4") -> None:
    """Draw ``board`` on a page as a PDF; InputError where it does not fit, MissingExtraError without OpenCV."""
    if page not in PAGES:
        raise InputError(f"board: no page is called {page!r}; known pages: {', '.join(PAGES)}")
    width, height = PAGES[page]
    x, y = _place(board, page)
    lines = [f"{1 / POINT:.8f} 0 0 {-1 / POINT:.8f} 0 {height / POINT:.8f} cm"]  # from here on: mm, y down
    lines += [_area(*rectangle, x, y) for rectangle in areas(board)]
    lines += _ruler(x, y + 1e3 * board.square * board.rows + _QUIET, across=True)
    lines += _ruler(x + 1e3 * board.square * board.columns + _QUIET, y, across=False)
    lines += [_text(x, height - _BORDER, line) for line in [_caption(board)]]
    data = _document("\n".join(lines), width / POINT, height / POINT)
    write_whole(path, lambda temporary: temporary.write_bytes(data))


def areas(board: Board) -> Iterator[tuple[float, float, float, float, bool]]:
    """Yield the areas of a board as drawn, in the order of drawing: x, y, width, height [mm] and whether black."""
    square, marker = 1e3 * board.square, 1e3 * board.marker
    _, corners, pictures = board.drawing()
    taken = {(int(x // (1e3 * square)), int(y // (1e3 * square))) for x, y in corners}
    for row in range(board.rows):
        for column in range(board.columns):
            if (column, row) not in taken:
                yield column * square, row * square, square, square, True
    for (left, top), picture in zip(corners / 1e3, pictures, strict=True):
        yield left, top, marker, marker, True
        cell = marker / len(picture)
        for number, line in enumerate(picture):
            for begin, end in _runs(line > 0):
                yield left + begin * cell, top + number * cell, (end - begin) * cell, cell, False


def _place(board: Board, page: str) -> tuple[float, float]:
    """Where on the page [mm] the board's upper left corner comes, so that all of it fits."""
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
    return _BORDER + left / 2, _BORDER + over / 2


def _runs(line: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield begin and end of each run of true cells."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(int)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def _area(left: float, top: float, width: float, height: float, black: bool, x: float, y: float) -> str:
    return f"{0 if black else 1} g {x + left:.5f} {y + top:.5f} {width:.5f} {height:.5f} re f"


def _ruler(x: float, y: float, *, across: bool) -> list[str]:
    """Draw a line of 100 mm with a tick at every 10 mm, from (x, y) [mm]; its unit beside it."""
    lines = [f"0 g 0 G {_LINE} w"]
    for i in range(11):
        at, tick = RULER * i / 10, _TICK if i in (0, 10) else _TICK / 2
        ends = (x + at, y, x + at, y + tick) if across else (x, y + at, x + tick, y + at)
        lines.append("{:.5f} {:.5f} m {:.5f} {:.5f} l S".format(*ends))
    far = (x + RULER, y) if across else (x, y + RULER)
    lines.append(f"{x:.5f} {y:.5f} m {far[0]:.5f} {far[1]:.5f} l S")
    word = f"{RULER:g} mm in {'x' if across else 'y'}"
    return [*lines, _text(x + RULER + 2, y + _TEXT, word) if across else _text(x, y + RULER + _TEXT + 2, word)]


def _caption(board: Board) -> str:
    return (
        f"ChArUco {board.columns} x {board.rows}, squares {1e3 * board.square:g} mm, "
        f"markers {1e3 * board.marker:g} mm, {board.dictionary}. "
        "Print at 100 %, then measure both rulers between their first and last tick."
    )


def _text(x: float, y: float, words: str) -> str:
    """Words from (x, y) [mm]; y runs down the page, so letters are turned up again."""
    escaped = words.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
    return f"0 g BT /F {_TEXT} Tf 1 0 0 -1 {x:.5f} {y:.5f} Tm ({escaped}) Tj ET"


def _document(content: str, width: float, height: float) -> bytes:
    """One page [pt] as a file: five objects, their table, and where that is (ISO 32000-1, 7.5)."""
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.5f} {height:.5f}] /Contents 4 0 R "
        "/Resources << /Font << /F 5 0 R >> >> >>",
        f"<< /Length {len(content.encode('latin-1'))} >>\nstream\n{content}\nendstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    text, places = "%PDF-1.4\n", []
    for number, body in enumerate(objects, start=1):
        places.append(len(text.encode("latin-1")))
        text += f"{number} 0 obj\n{body}\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    start, count = len(text.encode("latin-1")), len(objects) + 1
    text += f"xref\n0 {count}\n0000000000 65535 f \n{table}trailer\n<< /Size {count} /Root 1 0 R >>\n"
    return f"{text}startxref\n{start}\n%%EOF\n".encode("latin-1")
