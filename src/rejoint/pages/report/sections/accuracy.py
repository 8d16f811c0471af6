"""The section of the calibration: where the tool was, what lies behind the encoders, and what to do about the rest."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array, tcp_position
from rejoint.arms.kinematics import GRAVITY
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.gate import DISTURBED, astray, disturbed
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.preload import RISE, WEDGE, preload
from rejoint.diagnosis.calibration.procedure import reversals
from rejoint.pages.report.displaced import arrow_scale, arrows
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.numerals import UNKNOWN, interval, number
from rejoint.pages.report.view import Cell, Part, Picture, Row, Section, Table
from rejoint.pages.report.words import day_and_time, listed, measured_with, plural
from rejoint.system.statistics import NORMAL95

KEY, SHORT, HEADING = "tool", "Where the tool is", "Where the tool is"
MM = 1e3


def accuracy_section(found: Calibration, measured: Measurements | None, gallery: Gallery) -> Section:
    """Build the section; without its measurements, from the calibration alone."""
    parts = [_summary(found, measured)]
    if measured is not None:
        own = len(measured) == len(found.left_out)  # else they were made for another calibration
        parts += [*_figure(found, measured, gallery), *((_points(found, measured),) if own else ())]
    parts.append(_joints(found))
    if measured is not None:
        parts += _floating(found, measured.position)
    return Section(key=KEY, short=SHORT, heading=HEADING, parts=tuple(parts))


def _summary(found: Calibration, measured: Measurements | None) -> Part:
    before, after = number(found.before * MM, 3, "mm"), number(found.after * MM, 3, "mm")
    verdict = (
        "The correction clearly helps and is used: targets are aimed at by it."
        if found.used
        else "The correction does not clearly help, so nothing is corrected."
    )
    if astray(found.arm, found.missed):
        verdict += " No arm is that far from a description of itself: units, columns or frame of the points are wrong."
    text = (
        f"At {plural(found.points, 'measurement')}, the tool was {before} from where the encoders saw it, and {after} "
        f"from where this calibration says it is, each point predicted without its own posture. {verdict}"
    )
    tilt = np.degrees(np.arccos(np.clip(found.displacement.gravity @ GRAVITY / (GRAVITY @ GRAVITY), -1.0, 1.0)))
    facts = [("measured with", measured_with(found.source)), ("on", day_and_time(found.date) or UNKNOWN)]
    if measured is not None:
        facts.append(("postures", str(len(np.unique(measured.posture)))))
        facts.append(("standard deviation of a coordinate", number(float(measured.sigma.mean()) * MM, 2, "mm")))
        facts.append(("reversal value at the tool (ISO 230-2)", reversal_words(found, measured)))
    facts += [
        ("frame of the points", found.frame_name), ("base stands askew by", number(float(tilt), 2, "degrees")),
        ("not explained, each coordinate", number(found.floor * MM, 2, "mm")),
    ]  # fmt: skip
    return Part(texts=(text,), lines=_suspects(found), facts=tuple(facts))


def reversal_words(found: Calibration, measured: Measurements) -> str:
    """Say how far apart the tool stands when a posture is come to from either side."""
    values = reversals(found.arm, measured, found.frame)
    if not values:
        return UNKNOWN
    mean, most = (number(value * MM, 2, "mm") for value in (float(np.mean(values)), max(values)))
    return f"mean {mean}, largest {most}, {plural(len(values), 'posture')}"


def _suspects(found: Calibration) -> tuple[str, ...]:
    cause = "did the arm still move" if found.source == "camera" else "read wrong, or touched hard"
    lines = (f"Measurement {row + 1} does not fit to the others: {cause}? Measure it again." for row in found.suspects)
    return (*lines, DISTURBED) if disturbed(found.suspects, found.points) else tuple(lines)


def _in_base(found: Calibration, measured: Measurements) -> Array:
    """Measured points (M, 3) [m] in the base frame; NaN where a coordinate was not measured."""
    return measured.point @ found.frame[:3, :3].T + found.frame[:3, 3]


def _figure(found: Calibration, measured: Measurements, gallery: Gallery) -> tuple[Part, ...]:
    seen, tool = tcp_position(found.arm, measured.position), _in_base(found, measured)
    whole = np.isfinite(tool).all(axis=1)
    if not whole.any():
        return ()
    wrong = np.isin(np.arange(len(measured)), found.suspects)
    seen, tool, wrong = seen[whole], tool[whole], wrong[whole]
    scale, off = arrow_scale(seen, tool), np.linalg.norm(tool - seen, axis=1) * MM
    left = f" {plural(int((~whole).sum()), 'point')} without all coordinates left out." if not whole.all() else ""
    picture: Picture = gallery.show(
        "tool-places", arrows(seen, tool, wrong),
        alt=f"Arrows at {len(seen)} points from where the encoders saw the tool to where it was, "
        f"{number(float(off.min()), 2)} to {number(float(off.max()), 2)} mm long.",
        caption="Where the encoders saw the tool (circles) and where it was measured (ends of the arrows), in the base "
        f"frame. Arrows are drawn {f'{scale} times as long as they are' if scale > 1 else 'to scale'}.{left}",
    )  # fmt: skip
    return (Part(heading="Where the tool was", figures=(picture,)),)


def _points(found: Calibration, measured: Measurements) -> Part:
    position = measured.position
    hidden, remains = found.interval(position), found.interval(position, found.tool(position))
    rows = tuple(
        Row(
            cells=(
                Cell(f"{i + 1}", f"posture {measured.posture[i] + 1}{', suspect' * (i in found.suspects)}"),
                *(
                    Cell(f"{value * MM:.1f}" if np.isfinite(value) else UNKNOWN)
                    for value in _in_base(found, measured)[i]
                ),
                Cell(number(before * MM, 2), interval(hidden[0][i], hidden[1][i], 2, factor=MM)),
                Cell(number(after * MM, 2), interval(remains[0][i], remains[1][i], 2, factor=MM)),
            )
        )
        for i, (before, after) in enumerate(found.left_out)
    )
    headers = ("measurement", "x [mm]", "y [mm]", "z [mm]", "off the encoders [mm]", "off the calibration [mm]")
    note = (
        "Off the calibration: from where calibrations on the other postures predict the point. Small print: 95 % "
        "intervals by the calibration."
    )
    table = Table(caption="Measured points in the base frame, each left out", headers=headers, rows=rows, notes=(note,))
    return Part(heading="Point by point", tables=(table,))


def _joints(found: Calibration) -> Part:
    """Show what lies behind each joint, with intervals from the covariance of the fit."""
    sigma, own = np.sqrt(np.diag(found.covariance)), found.displacement
    columns = (("offset", np.degrees(1.0)), ("compliance", np.degrees(1.0)), ("play", np.degrees(1.0)))
    rows = []
    for i, name in enumerate(found.arm.joint_names):
        cells = [Cell(name)]
        for kind, unit in columns:
            value, half = getattr(own, kind)[i] * unit, NORMAL95 * sigma[found.layout.at(kind)][i] * unit
            low = value - half if kind == "offset" else max(value - half, 0.0)
            cells.append(Cell(number(float(value), 2), interval(float(low), float(value + half), 2)))
        rows.append(Row(cells=tuple(cells)))
    headers = ("joint", "offset [deg]", "compliance [deg/(N m)]", "play [deg]")
    note = (
        "Small print: 95 % intervals. Offset and play of a joint that always carries weight cannot be told apart: "
        "together they say where the tool is."
    )
    table = Table(caption="Behind the encoder of each joint", headers=headers, rows=tuple(rows), notes=(note,))
    return Part(heading="What lies behind the encoders", tables=(table,))


def _floating(found: Calibration, position: Array) -> tuple[Part, ...]:
    """Say what would press joints that float to one side of their play, with the gain that the calibration expects."""
    what = preload(found, position)
    if not what.joints:
        return ()
    names = listed(what.joints, "and")
    chance = number(what.chance * MM, 2, "mm")
    lines = [
        f"{names} carry no weight and lie in their play where chance left them: {chance} at the tool, root mean square "
        "over the measured postures. No correction can know that part."
        if len(what.joints) > 1
        else f"{names} carries no weight and lies in its play where chance left it: {chance} at the tool, root mean "
        "square over the measured postures. No correction can know that part."
    ]
    wedge = f"a wedge of {np.degrees(WEDGE):g} degrees under the base, its {what.side} side raised"
    options = (
        (f"{wedge} by {RISE:.1f} mm on 10 cm", what.wedge, what.wedge_helps),
        (f"a weight of {1e3 * what.mass:.0f} g at the tool", what.weight, what.weight_helps),
    )
    for name, left, helps in options:
        left_mm = number(left * MM, 2, "mm")
        if helps:
            lines.append(f"With {name}, {left_mm} of it would be left. Calibrate again afterwards.")
        else:
            lines.append(f"{name[:1].upper()}{name[1:]} would hardly help: {left_mm} of it would be left.")
    return (Part(heading="Joints that float", lines=tuple(lines)),)
