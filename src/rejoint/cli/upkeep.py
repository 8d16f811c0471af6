"""Commands that look after an arm: where its tool really is, how it wears over months, and many arms in one command."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import rejoint
from rejoint.cli import options as opt
from rejoint.cli import show
from rejoint.cli.console import Terminal, picked, typed
from rejoint.cli.options import Call, takes
from rejoint.control.recording import StageObserver
from rejoint.diagnosis.calibration.measurements import NOISE, read_measurements
from rejoint.diagnosis.calibration.procedure import EmulatedGauge, Stop, TouchGauge, TrackerGauge
from rejoint.logs.history import find_rows, name_of, plain_name
from rejoint.logs.runfolder import RUNS
from rejoint.robots import place_of
from rejoint.runs.fleet.campaign import FleetRules, Verb, run_fleet
from rejoint.runs.fleet.file import known_arms
from rejoint.runs.history import HEADERS, arms_of, cells, code_of, counted, prometheus_text, write_history
from rejoint.runs.run import Run, newest_or_new
from rejoint.runs.stages.calibrate import POINTS
from rejoint.runs.stages.check import BETWEEN
from rejoint.session.inputs import NO_GAUGE, GaugeLike, to_keep
from rejoint.system.errors import FileError, InputError, MissingExtraError
from rejoint.system.extras import require
from rejoint.system.files import write_text
from rejoint.system.shell import command, free_cores

if TYPE_CHECKING:
    from rejoint.camera.board import Board


@takes
def calibrate(
    call: Call,
    robot: str,
    run: Path,
    measure: str | None = None,
    unit: str = "mm",
    board: Path | None = None,
    board_on: Literal["tool", "table"] = "tool",
    frame: str = "base",
    count: int | None = None,
    once: bool = False,
    noise: float = 1e3 * NOISE,
    fresh: bool = False,
) -> object:
    """Measure where the tool really is, and correct for what the encoders do not see, where that helps."""
    kind, _, what = (measure or "").partition("=")
    if kind == NO_GAUGE:
        raise InputError("--measure none goes with repair; name what measures, or leave it out")
    pictures = kind == "camera" and what and not (what.isdecimal() or what == EMULATED)
    given = {
        "board": board,
        "board-on": board_on != "tool",
        "frame": frame != "base",
        "unit": unit != "mm",
        "count": count,
        "once": once,
        "noise": noise != 1e3 * NOISE,
    }
    for option in filter(given.get, given):
        kinds = _WITH[option]
        if (PICTURES if pictures else kind) not in kinds:
            raise InputError(f"--{option} goes with --measure {' or '.join(filter(None, kinds))}")
    if run.exists():
        job = Run.open(run).seeded(call.settings.seed)
    else:
        job = Run.plan(run, robot, call.arm(robot), call.settings.seed or 0, name=call.named.name)
    if fresh and call.settings.calibration:
        raise InputError("--fresh begins without a calibration: leave it or --calibration out")
    settings = replace(call.settings, calibration="none") if fresh else call.settings
    means = Means(frame=frame, unit=unit, sigma=1e-3 * noise, board=board, carried=PLACES[board_on])
    about = {"run": job, "settings": settings}
    if kind == "points":
        about["gauge"] = read_measurements(Path(what), job.arm, frame=frame, sigma=means.sigma)
    elif pictures:
        from rejoint.camera.film import read_folder

        about["gauge"] = read_folder(what, job.arm, means.pattern(), means.carried)
    else:
        gauge = gauge_by_word(call, robot, measure or "", job.seed, means)
        visits, scouts = 2 - once, getattr(gauge, "scouts", 0)
        count = count or int(getattr(gauge, "postures", POINTS))
        total = scouts + count * visits
        call.message(
            f"{count} postures{', each from two sides' * (not once)}: {total} measurements, about "
            f"{total * SECONDS / 60:.1f} min of the arm and what the measuring takes."
        )
        if scouts:
            call.message(f"{scouts} pictures come first, about the rest posture. Shift neither camera nor board.")
        about |= {"robot": robot, "gauge": gauge, "count": count, "visits": visits}
    found = call.do(rejoint.calibrate, **about)
    if found.calibration.used and not found.calibration.wrong_zeros:
        call.next(command("deploy", robot, run))
    value = {
        "run": run,
        **picked(found.calibration, "used", "points", "suspects", "wrong_zeros"),
        "before_mm": 1e3 * found.before,
        "after_mm": 1e3 * found.after,
        "reversal_mm": [1e3 * one for one in found.reversal],
        "calibration": job.folder.calibration,
        "preload": found.preload,
    }
    if found.filmed is not None:
        value |= {**picked(found.filmed, "left_out", "residuals"), "camera": job.folder.camera}
    return value


SECONDS = 4.0
"""[s] of the arm for one measurement (measured, docs/true-accuracy.md)"""
EMULATED, PICTURES = "emulated", "camera=PICTURES"
_VISITING, _PLACED = ("", "touch", "camera", "tracker"), ("points", "touch", "tracker")
_WITH = {
    **dict.fromkeys(("board", "board-on"), ("camera", PICTURES)),
    **dict.fromkeys(("count", "once"), _VISITING),
    "frame": _PLACED,
    "unit": ("tracker",),
    "noise": ("", *_PLACED),
}
"""Ways of measuring that an option goes with; "": an emulated tracker"""
PLACES = {"tool": "board", "table": "camera"}
"""Where the board is, and what the tool carries then"""
BOARD = Path("board.toml")
"""Description of the board where none is named, as `rejoint board board.pdf` writes it"""


class Means(NamedTuple):
    """How the tool is measured, beside by what."""

    frame: str | None = None
    """of the points; None: the base, or of a tracker its own"""
    unit: str = "mm"
    sigma: float = NOISE
    """[m] standard deviation of a coordinate"""
    board: Path | None = None
    carried: str = "board"
    """what the tool carries"""

    def pattern(self, usual: Board | None = None) -> Board:
        """Return the board; InputError where none is described and there is no ``usual`` one."""
        path = self.board or (BOARD if BOARD.exists() else None)
        if path is not None:
            from rejoint.camera.board import read_board

            return read_board(path)
        if usual is None:
            raise InputError(
                f"which board is it? There is no {BOARD} here; print one with `rejoint board board.pdf`, and name its "
                "description with --board FILE"
            )
        return usual


def gauge_by_word(
    terminal: Terminal, robot: str, word: str | None, seed: int, means: Means | None = None
) -> GaugeLike | None:
    """Return what ``touch``, ``camera=WORD``, ``tracker=FILE`` or ``none`` stands for; None for None."""
    if word is None or word == NO_GAUGE:
        return word
    means, virtual = means or Means(), place_of(robot).virtual
    kind, named, what = word.partition("=")
    number = what if named else EMULATED if virtual else "0"
    if kind == "camera" and (number == EMULATED or number.isdecimal()):
        from rejoint.camera.board import ON_TABLE, ON_TOOL
        from rejoint.camera.filming import camera_gauge

        if number == EMULATED:
            drawn = means.pattern(ON_TOOL if means.carried == "board" else ON_TABLE)
            return camera_gauge(None, drawn, carried=means.carried, seed=seed)
        if virtual:
            raise InputError(f"camera {number} cannot see {robot}; watch an emulated arm with camera=emulated")
        return camera_gauge(int(number), means.pattern(), carried=means.carried)
    if kind == "tracker" and what:
        return TrackerGauge(path=Path(what), unit=means.unit, sigma=means.sigma, frame=means.frame or "tracker")
    if word == "touch":
        if sys.stdin is None:
            raise InputError(
                "--measure touch asks at the terminal, and there is none; measure into a file and give "
                "--measure points=FILE"
            )
        ask, frame = partial(_ask, terminal, typed()), means.frame or "base"
        return TouchGauge(ask=ask, sigma=means.sigma, frame=frame)
    if word or not virtual:
        raise InputError(
            f"--measure {word!r} with {robot}: expected touch, camera=NUMBER or tracker=FILE, or none in a repair; "
            "`calibrate` takes points=FILE and camera=PICTURES as well"
        )
    return EmulatedGauge(sigma=means.sigma, seed=seed)


def _ask(terminal: Terminal, lines: Iterator[bytes], stop: Stop) -> str:
    terminal.bars.close()  # one would write over the question
    terminal.notes.print(stop.question, end=" ", markup=False)
    line = next(lines, b"")
    if not line:
        raise InputError("the answers ended before the last posture was measured")
    return line.decode(errors="replace")


@takes
def board(
    call: Call,
    file: Path,
    on: Literal["tool", "table"] = "tool",
    squares: str | None = None,
    square: float | None = None,
    page: str = "A4",
    measured_x: float | None = None,
    measured_y: float | None = None,
) -> object:
    """Write a ChArUco board as a PDF in true size, with rulers to check the print."""
    from rejoint.camera.board import ON_TABLE, ON_TOOL, RULER, write_board, write_pdf

    chosen = ON_TOOL if on == "tool" else ON_TABLE
    if file.suffix.lower() != ".pdf":
        raise InputError(f"{file}: expected a file name that ends in .pdf")
    if squares is not None:
        found = re.fullmatch(r"(\d+)[xX](\d+)", squares)
        if found is None:
            raise InputError(f"--squares {squares!r}: expected two whole numbers such as 7x5")
        chosen = replace(chosen, columns=int(found[1]), rows=int(found[2]))
    if square is not None:
        chosen = replace(chosen, square=square / 1e3, marker=chosen.marker / chosen.square * square / 1e3)
    x, y = ((RULER if one is None else one) / RULER for one in (measured_x, measured_y))
    chosen = replace(chosen, stretch_x=x, stretch_y=y)
    write_pdf(file, chosen, page)
    description = file.with_suffix(".toml")
    write_board(description, chosen)
    width, height = 1e3 * chosen.size
    call.result(f"Board of {width:.1f} x {height:.1f} mm: {file}; what the fit is to know of it: {description}")
    if measured_x is None or measured_y is None:
        call.message("Print it at 100 %, measure both rulers, and run this again with --measured-x and --measured-y.")
    return {"pdf": file, "board": description, "width_mm": width, "height_mm": height}


@takes
def check(
    call: Call,
    robot: str,
    history: Path = RUNS,
    name: str | None = None,
    tolerance: float | None = None,
    *,
    notes: rejoint.CheckNotes,
    repeat: int = 1,
    prometheus: Path | None = None,
    seed: int | None = None,
) -> object:
    """See in two and a half minutes whether an arm has become worse, and how long it will still do."""
    chosen, name = call.arm(robot), call.named.name or None if name is None else name
    described = (word for option, value in call.pick._asdict().items() if value for word in (f"--{option}", value))
    here = counted(history, plain_name(name) if name else name_of(robot, chosen.name))
    notes = replace(
        notes, repair=command("repair", call.named.name or robot, *described, *to_keep(call.settings).options(), *here)
    )
    with call.watched("check") as observer:
        for number in range(repeat):
            if number:
                notes = replace(notes, when=notes.when and notes.when + BETWEEN, moved=False)
            found = rejoint.check(
                robot,
                history=history,
                name=name,
                arm=chosen,
                tolerance_mm=call.named.tolerance_mm if tolerance is None else tolerance,
                notes=notes,
                settings=replace(call.settings, seed=seed),
                observer=StageObserver(observer, number / repeat, (number + 1) / repeat),
            )
    if call.settings.dry_run:
        return picked(found, "arm", "robot")
    for problem in found.unread:
        call.message(f"left out: {problem}")
    call.result(f"{found.arm}: {found.line}")
    outlook = found.outlook
    if prometheus is not None:
        write_text(prometheus, prometheus_text(found.arm, outlook, found.measures))
    call.code = code_of(outlook)
    return {**picked(found, "arm", "robot", "line", "outlook", "measures", "folder"), "over": outlook.over}


@takes
def history(call: Call, folder: Path = RUNS, page: Path | None = None) -> object:
    """Show all arms of a folder, the worst first, as a table and as a page."""
    if not folder.is_dir():
        raise FileError(folder, "no such folder", "check an arm first: rejoint check ROBOT")
    rows, unread = find_rows(folder)
    for problem in unread:
        call.message(f"left out: {problem}")
    arms = arms_of(rows)
    if arms:
        call.table("All arms with a check or a run, the worst first", HEADERS, [cells(one) for one in arms])
    else:
        call.result(f"There are no checks and no runs below {folder}; begin with: rejoint check ROBOT")
    try:
        if absent := {one.name for one in known_arms()} - {one.name for one in arms}:
            call.message(f"No check and no run below {folder}: {', '.join(sorted(absent))}")
    except FileError as error:
        call.message(str(error))
    path = page or folder / "history.html"
    value = {"arms": [one.newest for one in arms], "left_out": unread}
    try:
        require("the page of the history", "report")
    except MissingExtraError as error:
        if page is not None:
            raise
        call.message(f"No page: {error}")
        return value | {"page": None}
    write_history(path, arms)
    call.result(f"Page: {path}")
    return value | {"page": path}


@takes
def fleet(
    call: Call,
    verb: Verb,
    file: Path,
    only: str = "",
    *,
    rules: FleetRules,
    trials: rejoint.TrialPlan,
    address: str | None = None,
    cpus: int | None = None,
    preset: str = "default",
    controllers: str = "all",
) -> object:
    """Check or repair many arms, each within its hours and with its permissions, and show them, the worst first."""
    require(f"rejoint fleet {verb}", "fleet", "report", *(["train"] if verb == "repair" and address is None else []))
    from rejoint.runs.fleet.file import read_fleet
    from rejoint.runs.fleet.rayexecutor import RayExecutor, has_token

    found, names = read_fleet(file), opt.controller_names(only) if only else ()
    if call.settings.dry_run:
        for arm in found.only(names):
            call.message(f"{arm.name}:")
            with call.watched(verb) as observer:
                about: dict[str, Any] = {"arm": arm.description, "settings": call.settings, "observer": observer}
                if verb == "check":
                    rejoint.check(arm.address, **about)
                else:
                    run = newest_or_new(arm.address, arm.built, found.folder / "repairs" / arm.name)
                    rejoint.repair(arm.address, run=run, quick=rules.quick, **about)
        return {"fleet": file}
    if address is not None and not has_token():
        call.message(
            f"warning: no token for Ray: anyone who reaches {address} may run programs there; see docs/monitoring.md"
        )

    plan = rejoint.RepairPlan(preset=preset, controllers=opt.controller_names(controllers), trials=trials)
    rules = replace(rules, plan=plan)
    if address is None:  # all control loops run here
        rules = replace(rules, at_once=cpus or free_cores())
    executor = partial(RayExecutor, address=address, cpus=cpus)
    with call.watched("fleet", bar=False):
        result = run_fleet(found, verb, executor, rules, only=names, tell=call.message)
    call.show(show.fleet(result))
    if rules.quick:
        call.message("A quick try: little of everything was done, so none of this is a result.")
    call.result(f"Page: {os.path.relpath(result.page)}")
    call.code = result.code
    return {"verb": verb, **picked(result, "rows", "seconds", "page", "finished")}
