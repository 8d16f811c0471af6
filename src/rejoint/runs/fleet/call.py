"""Result of each arm of a fleet, the worst first."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TypeAlias

from rejoint.logs.history.index import CHECKS
from rejoint.logs.history.rows import utc_now
from rejoint.logs.runfolder.folder import RunFolder, locked
from rejoint.pages import html
from rejoint.runs.fleet.campaign import Campaign, RepairOptions, Verb, needs_repair, state_folder
from rejoint.runs.fleet.drive import End, Event, Executor, Rules, Standing, drive
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.history import what_to_do
from rejoint.runs.run import Run
from rejoint.system.errors import RejointError
from rejoint.system.extras import require
from rejoint.system.files import saving, write_whole
from rejoint.system.shell import command

DRIFTS, ALARM, PARTLY, ROBOT = 6, 7, 5, 4
"""Exit codes: watch it, repair it, partly done, robot failed"""

# Exit codes, the worst first: bugs and failures, then alarms, then what was left
_ORDER = (1, ROBOT, 3, 2, ALARM, DRIFTS, PARTLY, 0)
HEADERS = ("arm", "state", "error [mm]", "done", "what to do")


@dataclass(frozen=True, kw_only=True)
class FleetRow:
    """One arm."""

    name: str
    address: str
    end: End
    """done (perhaps earlier), failed or left"""
    state: str
    """learning, steady, drifting, alarm, tolerance reached, repaired, or how it ended"""
    error_mm: float | None
    """newest tool error, the true one if known"""
    found: str
    """finding, or reason why not"""
    todo: str
    """advice to the user"""
    steps: tuple[tuple[str, float], ...]
    """steps of this call, with [s]"""
    lost: int
    """tasks whose process was lost"""
    folder: Path
    code: int
    """its exit code"""

    @property
    def cells(self) -> list[str]:
        """Row of the table `HEADERS`."""
        seconds = sum(took for _, took in self.steps)
        done = ", ".join(name for name, _ in self.steps) + (f" ({seconds:.0f} s)" if self.steps else "")
        again = f"; {self.lost} lost" if self.lost else ""
        error = "" if self.error_mm is None else f"{self.error_mm:.1f}"
        return [self.name, self.state, error, f"{done}{again}", self.todo]


@dataclass(frozen=True, kw_only=True)
class FleetResult:
    """Result of one call."""

    verb: Verb
    rows: tuple[FleetRow, ...]
    """the worst first"""
    ended: datetime
    """UTC, naive"""
    seconds: float
    page: Path
    finished: bool
    """whether nothing is left to do"""

    @property
    def code(self) -> int:
        """Exit code of the worst arm."""
        return min((row.code for row in self.rows), key=_ORDER.index, default=0)


def rows_of(campaign: Campaign, standings: Sequence[Standing]) -> tuple[FleetRow, ...]:
    """Make the rows of all arms, the worst first."""
    row = _checked if campaign.verb == "check" else _repaired
    rows = [row(campaign, one) for one in standings]
    return tuple(sorted(rows, key=lambda row: (_ORDER.index(row.code), -(row.error_mm or 0.0), row.name)))


def _checked(campaign: Campaign, one: Standing) -> FleetRow:
    row = campaign.check_of(one.arm) if one.end == "done" else None
    if row is None:
        return _undone(one, campaign.fleet.folder)
    code = ALARM if needs_repair(row) else DRIFTS if row.state == "drifting" else 0
    return _row(
        one,
        state="tolerance reached" if row.over else row.state,
        error_mm=row.counts_mm,
        found=row.line.partition(" Do: ")[0],
        todo=what_to_do(row),
        folder=campaign.fleet.folder / CHECKS / one.arm.name,
        code=code,
    )


def _repaired(campaign: Campaign, one: Standing) -> FleetRow:
    from rejoint.pages.report.contents import before_after, read_contents

    folder = campaign.run(one.arm)
    if one.end != "done":
        return _undone(one, folder)
    if not RunFolder(folder).info.exists():  # the check said that there is no need
        return _checked(campaign, one)
    try:
        contents = read_contents(folder)
        advised = _recommended(folder)
        errors = before_after(contents, advised)
    except RejointError as error:
        return _row(
            one, state="damaged", error_mm=None, found=str(error), todo="repair it again", folder=folder, code=2
        )
    after = None if errors is None else errors.after.tool.value or errors.after.encoders
    return _row(
        one,
        state="quick try" if campaign.options.quick else "repaired",
        error_mm=None if after is None else 1e3 * after,
        found="" if errors is None else errors.sentence,
        todo=f"use {advised}: {command('deploy', one.arm.address, folder)}",
        folder=folder,
        code=0,
    )


def _recommended(folder: Path) -> str:
    from rejoint.control.comparison.recommend import recommend

    comparison = Run.open(folder).comparison
    return "" if comparison is None else recommend(comparison).controller


def _undone(one: Standing, folder: Path) -> FleetRow:
    code = PARTLY if one.end != "failed" else ROBOT if one.outcome is None else one.outcome.code
    code = code if code in _ORDER else ROBOT  # held, since the call had ended
    todo = "mend that, then give the same command again" if one.end == "failed" else "once that is so: the same command"
    return _row(one, state=one.end or "left", error_mm=None, found=one.why, todo=todo, folder=folder, code=code)


def _row(
    one: Standing, *, state: str, error_mm: float | None, found: str, todo: str, folder: Path, code: int
) -> FleetRow:
    return FleetRow(
        name=one.arm.name,
        address=one.arm.address,
        end=one.end or "left",
        state=state,
        error_mm=error_mm,
        found=found,
        todo=todo,
        steps=tuple(one.steps),
        lost=one.lost,
        folder=folder,
        code=code,
    )


TITLES = {"check": "Arms checked", "repair": "Arms repaired"}
_NAMED = 5  # arms whose state stands in the first lines (chosen: they are read at a glance)


def write_page(path: Path, result: FleetResult) -> None:
    """Write the page; FileError if that fails."""
    rows, count = result.rows, len(result.rows)
    urgent, done = [row for row in rows if row.code], sum(row.end == "done" for row in rows)
    first = f"{len(urgent)} of {count} arms need somebody." if urgent else f"Nothing to do on {count} arms."
    html.write_page(
        path,
        "fleet.html",
        title=TITLES[result.verb],
        rows=rows,
        headers=HEADERS,
        subtitle=f"{done} of {count} arms done in {result.seconds:.0f} s, ended {result.ended:%Y-%m-%d %H:%M} UTC",
        verdict=(first, *(f"{row.name}: {row.state}. {row.found}" for row in urgent[:_NAMED])),
        parts=(("arms", "Arms"), ("steps", "Steps")),
        footer="Made by rejoint fleet from the files of the runs and checks, which are not changed.",
    )


MakeExecutor: TypeAlias = Callable[[Sequence[FleetArm]], AbstractContextManager[Executor]]


def run_fleet(
    fleet: Fleet,
    verb: Verb,
    executor: MakeExecutor,
    rules: Rules,
    *,
    only: tuple[str, ...] = (),
    options: RepairOptions | None = None,
    tell: Callable[[Event], object] = lambda _: None,
    begins: Callable[[Campaign], object] = lambda _: None,
) -> FleetResult:
    """Check or repair the arms of a fleet (``only``: their names), and write the page.

    ``executor`` makes what does the work, ``tell`` receives each event, ``begins`` the campaign at its start. FileError
    or UnsavedError if another call uses the fleet's folder or writing fails, with the result, if any. InputError for an
    unknown arm or cluster, MissingExtraError without the extra ``report``, for a repair without ``train``.
    """
    require(f"rejoint fleet {verb}", "report")
    arms, begun = fleet.only(only), time.monotonic()
    with locked(RunFolder(state_folder(fleet))):
        campaign = Campaign.open(fleet, verb, options, only=only, fresh=rules.fresh)
        begins(campaign)
        with executor(arms) as ready:
            standings = drive(arms, campaign.left, campaign.work, ready, rules, tell)
        result = FleetResult(
            verb=verb,
            rows=rows_of(campaign, standings),
            ended=utc_now(),
            seconds=time.monotonic() - begun,
            page=state_folder(fleet) / f"{verb}.html",
            finished=campaign.through,
        )
        with saving(result):
            _save(campaign, result, standings)
    return result


def _save(campaign: Campaign, result: FleetResult, standings: Sequence[Standing]) -> None:
    if result.finished:
        campaign.finish()
    for one in standings:
        if one.outcome is not None and one.outcome.trace:
            _keep_trace(result.page.parent / f"bug-{one.arm.name}.txt", one.outcome.trace)
    write_page(result.page, result)


def _keep_trace(path: Path, text: str) -> None:
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
