"""Commands that measure where the tool really is, and prepare that."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import rejoint
from rejoint.arms import Arm
from rejoint.arms.camera.board import ON_TABLE, ON_TOOL, Board, read_board
from rejoint.cli import options as opt
from rejoint.cli import show
from rejoint.cli.console import ConsoleObserver, Terminal, watched
from rejoint.cli.options import Json
from rejoint.diagnosis.calibration.camera.film import Film, read_folder
from rejoint.diagnosis.calibration.camera.filming import POSTURES, SCOUTS, CameraGauge
from rejoint.diagnosis.calibration.measurementfile import read_measurements
from rejoint.diagnosis.calibration.measurements import NOISE
from rejoint.diagnosis.calibration.preload import WEDGE, Preload
from rejoint.diagnosis.calibration.procedure import EmulatedGauge, Stop, TouchGauge, TrackerGauge
from rejoint.robots import place_of
from rejoint.runs.run import Run
from rejoint.runs.stages.calibrate import POINTS
from rejoint.session.inputs import NO_GAUGE, GaugeLike
from rejoint.session.settings import Settings
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.shell import command

Frame = Annotated[
    str, typer.Option(help="Frame of the tracker's or the file's points: base, or any other name: its pose is fitted.")
]


@opt.with_arm
@opt.with_settings("period", "seed", "dry_run")
def calibrate(
    robot: opt.Robot,
    run: opt.Run,
    measure: opt.Measure = None,
    unit: Annotated[str, typer.Option(help="Unit of the tracker's x, y and z: mm or m.")] = "mm",
    board: Annotated[
        Path | None, typer.Option(help="Description of the board, by default board.toml in this folder.")
    ] = None,
    board_on: Annotated[
        str, typer.Option(help="Where the board is: on the tool, or on the table under a camera that the tool carries.")
    ] = "tool",
    frame: Frame = "base",
    count: Annotated[
        int | None,
        typer.Option(
            help=f"Postures to measure, each from two sides: by default {POINTS}, with a camera {POSTURES}.",
            min=1,
            max=200,
        ),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Come to each posture from one side only.")] = False,
    noise: Annotated[float, typer.Option(help="Standard deviation of a measured coordinate in mm.", min=0.001)] = 1e3
    * NOISE,
    fresh: Annotated[
        bool,
        typer.Option("--fresh", help="Do not start from the run's earlier calibration, measurements or pictures."),
    ] = False,
    live: opt.Live = None,
    json: opt.Json = False,
    *,
    pick: opt.ArmPick,
    settings: Settings,
) -> None:
    """Measure where the tool really is, and correct for what the encoders do not see, where that helps.

    The arm goes slowly to postures and stands still at each until it is measured. `deploy` and `compare` with this run
    are corrected from then on. An emulated arm tells by itself. A folder that is not there yet is begun. An interrupted
    session goes on where it was.

    Example: `rejoint calibrate serial:///dev/ttyAMA0 runs/mine --measure touch --count 10`, or
    `rejoint calibrate serial:///dev/ttyAMA0 runs/mine --measure camera`
    """
    terminal = Terminal(json=json, dry=settings.dry_run)
    kind, _, what = (measure or "").partition("=")
    if kind != "camera" and (board is not None or board_on != "tool"):
        raise InputError("--board and --board-on go with --measure camera")
    if kind == NO_GAUGE:
        raise InputError("--measure none goes with repair; name what measures, or leave it out")
    if kind == "camera":
        require("rejoint calibrate --measure camera", "camera")
    if run.exists():
        job = Run.open(run).seeded(settings.seed)
    else:
        job = Run.plan(run, robot, opt.choose_arm(terminal, pick, robot), settings.seed or 0)
    settings = replace(settings, calibration="none" if fresh else None)
    if kind == "points" or (kind == "camera" and what and not is_device(what)):
        given = (
            read_measurements(Path(what), job.arm, frame=frame)
            if kind == "points"
            else film_at(what, job.arm, board, board_on)
        )
        found = rejoint.calibrate(run=job, gauge=given, settings=settings)
    else:
        visits = 1 if once else 2
        means = Means(frame=frame, unit=unit, sigma=1e-3 * noise, board=board, board_on=board_on)
        gauge = gauge_by_word(terminal, robot, measure or "", job.seed, means)
        if kind == "camera":
            announce(terminal, count or POSTURES, visits, SECONDS)
        else:
            total = (count or POINTS) * visits
            terminal.say(
                f"{count or POINTS} postures, {'each from two sides: ' if visits == 2 else ''}{total} measurements, "
                f"about {total * SECONDS / 60:.1f} min of the arm and what the measuring takes."
            )
        quiet = ConsoleObserver(terminal)  # a bar would write over the questions
        watching = nullcontext(quiet) if kind == "touch" else watched(terminal, "calibrate", "calibrating", live)
        with terminal.unsaved(partial(show.calibration, terminal)), watching as observer:
            found = rejoint.calibrate(
                robot, run=job, gauge=gauge, count=count, visits=visits, settings=settings, observer=observer
            )
    show.calibration(terminal, found)
    if found.calibration.used:
        terminal.next(command("deploy", robot, run))
    terminal.finish({
        "run": str(run), "used": found.calibration.used, "before_mm": 1e3 * found.before, "after_mm": 1e3 * found.after,
        "points": found.calibration.points, "suspects": found.calibration.suspects,
        "reversal_mm": [1e3 * value for value in found.reversal], "calibration": str(job.folder.calibration),
        "preload": _preload_fields(found.preload),
        **({} if found.filmed is None else {
            "left_out": found.filmed.left_out, "residuals": found.filmed.residuals, "camera": str(job.folder.camera),
        }),
    })  # fmt: skip


def _preload_fields(what: Preload) -> dict[str, object]:
    return {
        "joints": what.joints,
        "chance_mm": 1e3 * what.chance,
        "wedge_side": what.side,
        "wedge_deg": float(np.degrees(WEDGE)),
        "wedge_mm": 1e3 * what.wedge,
        "wedge_helps": what.wedge_helps,
    }


SECONDS = 4.0
"""[s] of the arm for one measurement (measured over the wire of a myCobot 280, see docs/true-accuracy.md)"""


@dataclass(frozen=True)
class Means:
    """How the tool is measured, beside by what."""

    frame: str | None = None
    """of the points; None: the base, or of a tracker its own"""
    unit: str = "mm"
    sigma: float = NOISE
    """[m] standard deviation of a coordinate"""
    board: Path | None = None
    board_on: str = "tool"


def gauge_by_word(
    terminal: Terminal, robot: str, word: str | None, seed: int, means: Means | None = None
) -> GaugeLike | None:
    """Return what ``touch``, ``camera=WORD``, ``tracker=FILE`` or ``none`` stands for; None for None."""
    if word is None or word == NO_GAUGE:
        return None if word is None else NO_GAUGE
    means, virtual = means or Means(), place_of(robot).virtual
    kind, named, what = word.partition("=")
    if kind == "camera" and bool(named) == bool(what):
        usual = EMULATED if virtual else "0"
        return gauge_of(robot, what or usual, means.board, means.board_on, seed)
    if kind == "tracker" and what:
        return TrackerGauge(path=Path(what), unit=means.unit, sigma=means.sigma, frame=means.frame or "tracker")
    frame = means.frame or "base"
    if word == "touch":
        if sys.stdin is None or not sys.stdin.readable():
            raise InputError(
                "--measure touch asks at the terminal, and there is none; measure into a file and give "
                "--measure points=FILE"
            )
        return TouchGauge(ask=partial(_ask, terminal), complain=terminal.say, sigma=means.sigma, frame=frame)
    if word:
        raise InputError(
            f"--measure {word!r}: expected touch, camera, camera=NUMBER, tracker=FILE or none; `calibrate` takes "
            "points=FILE and camera=PICTURES as well"
        )
    if not virtual:
        raise InputError(
            f"{robot} cannot tell where its tool is; measure it with --measure touch, camera=NUMBER or tracker=FILE, "
            "or give points=FILE that was measured before"
        )
    return EmulatedGauge(sigma=means.sigma, seed=seed)


def _ask(terminal: Terminal, stop: Stop) -> str:
    x, y, z = 1e3 * stop.believed
    if stop.again:
        terminal.say(f"{stop.again}; it is measured once more.")
    terminal.say(
        f"{stop.number}/{stop.total}  The arm stands still; its encoders see the tool at {x:.1f}, {y:.1f}, {z:.1f} mm."
    )
    terminal.notes.print("Where is it? x y z in mm, - for one not measured, empty to leave it out: ", end="")
    line = sys.stdin.readline()
    if not line:
        raise InputError("the answers ended before the last posture was measured")
    return line


EMULATED = "emulated"
PLACES = {"tool": "board", "table": "camera"}
"""Where the board is, and what the tool carries then"""
BOARD = Path("board.toml")
"""Description of the board where none is named, as `rejoint board board.pdf` writes it"""


def is_device(word: str) -> bool:
    """Tell whether a word is the number of a camera, or stands for an emulated one; else it names pictures."""
    return word.isdecimal() or word == EMULATED


def gauge_of(robot: str, word: str, board: Path | None, board_on: str, seed: int) -> CameraGauge:
    """Return the gauge for ``NUMBER`` or ``emulated``; InputError where it does not suit."""
    require("measuring with a camera", "camera")
    carried = _carried(board_on)
    if word == EMULATED:
        from rejoint.robots.cameras import watching

        drawn = _board(board, required=False) or (ON_TOOL if carried == "board" else ON_TABLE)
        return CameraGauge(camera=watching(drawn, carried, seed), board=drawn, carried=carried)
    if place_of(robot).virtual:
        raise InputError(f"camera {word} cannot see {robot}; watch an emulated arm with camera=emulated")
    from rejoint.robots.cameras import LiveCamera

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


def board(
    file: Annotated[Path, typer.Argument(help="PDF to write; its description goes beside it, as .toml.")],
    on: Annotated[str, typer.Option(help="Where it is for: tool (20 mm squares) or table (30 mm squares).")] = "tool",
    squares: Annotated[
        str | None, typer.Option(help="Squares along x and y, such as 7x5; by default those of --on.")
    ] = None,
    square: Annotated[float | None, typer.Option(help="Edge of a square in mm; by default that of --on.")] = None,
    page: Annotated[str, typer.Option(help="Page, landscape: A4, A3 or letter.")] = "A4",
    measured_x: Annotated[
        float | None, typer.Option(help="Length in mm that the 100 mm ruler along x has on your print.")
    ] = None,
    measured_y: Annotated[
        float | None, typer.Option(help="Length in mm that the 100 mm ruler along y has on your print.")
    ] = None,
    json: Json = False,
) -> None:
    """Write a ChArUco board as a PDF in true size, with rulers to check the print.

    Print it at 100 %, measure both rulers with a calliper, and run the command again with `--measured-x` and
    `--measured-y`: what is off by more than 0.05 mm matters. Glue it on something flat, stiff and light.

    Example: `rejoint board board.pdf --measured-x 100.2 --measured-y 99.9`
    """
    require("rejoint board", "camera")
    from rejoint.arms.camera.board import ON_TABLE, ON_TOOL, write_board, write_pdf

    terminal, kinds = Terminal(json=json), {"tool": ON_TOOL, "table": ON_TABLE}
    if file.suffix.lower() != ".pdf":
        raise InputError(f"{file}: expected a file name that ends in .pdf")
    if on not in kinds:
        raise InputError(f"--on {on!r}: expected one of {', '.join(kinds)}")
    chosen = kinds[on]
    if squares is not None:
        columns, rows = _squares(squares)
        chosen = replace(chosen, columns=columns, rows=rows)
    if square is not None:
        chosen = replace(chosen, square=square / 1e3, marker=chosen.marker / chosen.square * square / 1e3)
    chosen = chosen.printed(measured_x, measured_y)
    write_pdf(file, chosen, page)
    description = file.with_suffix(".toml")
    write_board(description, chosen)
    width, height = 1e3 * chosen.size
    terminal.result(f"Board of {width:.1f} x {height:.1f} mm: {file}; what the fit is to know of it: {description}")
    if measured_x is None or measured_y is None:
        terminal.say("Print it at 100 %, measure both rulers, and run this again with --measured-x and --measured-y.")
    terminal.finish({"pdf": file, "board": description, "width_mm": width, "height_mm": height})


def _squares(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise InputError(f"--squares {text!r}: expected two whole numbers such as 7x5")
    return int(parts[0]), int(parts[1])
