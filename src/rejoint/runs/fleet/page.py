"""What became of all arms as one page: a row for each, the worst first."""

from __future__ import annotations

from pathlib import Path

from rejoint.pages.report.page import render
from rejoint.pages.report.view import Cell, Page, Part, Row, Section, Table
from rejoint.runs.fleet.result import HEADERS, FleetResult, FleetRow
from rejoint.system.files import write_whole

TITLES = {"check": "Arms checked", "repair": "Arms repaired"}
_NAMED = 5  # arms whose state stands in the first lines (chosen: they are read at a glance)


def write_page(path: Path, result: FleetResult) -> None:
    """Write the page; FileError if it cannot be written."""
    html = render(fleet_page(result))
    write_whole(path, lambda temporary: temporary.write_text(html, encoding="utf-8"))


def fleet_page(result: FleetResult) -> Page:
    """Build the page."""
    rows = result.rows
    urgent = [row for row in rows if row.code]
    done = sum(row.end == "done" for row in rows)
    first = f"{len(urgent)} of {len(rows)} arms need somebody." if urgent else f"Nothing to do on {len(rows)} arms."
    table = Table(
        caption="All arms, the worst first", headers=HEADERS, words=True,
        rows=tuple(_row(row) for row in rows),
    )  # fmt: skip
    steps = Table(
        caption="Steps of this call [s]", headers=("arm", "step", "took", "address"),
        rows=tuple(
            Row(cells=(Cell(row.name), Cell(name), Cell(f"{took:.1f}"), Cell(row.address)))
            for row in rows for name, took in row.steps
        ),
    )  # fmt: skip
    sections = (
        Section(key="arms", short="Arms", heading="Arms", parts=(Part(tables=(table,)),)),
        Section(
            key="steps", short="Steps", heading="What was done", parts=(Part(tables=(steps,)),) if steps.rows else (),
            missing="" if steps.rows else "Nothing was done in this call.",
        ),
    )  # fmt: skip
    ended = f"{result.ended:%Y-%m-%d %H:%M} UTC"
    return Page(
        title=TITLES[result.verb], subtitle=f"{done} of {len(rows)} arms done in {result.seconds:.0f} s, ended {ended}",
        verdict=(first, *(f"{row.name}: {row.state}. {row.found}" for row in urgent[:_NAMED])), sections=sections,
        footer="Made by rejoint fleet from the files of the runs and checks, which are not changed.",
    )  # fmt: skip


def _row(row: FleetRow) -> Row:
    """Return the row of an arm; what was found stands below its state."""
    named = zip(HEADERS, row.cells, strict=True)
    cells = tuple(Cell(text, row.found if header == "state" else "") for header, text in named)
    return Row(cells=cells, emphasis=bool(row.code))
