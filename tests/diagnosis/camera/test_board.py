"""A board is printed in true size, and its description says what came out of the printer."""

import json
import re
import sys

import numpy as np
import pytest

from rejoint.arms.camera.board import ON_TABLE, ON_TOOL, Board, read_board, write_board
from rejoint.arms.camera.drawing import PAGES, write_pdf
from rejoint.cli import main
from rejoint.system.errors import FileError, InputError

POINT = 25.4 / 72  # mm


def content(path):
    data = path.read_bytes()
    table = int(re.search(rb"startxref\n(\d+)", data)[1])
    places = [int(line[:10]) for line in data[table:].splitlines()[3:8]]
    for number, place in enumerate(places, start=1):
        assert data[place:].startswith(f"{number} 0 obj".encode())
    length = int(re.search(rb"/Length (\d+)", data)[1])
    stream = data[data.index(b"stream\n") + 7 :][:length]
    assert data[data.index(b"stream\n") + 7 + length :].startswith(b"\nendstream")
    page = np.array(re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data).groups(), float) * POINT
    return stream.decode("latin-1").splitlines(), page


def drawn_areas(lines):
    """Areas x, y, width, height [mm] and shade, through the matrix of the page."""
    scale_x, _, _, scale_y = map(float, lines[0].split()[:4])
    assert (scale_x * POINT, -scale_y * POINT) == pytest.approx((1.0, 1.0), abs=1e-8)
    return [[float(word) for word in line.split()[2:6]] + [int(line[0])] for line in lines if line.endswith("re f")]


@pytest.mark.parametrize(("board", "page"), [(ON_TOOL, "A4"), (ON_TABLE, "A4"), (ON_TABLE, "letter")])
def test_the_pdf_shows_the_board_of_opencv_in_true_size(board, page, tmp_path):
    write_pdf(tmp_path / "board.pdf", board, page)
    lines, size = content(tmp_path / "board.pdf")
    np.testing.assert_allclose(size, PAGES[page], atol=1e-4)
    areas = drawn_areas(lines)
    per_mm = 6  # cells of markers, 2.5 and 22 / 6 mm, end on such pixels
    left, top = min(a[0] for a in areas), min(a[1] for a in areas)
    picture = np.full(np.rint(1e3 * board.size[::-1] * per_mm).astype(int), 255, np.uint8)
    for x, y, width, height, shade in areas:
        x0, x1 = (round((edge - left) * per_mm) for edge in (x, x + width))
        y0, y1 = (round((edge - top) * per_mm) for edge in (y, y + height))
        picture[y0:y1, x0:x1] = 255 * shade
    expected = board.opencv().generateImage(picture.shape[::-1], marginSize=0, borderBits=1)
    assert (picture != expected).mean() < 1e-3


def test_rulers_are_100_mm_long(tmp_path):
    write_pdf(tmp_path / "board.pdf", ON_TOOL)
    lines, _ = content(tmp_path / "board.pdf")
    strokes = np.array([[float(w) for w in line.split() if w not in "mlS"] for line in lines if line.endswith(" l S")])
    length = np.abs(strokes[:, 2:] - strokes[:, :2])
    assert sorted(length.max(axis=1))[-2:] == pytest.approx([100.0, 100.0])
    ticks = strokes[length[:, 1] > 0]  # across the ruler along x: eleven, 10 mm apart
    along_x = ticks[np.isclose(ticks[:, 0], ticks[:, 2]) & (length[length[:, 1] > 0][:, 1] < 50)]
    np.testing.assert_allclose(np.diff(np.sort(along_x[:, 0])), 10.0, atol=1e-4)
    assert len(along_x) == 11


def test_a_board_that_does_not_fit_the_page_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not fit on A4"):
        write_pdf(tmp_path / "board.pdf", Board(columns=12, rows=5))
    with pytest.raises(InputError, match="known pages: A4"):
        write_pdf(tmp_path / "board.pdf", ON_TOOL, "B5")
    with pytest.raises(InputError, match="take fewer squares"):
        Board(columns=20, rows=20, square=0.008, marker=0.006).opencv()


def test_corners_are_those_of_opencv_stretched_as_measured():
    printed = ON_TOOL.printed(100.4, 99.7)
    np.testing.assert_allclose(
        printed.corners, ON_TOOL.opencv().getChessboardCorners() * [1.004, 0.997, 1.0], atol=1e-8
    )
    np.testing.assert_allclose(printed.size, [0.14 * 1.004, 0.1 * 0.997])


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ({"columns": 2}, "at least 3 x 3"),
        ({"marker": 0.03}, "markers must be smaller"),
        ({"stretch_x": 0.9}, "print it again at 100 %"),
    ],
)
def test_impossible_boards_are_refused(wrong, line):
    with pytest.raises(InputError, match=line):
        Board(**wrong)


def test_a_description_comes_back_as_it_was(tmp_path):
    path = tmp_path / "board.toml"
    write_board(path, ON_TOOL.printed(100.3, 99.9))
    assert read_board(path) == ON_TOOL.printed(100.3, 99.9)
    for text in ("columns = 'seven'", "no toml at all", 'columns = 7\nsquare_mm = "x"\nmarker_mm = 2'):
        path.write_text(text)
        with pytest.raises(FileError, match="rejoint board"):
            read_board(path)
    with pytest.raises(FileError, match="no such file"):
        read_board(tmp_path / "none.toml")


def test_the_command_writes_the_board_and_its_description(tmp_path, monkeypatch, capsys):
    def run(*words):
        monkeypatch.setattr(sys, "argv", ["rejoint", "board", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, capsys.readouterr()

    path = tmp_path / "mine.pdf"
    code, told = run(
        str(path), "--on", "table", "--squares", "8x5", "--square", "28", "--measured-x", "100.5", "--json"
    )
    assert code == 0
    assert json.loads(told.out.splitlines()[-1])["pdf"] == str(path)
    board = read_board(tmp_path / "mine.toml")
    assert (board.columns, board.rows, board.stretch_x, board.stretch_y) == (8, 5, 1.005, 1.0)
    assert (board.square, board.marker) == pytest.approx((0.028, 0.022 / 0.030 * 0.028), abs=1e-9)
    for words, line in (
        (("x.png",), "ends in .pdf"), (("x.pdf", "--on", "wall"), "--on"), (("x.pdf", "--squares", "7"), "such as 7x5"),
    ):  # fmt: skip
        code, told = run(*words)
        assert code == 2
        assert line in told.err
