"""Result of each arm of a fleet, the worst first."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
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
from rejoint.system.errors import RejointError
from rejoint.system.extras import require
from rejoint.system.files import saving, write_text
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
    rows = [_row(campaign, one) for one in standings]
    return tuple(sorted(rows, key=lambda row: (_ORDER.index(row.code), -(row.error_mm or 0.0), row.name)))


def _row(campaign: Campaign, one: Standing) -> FleetRow:
    arm, end, folder = one.arm, one.end or "left", campaign.fleet.folder
    run = campaign.run(arm) if campaign.verb == "repair" else folder
    code = PARTLY if end != "failed" else ROBOT if one.outcome is None else one.outcome.code
    row = FleetRow(
        name=arm.name,
        address=arm.address,
        end=end,
        state=end,
        error_mm=None,
        found=one.why,
        todo="mend that, then give the same command again" if end == "failed" else "once that is so: the same command",
        steps=tuple(one.steps),
        lost=one.lost,
        folder=run,
        code=code if code in _ORDER else ROBOT,  # held, since the call had ended
    )
    if end == "done" and RunFolder(run).info.exists():  # else the check said that there is no need
        return _repaired(row, quick=campaign.options.quick)
    check = campaign.check_of(arm) if end == "done" else None
    if check is None:
        return row
    return replace(
        row,
        state="tolerance reached" if check.over else check.state,
        error_mm=check.counts_mm,
        found=check.line.partition(" Do: ")[0],
        todo=what_to_do(check),
        folder=folder / CHECKS / arm.name,
        code=ALARM if needs_repair(check) else DRIFTS if check.state == "drifting" else 0,
    )


def _repaired(row: FleetRow, *, quick: bool) -> FleetRow:
    from rejoint.control.comparison.recommend import recommend
    from rejoint.pages.report.contents import before_after, read_contents

    try:
        contents = read_contents(row.folder)
        advised = "" if contents.comparison is None else recommend(contents.comparison).controller
        errors = before_after(contents, advised)
    except RejointError as error:
        return replace(row, state="damaged", found=str(error), todo="repair it again", code=2)
    after = None if errors is None else errors.after.tool.value or errors.after.encoders
    return replace(
        row,
        state="quick try" if quick else "repaired",
        error_mm=None if after is None else 1e3 * after,
        found="" if errors is None else errors.sentence,
        todo=f"use {advised}: {command('deploy', row.address, row.folder)}",
        code=0,
    )


def write_page(path: Path, result: FleetResult) -> None:
    """Write the page; FileError if that fails."""
    html.write_page(path, "fleet.html", result=result, headers=HEADERS)


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
    arms, begun, place = fleet.only(only), time.monotonic(), state_folder(fleet)
    with locked(RunFolder(place)):
        campaign = Campaign.open(fleet, verb, options, only=only, fresh=rules.fresh)
        begins(campaign)
        with executor(arms) as ready:
            standings = drive(arms, campaign, ready, rules, tell)
        result = FleetResult(
            verb=verb,
            rows=rows_of(campaign, standings),
            ended=utc_now(),
            seconds=time.monotonic() - begun,
            page=place / f"{verb}.html",
            finished=campaign.through,
        )
        with saving(result):
            if result.finished:
                campaign.finish()
            for one in standings:
                if one.outcome is not None and one.outcome.trace:
                    write_text(place / f"bug-{one.arm.name}.txt", one.outcome.trace)
            write_page(result.page, result)
    return result
