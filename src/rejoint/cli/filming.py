"""Words for cameras at the command line, and what a film told as text."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.arms.camera.board import ON_TABLE, ON_TOOL, Board, read_board
from rejoint.cli.console import Terminal
from rejoint.diagnosis.calibration.camera.film import Film
from rejoint.diagnosis.calibration.camera.filmfile import read_folder
from rejoint.diagnosis.calibration.camera.filming import SCOUTS, CameraGauge
from rejoint.diagnosis.calibration.camera.fit import Filmed
from rejoint.robots import place_of
from rejoint.system.errors import InputError
from rejoint.system.extras import require

EMULATED = "emulated"
PLACES = {"tool": "board", "table": "camera"}
"""Where the board is, and what the tool carries then"""
BOARD = Path("board.toml")
"""Description of the board where none is named, as `rejoint board board.pdf` writes it"""
_NAMED = 8  # pictures whose faults are printed line by line


def is_device(word: str) -> bool:
    """Tell whether a word is the number of a camera, or stands for an emulated one; else it names pictures."""
    return word.isdecimal() or word.partition("=")[0] == EMULATED


def gauge_of(robot: str, word: str, board: Path | None, board_on: str, seed: int) -> CameraGauge:
    """Return the gauge for ``NUMBER``, ``emulated`` or ``emulated=FILE``; InputError where it does not suit."""
    require("measuring with a camera", "camera")
    carried, (kind, _, file) = _carried(board_on), word.partition("=")
    if kind == EMULATED:
        from rejoint.robots.emulatedcamera import watching

        drawn = _board(board, required=False) or (ON_TOOL if carried == "board" else ON_TABLE)
        truth = Path(file) if file else None
        return CameraGauge(camera=watching(drawn, carried, seed, truth), board=drawn, carried=carried)
    if place_of(robot).virtual:
        raise InputError(f"camera {word} cannot see {robot}; watch an emulated arm with --camera emulated")
    from rejoint.robots.livecamera import LiveCamera

    printed = _board(board, required=True)
    assert printed is not None  # noqa: S101 - for the type checker; it was required
    number = int(word)
    return CameraGauge(camera=lambda _: LiveCamera(number), board=printed, carried=carried)


def film_at(pattern: str, arm: Arm, board: Path | None, board_on: str) -> Film:
    """Return the film of pictures that were taken elsewhere."""
    require("measuring with a camera", "camera")
    carried = _carried(board_on)
    chosen = _board(board, required=True)
    assert chosen is not None  # noqa: S101 - for the type checker; it was required
    return read_folder(pattern, arm, chosen, carried)


def _carried(board_on: str) -> str:
    if board_on not in PLACES:
        raise InputError(f"--board-on {board_on!r}: expected one of {', '.join(PLACES)}")
    return PLACES[board_on]


def _board(path: Path | None, *, required: bool) -> Board | None:
    if path is None and BOARD.exists():
        path = BOARD
    if path is None and required:
        raise InputError(
            f"which board is it? There is no {BOARD} here; print one with `rejoint board board.pdf`, and name its "
            "description with --board FILE"
        )
    return None if path is None else read_board(path)


def announce(terminal: Terminal, count: int, visits: int, seconds: float) -> None:
    """Say beforehand what will be done."""
    total = SCOUTS + count * visits
    terminal.say(
        f"{total} pictures: {SCOUTS} about the rest posture, then {count} postures that tell most"
        f"{', each from two sides' if visits == 2 else ''}; about {total * seconds / 60:.1f} min of the arm. "
        "Shift neither camera nor board until the last one is taken."
    )


def show_filmed(terminal: Terminal, found: Filmed) -> None:
    """Print which pictures were not used and why, and what was found of lens, camera and board."""
    for one in found.left_out[:_NAMED]:
        terminal.result(f"  ! {one.name} is not used: {one.why}")
    if len(found.left_out) > _NAMED:
        terminal.result(f"  ! ... and {len(found.left_out) - _NAMED} more pictures.")
    for row in found.calibration.suspects:
        terminal.result(
            f"  ? {found.residuals[row].name} was used, but fits badly: did the arm still move, or was it pushed?"
        )
    rig, mm = found.rig, partial(_with_sigma, scale=1e3, digits=1)
    sigma = found.rig_sigma
    standing, mounted = ("camera", "board") if rig.carried == "board" else ("board", "camera")
    terminal.say(
        f"{len(found.residuals)} pictures, corners within {found.rms:.2f} px. Focal length "
        f"{_with_sigma([rig.lens.f], sigma[:1], 1.0, 0)} px; {standing} in the base at "
        f"{mm(rig.standing[:3, 3], sigma[7:10])} mm; {mounted} on the tool at "
        f"{mm(rig.mounted[:3, 3], sigma[13:16])} mm (standard deviations)."
    )


def _with_sigma(values: object, sigma: object, scale: float, digits: int) -> str:
    pairs = zip(np.atleast_1d(np.asarray(values)), np.atleast_1d(np.asarray(sigma)), strict=True)
    return ", ".join(f"{scale * value:.{digits}f} +- {scale * spread:.{digits}f}" for value, spread in pairs)
