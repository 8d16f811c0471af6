"""A board is printed in true size, and its description says what came out of the printer."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rejoint.camera.board import DOTS, ON_TABLE, ON_TOOL, PAGES, page_of, read_board, write_pdf


@pytest.mark.parametrize(("board", "page"), [(ON_TOOL, "A4"), (ON_TABLE, "A4"), (ON_TABLE, "letter")])
def test_the_pdf_shows_the_board_of_opencv_in_true_size(board, page, tmp_path):
    write_pdf(tmp_path / "board.pdf", board, page)
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", (tmp_path / "board.pdf").read_bytes())
    np.testing.assert_allclose(np.array(box.groups(), float) * 25.4 / 72, PAGES[page], atol=0.03)
    grey = np.asarray(page_of(board, page).convert("L"))
    detector = cv2.aruco.CharucoDetector(board.opencv())
    corners = detector.detectBoard(grey[::4, ::4])[0].reshape(-1, 2) * 4 / DOTS / 1e3
    expected = board.corners[:, :2]
    off = corners - corners.mean(axis=0) - (expected - expected.mean(axis=0))
    assert len(corners) == len(expected)
    assert np.abs(off).max() < 5e-5


def test_rulers_are_100_mm_long():
    black = np.asarray(page_of(ON_TOOL, "A4")) == 0
    for page in (black, black.T):  # nothing else on the page is a line as long
        filled = np.pad(page.cumsum(axis=1, dtype=np.int32), ((0, 0), (1, 0)))
        lines = [(filled[:, length:] - filled[:, :-length] == length).any() for length in (100 * DOTS, 101 * DOTS)]
        assert lines == [True, False]


def test_corners_are_those_of_opencv_stretched_as_measured():
    printed = replace(ON_TOOL, stretch_x=1.004, stretch_y=0.997)
    np.testing.assert_allclose(
        printed.corners, ON_TOOL.opencv().getChessboardCorners() * [1.004, 0.997, 1.0], atol=1e-8
    )
    np.testing.assert_allclose(printed.size, [0.14 * 1.004, 0.1 * 0.997])


def test_the_command_writes_the_board_and_its_description(tmp_path, cli):
    path = tmp_path / "mine.pdf"
    words = ("--on", "table", "--squares", "8x5", "--square", "28", "--measured-x", "100.5", "--json")
    assert cli("board", path, *words).last["pdf"] == str(path)
    board = read_board(tmp_path / "mine.toml")
    assert (board.columns, board.rows, board.stretch_x, board.stretch_y) == (8, 5, 1.005, 1.0)
    assert (board.square, board.marker) == pytest.approx((0.028, 0.022 / 0.030 * 0.028), abs=1e-9)
