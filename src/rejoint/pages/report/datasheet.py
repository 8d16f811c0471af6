"""The data sheet of one arm: a page to print, each number with its count and interval, or "not known"."""

from __future__ import annotations

from pathlib import Path

import jinja2
import numpy as np

from rejoint.arms.workspace import reach
from rejoint.control.accuracy import TrueError
from rejoint.control.comparison.recommend import recommend
from rejoint.control.comparison.result import ControllerRow, PoseAccuracy
from rejoint.diagnosis.calibration.procedure import reversals
from rejoint.pages.report.contents import Contents, read_contents
from rejoint.pages.report.errors import found
from rejoint.pages.report.numerals import UNKNOWN, interval, number
from rejoint.pages.report.view import Cell, Row, Table
from rejoint.pages.report.words import measured_with
from rejoint.system.files import write_whole
from rejoint.system.statistics import Spread, spread
from rejoint.system.version import __version__

MM = 1e3


def write_datasheet(folder: Path, out: Path) -> Path:
    """Write the data sheet of the arm of a run folder; FileError if a file there is damaged."""
    contents = read_contents(folder)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rejoint.pages.report", "."), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    html = environment.get_template("datasheet.html").render(
        arm=contents.arm.name, facts=_facts(contents), tables=(_accuracy(contents), _joints(contents)),
        footer=f"Made by rejoint {__version__}. “{UNKNOWN}”: nobody has measured it.", unknown=UNKNOWN,
    )  # fmt: skip
    write_whole(out, lambda temporary: temporary.write_text(html, encoding="utf-8"))
    return out


def _best(contents: Contents) -> ControllerRow | None:
    comparison = contents.comparison
    return None if comparison is None else comparison.row(recommend(comparison).controller)


def _facts(contents: Contents) -> tuple[tuple[str, str], ...]:
    arm, best, calibration = contents.arm, _best(contents), contents.calibration
    calibrated = UNKNOWN
    if calibration is not None:
        used = "used" if calibration.used else "not used: it does not clearly help"
        how = measured_with(calibration.source)
        calibrated = f"{_date(calibration.date)}, {calibration.points} measurements with {how}, {used}"
    info = contents.info
    return (
        ("Robot", UNKNOWN if info is None else info.robot), ("Date", UNKNOWN if info is None else _date(info.created)),
        ("Controller recommended", UNKNOWN if best is None else best.controller),
        ("Control period", _period(contents)), ("Calibrated", calibrated),
        ("Reach", number(reach(arm) * MM, 3, "mm")),
        ("Lowest height of the tool", number(arm.floor * MM, 3, "mm")), ("Payload", UNKNOWN), ("Temperature", UNKNOWN),
    )  # fmt: skip


def _date(text: str) -> str:
    return text.partition("T")[0] or UNKNOWN


def _period(contents: Contents) -> str:
    """Tell the middle of the control periods in the logs of the comparison, and of how many."""
    periods = np.concatenate([np.diff(log.time) for log in contents.hold.values()] or [np.zeros(0)])
    if not len(periods):
        return UNKNOWN
    low, high = np.quantile(periods, [0.025, 0.975]) * MM
    return f"{number(float(np.median(periods)) * MM, 3, 'ms')} (95 % of {len(periods)}: {interval(low, high, 3)})"


def _accuracy(contents: Contents) -> Table:
    best, before = _best(contents), found(contents)
    hold = None if best is None else best.hold
    poses, tool = (None, None) if hold is None else (hold.poses, hold.poses_true)
    rows = (
        _row("Encoder error, as found", before.encoders, *_found_range(contents)),
        _true("True error, as found", before.tool, _found_count(contents)),
        _spread("Encoder error, repaired", None if hold is None else hold.settled),
        _true("True error, repaired", TrueError() if hold is None else hold.true_error, _held(best)),
        *_pose_rows("by the encoders", poses), *_pose_rows("of the tool", tool),
        *_direction_rows(contents),
        _spread("Reversal value at the tool, ISO 230-2", _reversal(contents)),
        *_left_out(contents),
    )  # fmt: skip
    notes = (
        "As found: open loop, or with the arm's own controller. Repaired: with the controller recommended, at rest. "
        "AP, RP and vAP after ISO 9283, which asks for 30 cycles, and three directions for vAP. n: targets, poses, "
        "postures or points.",
    )
    return Table(caption="Accuracy", headers=("quantity", "mm", "95 % interval", "n", "how"), rows=rows, notes=notes)


