"""Where the tool really is: measuring it from outside, and correcting for what the encoders do not see."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import rejoint
from rejoint.cli import filming, show
from rejoint.cli import options as opt
from rejoint.cli.console import Terminal
from rejoint.diagnosis.calibration.camera.filming import POSTURES, CameraGauge
from rejoint.diagnosis.calibration.gauges import EmulatedGauge, Gauge, Stop, TouchGauge, TrackerGauge
from rejoint.diagnosis.calibration.measurementfile import read_measurements
from rejoint.diagnosis.calibration.measurements import NOISE
from rejoint.diagnosis.calibration.preload import WEDGE, Preload
from rejoint.robots import place_of
from rejoint.runs.given import NO_GAUGE, GaugeLike
from rejoint.runs.run import Run
from rejoint.runs.stages.calibrate import POINTS
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.progress import no_progress
from rejoint.system.shell import command

Frame = Annotated[
    str, typer.Option(help="Frame of the tracker's or the file's points: base, or any other name: its pose is fitted.")
]


def calibrate(
    robot: opt.Robot,
    run: opt.Run,
    touch: Annotated[bool, typer.Option("--touch", help="Type what a ruler, calliper or height gauge says.")] = False,
    tracker: Annotated[
        Path | None, typer.Option(help="CSV file that a tracker goes on writing: time, x, y, z.")
    ] = None,
    unit: Annotated[str, typer.Option(help="Unit of the tracker's x, y and z: mm or m.")] = "mm",
    camera: Annotated[
        str | None,
        typer.Option(
            help="What sees a printed board (see `rejoint board`): the number of a camera, emulated, or a folder or "
            "pattern of pictures with their postures in postures.csv: nothing moves."
        ),
    ] = None,
    board: Annotated[
        Path | None, typer.Option(help="Description of the board, by default board.toml in this folder.")
    ] = None,
    board_on: Annotated[
        str, typer.Option(help="Where the board is: on the tool, or on the table under a camera that the tool carries.")
    ] = "tool",
    points: Annotated[
        Path | None, typer.Option(help="Measurements made before, CSV or Parquet: nothing moves.")
    ] = None,
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
    afresh: Annotated[
        bool,
        typer.Option("--afresh", help="Do not start from the run's earlier calibration, measurements or pictures."),
    ] = False,
    arm: opt.ArmOption = None,
    base: opt.Base = None,
    tip: opt.Tip = None,
    hold: opt.Hold = None,
    period: opt.Period = None,
    seed: opt.RunSeed = None,
    json: opt.Json = False,
) -> None:
    """Measure where the tool really is, and correct for what the encoders do not see, where that helps.

    The arm goes slowly to postures and stands still at each until it is measured. `deploy` and `compare` with this run
    are corrected from then on. An emulated arm tells by itself. A folder that is not there yet is begun. An interrupted
    session goes on where it was.

    Example: `rejoint calibrate serial:///dev/ttyAMA0 runs/mine --touch --count 10`, or
    `rejoint calibrate serial:///dev/ttyAMA0 runs/mine --camera 0`
    """
    terminal = Terminal(json=json)
    if touch + sum(one is not None for one in (tracker, points, camera)) > 1:
        raise InputError("calibrate takes one of --touch, --tracker FILE, --camera WORD and --points FILE")
    if camera is None and (board is not None or board_on != "tool"):
        raise InputError("--board and --board-on go with --camera")
    if camera is not None:
        require("rejoint calibrate --camera", "camera")
    if run.exists():
        job = Run.open(run).seeded(seed)
    else:
        job = Run.plan(run, robot, opt.choose_arm(terminal, arm, base, tip, robot, hold), seed or 0)
    prior = "none" if afresh else None
    if points is not None:
        measured = read_measurements(points, job.arm, frame=frame)
        found = rejoint.calibrate(run=job, points=measured, prior=prior)
    elif camera is not None and not filming.is_device(camera):
        film = filming.film_at(camera, job.arm, board, board_on)
        found = rejoint.calibrate(run=job, points=film, prior=prior)
    else:
        visits = 1 if once else 2
        gauge: Gauge | CameraGauge
        if camera is not None:
            gauge = filming.gauge_of(robot, camera, board, board_on, job.seed)
            filming.announce(terminal, count or POSTURES, visits, SECONDS)
        else:
            gauge = _gauge(terminal, robot, job.seed, frame, unit, 1e-3 * noise, touch=touch, tracker=tracker)
            total = (count or POINTS) * visits
            terminal.say(
                f"{count or POINTS} postures, {'each from two sides: ' if visits == 2 else ''}{total} measurements, "
                f"about {total * SECONDS / 60:.1f} min of the arm and what the measuring takes."
            )
        bar = nullcontext(no_progress) if touch else terminal.progress("calibrating")
        with terminal.unsaved(partial(show.calibration, terminal)), bar as update:
            found = rejoint.calibrate(
                robot, run=job, gauge=gauge, count=count, visits=visits, prior=prior,
                period=opt.period_seconds(period), on_progress=update,
            )  # fmt: skip
    show.calibration(terminal, found)
    if found.calibration.used:
        terminal.result(f"Next: {command('deploy', robot, run)}")
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
    """Return what floating joints cost, and what a wedge or a weight leaves of it, as JSON has it."""
    return {
        "joints": what.joints, "chance_mm": 1e3 * what.chance,
        "wedge_side": what.side, "wedge_deg": float(np.degrees(WEDGE)), "wedge_mm": 1e3 * what.wedge,
        "wedge_helps": what.wedge_helps, "weight_g": 1e3 * what.mass, "weight_mm": 1e3 * what.weight,
        "weight_helps": what.weight_helps,
    }  # fmt: skip


SECONDS = 4.0
"""[s] of the arm for one measurement (measured over the wire of a myCobot 280, see docs/true-accuracy.md)"""


def gauge_by_word(terminal: Terminal, robot: str, word: str | None, seed: int) -> GaugeLike | None:
    """Return what ``touch``, ``camera=WORD``, ``tracker=FILE`` or ``none`` stands for; None for no word.

    ``camera`` alone is an emulated one for an emulated arm, else the camera 0.
    """
    kind, _, file = (word or "").partition("=")
    if word is None or word == NO_GAUGE:
        return None if word is None else NO_GAUGE
    if kind == "camera" and not word.endswith("="):
        return filming.gauge_of(robot, file or _usual_camera(robot), None, "tool", seed)
    if (kind, bool(file)) not in (("touch", False), ("tracker", True)):
        raise InputError(f"--calibrate {word!r}: expected touch, camera, camera=NUMBER, tracker=FILE or none")
    tracker = Path(file) if file else None
    frame = "tracker" if file else "base"
    return _gauge(terminal, robot, seed, frame, "mm", NOISE, touch=kind == "touch", tracker=tracker)


def _usual_camera(robot: str) -> str:
    return filming.EMULATED if place_of(robot).virtual else "0"


def _gauge(
    terminal: Terminal, robot: str, seed: int, frame: str, unit: str, sigma: float, *, touch: bool, tracker: Path | None
) -> Gauge:  # fmt: skip
    """Choose what measures; a real arm needs somebody or something that does."""
    if tracker is not None:
        return TrackerGauge(path=tracker, unit=unit, sigma=sigma, frame=frame)
    if touch:
        if sys.stdin is None or not sys.stdin.readable():
            raise InputError("--touch asks at the terminal, and there is none; measure into a file and give --points")
        return TouchGauge(ask=partial(_ask, terminal), complain=terminal.say, sigma=sigma, frame=frame)
    if not place_of(robot).virtual:
        raise InputError(
            f"{robot} cannot tell where its tool is; measure it with --touch, --camera NUMBER or --tracker FILE, or "
            "give --points FILE that was measured before"
        )
    return EmulatedGauge(sigma=sigma, seed=seed)


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
