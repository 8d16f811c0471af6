"""The history of all arms as one page: a row for each, the worst first, and the tool's error of each over time."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from markupsafe import Markup, escape

from rejoint.logs.history.rows import HistoryRow
from rejoint.pages.report.page import render
from rejoint.pages.report.view import Cell, Page, Part, Picture, Row, Section, Table
from rejoint.runs.history.table import HEADERS, ArmHistory, cells
from rejoint.system.files import write_whole

_WIDE, _HIGH, _EDGE = 320.0, 110.0, 22.0  # [px] of a figure, and of its margin (chosen: three fit side by side)
_LABEL = 10.0  # [px] of small print in it
_DATES = ("reached", "last check")
_JOINTS = ("hysteresis_mm", "sag_mm", "deviation_mm")


def write_history(path: Path, arms: Sequence[ArmHistory]) -> None:
    """Write the page; FileError if it cannot be written."""
    html = render(history_page(arms))
    write_whole(path, lambda temporary: temporary.write_text(html, encoding="utf-8"))


def history_page(arms: Sequence[ArmHistory]) -> Page:
    """Build the page."""
    checks = sum(row.kind == "check" for arm in arms for row in arm.rows)
    runs = sum(len(arm.rows) for arm in arms) - checks
    urgent = [arm for arm in arms if arm.over or arm.state in ("alarm", "drifting", "bad")]
    first = f"{len(urgent)} of {len(arms)} arms need somebody." if urgent else f"Nothing to do on {len(arms)} arms."
    return Page(
        title="Arms over time", subtitle=f"{len(arms)} arms, {checks} checks, {runs} runs",
        verdict=(first, *(f"{arm.name}: {arm.newest.line}" for arm in urgent[:5])),
        sections=(_overview(arms), _trends(arms), _joints(urgent)),
        footer="Made from the files summary.parquet below one folder, which are not changed.",
    )  # fmt: skip


def _overview(arms: Sequence[ArmHistory]) -> Section:
    rows = tuple(
        Row(
            cells=tuple(Cell(text, whole=header in _DATES) for header, text in zip(HEADERS, cells(arm), strict=True)),
            emphasis=arm.over or arm.state == "alarm",
        )
        for arm in arms
    )
    table = Table(caption="All arms, the worst first", headers=HEADERS, rows=rows, words=True)
    return Section(key="arms", short="Arms", heading="Arms", parts=(Part(tables=(table,)),))


def _trends(arms: Sequence[ArmHistory]) -> Section:
    figures = tuple(
        Picture(svg=trend_svg(arm), heading=arm.name)
        for arm in arms
        if len([row for row in arm.rows if _error(row) is not None]) > 1
    )
    texts = (
        "Tool error at the five poses of each check [mm]; dashed the tolerance, a vertical line a repair or another "
        "beginning. After a repair it is the error with the controller of that repair, at most. Where nobody knows "
        "where the tool really is, the error is that by the encoders.",
    )
    missing = "" if figures else "No arm has been checked twice yet."
    parts = (Part(texts=texts, figures=figures, columns=3),) if figures else ()
    return Section(key="trends", short="Trends", heading="Tool error over time", parts=parts, missing=missing)


def _joints(arms: Sequence[ArmHistory]) -> Section:
    """List the joints of the arms that need somebody: first and newest check since the last beginning."""
    rows = []
    for arm in arms:
        checks = [row.time for row in arm.rows if row.kind == "check"]
        begun = max((row.time for row in arm.rows if row.kind == "repair" or row.norm), default=datetime.min)
        mine = [time for time in checks if time >= begun]
        if len(mine) < 2:
            continue
        first, last = ({row.joint: row for row in arm.joints if row.time == time} for time in (mine[0], mine[-1]))
        for joint, row in last.items():
            if joint in first:
                values = tuple(Cell(_pair(first[joint], row, name)) for name in _JOINTS)
                rows.append(Row(cells=(Cell(arm.name), Cell(joint), Cell(row.state), *values)))
    table = Table(
        caption="First and newest check since the last repair [mm at the tool]",
        headers=("arm", "joint", "state", "hysteresis", "sag", "deviation"), rows=tuple(rows),
    )  # fmt: skip
    parts = (Part(tables=(table,)),) if rows else ()
    missing = "" if rows else "No arm that needs somebody has two checks since its last repair."
    return Section(
        key="joints", short="Joints", heading="Joints of arms that need somebody", parts=parts, missing=missing
    )


def trend_svg(arm: ArmHistory) -> Markup:
    """Draw the tool's error of an arm over time: a picture of some hundred bytes, a hundred of which open at once."""
    rows = [row for row in arm.rows if _error(row) is not None]
    values = [_error(row) or 0.0 for row in rows]
    limit = arm.newest.tolerance_mm
    top = 1.1 * max([*values, limit or 0.0, 1e-3])
    begin, end = rows[0].time, rows[-1].time
    span = max((end - begin).total_seconds(), 1.0)

    def x(time: datetime) -> float:
        return _EDGE + (_WIDE - 2 * _EDGE) * (time - begin).total_seconds() / span

    def y(value: float) -> float:
        return _HIGH - _EDGE + (2 * _EDGE - _HIGH) * value / top

    points = " ".join(f"{x(row.time):.1f},{y(value):.1f}" for row, value in zip(rows, values, strict=True))
    floor = _HIGH - _EDGE
    parts = [
        f'<path d="M{_EDGE} {_EDGE / 2}V{floor}H{_WIDE - _EDGE}" fill="none" stroke="currentColor" opacity=".4"/>',
        f'<polyline points="{points}" fill="none" stroke="var(--look-5)" stroke-width="2"/>',
    ]
    parts += [
        f'<path d="M{x(row.time):.1f} {_EDGE / 2}V{floor}" stroke="currentColor" opacity=".5"/>'
        for row in rows
        if row.kind == "repair" or row.norm
    ]
    if limit is not None:
        parts.append(
            f'<path d="M{_EDGE} {y(limit):.1f}H{_WIDE - _EDGE}" stroke="var(--look-2)" stroke-dasharray="5 4"/>'
        )
    now = y(values[-1])
    above = limit is None or not 0.0 < now - y(limit) < _LABEL + 8.0
    beside = now - 5.0 if above else now + _LABEL + 4.0  # not in the line of the tolerance
    small = f'font-size="{_LABEL}" fill="currentColor"'
    parts += [
        f'<text x="{_EDGE}" y="{_HIGH - 8}" {small}>{begin:%Y-%m-%d}</text>',
        f'<text x="{_WIDE - _EDGE}" y="{_HIGH - 8}" {small} text-anchor="end">{end:%Y-%m-%d}</text>',
        f'<text x="{_WIDE - _EDGE}" y="{beside:.1f}" {small} text-anchor="end">{values[-1]:.1f}</text>',
    ]
    told = escape(f"Tool error of {arm.name} over time, {values[0]:.1f} mm at first, {values[-1]:.1f} mm now")
    head = f'<svg class="figure" role="img" aria-label="{told}" viewBox="0 0 {_WIDE:g} {_HIGH:g}">'
    return Markup(head + "".join(parts) + "</svg>")  # noqa: S704 - numbers and dates, and an escaped name


def _error(row: HistoryRow) -> float | None:
    """Error of a check; those of runs are of other motion, and do not go into one line with them."""
    if row.kind != "check":
        return None
    return row.counts_mm


def _pair(first: HistoryRow, last: HistoryRow, name: str) -> str:
    one, other = getattr(first, name), getattr(last, name)
    return "-" if one is None or other is None else f"{one:.2f} -> {other:.2f}"