def _row(name: str, value: float | None, likely: str, count: str, how: str = "encoders") -> Row:
    known = "" if value is None else how
    digits = None if value is None else value * MM
    return Row(cells=(Cell(name), Cell(number(digits, 3)), Cell(likely), Cell(count), Cell(known)))


def _spread(name: str, one: Spread | None, how: str = "") -> Row:
    if one is None:
        return _row(name, None, "", "")
    how = how or ("encoders" if "ncoder" in name else "measured")
    return _row(name, one.mean.value, interval(one.mean.low, one.mean.high, 3, factor=MM), str(one.count), how)


def _true(name: str, error: TrueError, count: str) -> Row:
    return _row(name, error.value, error.range, count if error.value is not None else "", error.how)


def _held(row: ControllerRow | None) -> str:
    return "" if row is None or row.hold.settled is None else str(row.hold.settled.count)


def _found_range(contents: Contents) -> tuple[str, str]:
    """Return interval and count of the encoder error as found: of the same targets as `found` takes."""
    best, value = contents.comparison, found(contents).encoders
    open_loop = None if contents.diagnosis is None else contents.diagnosis.open_loop
    if open_loop is not None and value == 1e-3 * open_loop.error_mm.value:
        error = open_loop.error_mm
        return interval(error.low, error.high, 3), str(len(open_loop.targets))
    own = None if best is None or "default" not in best.controllers else best.row("default").hold.settled
    return ("", "") if own is None else (interval(own.mean.low, own.mean.high, 3, factor=MM), str(own.count))


def _found_count(contents: Contents) -> str:
    return _found_range(contents)[1]


def _pose_rows(whose: str, poses: PoseAccuracy | None) -> tuple[Row, Row]:
    names = (f"AP, position accuracy {whose}", f"RP, position repeatability {whose}")
    if poses is None:
        return _row(names[0], None, "", ""), _row(names[1], None, "", "")
    how = f"{poses.cycles} cycle{'s' * (poses.cycles != 1)}"
    return _spread(names[0], poses.accuracy, how), _spread(names[1], poses.repeatability, how)


def _direction_rows(contents: Contents) -> tuple[Row, Row]:
    name = "vAP, multi-directional variation of accuracy"
    names = (f"{name} by the encoders", f"{name} of the tool")
    found = None if contents.comparison is None else contents.comparison.directions
    if found is None:
        return _row(names[0], None, "", ""), _row(names[1], None, "", "")
    how = f"{found.cycles} cycle{'s' * (found.cycles != 1)}, 3 directions"
    return _spread(names[0], found.encoders, how), _spread(names[1], found.tool, how)


def _reversal(contents: Contents) -> Spread | None:
    if contents.calibration is None or contents.measurements is None:
        return None
    values = np.array(reversals(contents.arm, contents.measurements, contents.calibration.frame))
    return spread(values, np.arange(len(values))) if len(values) else None


def _left_out(contents: Contents) -> tuple[Row, ...]:
    """Compare the encoders and the calibration at measured points, each left out; intervals resample postures."""
    calibration, measured = contents.calibration, contents.measurements
    if calibration is None:
        return ()
    names = ("Tool from where the encoders see it", "Tool from where the calibration says")
    values = (calibration.before, calibration.after)
    if measured is None or len(measured) != len(calibration.left_out):
        count = str(calibration.points)
        return tuple(_row(name, one, "", count, "measured") for name, one in zip(names, values, strict=True))
    columns = calibration.left_out.T
    each = measured.posture.astype(np.intp)
    return tuple(_spread(name, spread(column, each), "measured") for name, column in zip(names, columns, strict=True))


def _joints(contents: Contents) -> Table:
    arm, calibration = contents.arm, contents.calibration
    rows = []
    for i, name in enumerate(arm.joint_names):
        play = None if calibration is None else float(np.degrees(calibration.displacement.play[i]))
        limits = f"{np.degrees(arm.lower[i]):.0f} to {np.degrees(arm.upper[i]):.0f}"
        cells = (Cell(name), Cell(limits), Cell(number(float(np.degrees(arm.max_speed[i])), 3)))
        rows.append(Row(cells=(*cells, Cell(number(play, 2)))))
    step = number(float(np.degrees(arm.encoder_step)), 2, "deg")
    return Table(
        caption="Joints", headers=("joint", "limits [deg]", "speed [deg/s]", "play [deg]"), rows=tuple(rows),
        notes=(f"Limits and speeds: from the description of the arm. Resolution of the encoders: {step}.",),
    )  # fmt: skip
