"""What became of each arm of a fleet, the worst first: what was done, what was found, what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rejoint.logs.history.index import CHECKS
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.runs.fleet.campaign import Campaign, Verb, needs_repair
from rejoint.runs.fleet.drive import End, Standing
from rejoint.runs.history.table import what_to_do
from rejoint.runs.run import Run
from rejoint.system.errors import RejointError
from rejoint.system.shell import command

DRIFTS, ALARM, PARTLY, ROBOT = 6, 7, 5, 4
"""Exit codes, as the command line has them: watch it, repair it, not all was done, the robot failed"""

_ORDER = (1, ROBOT, 3, 2, ALARM, DRIFTS, PARTLY, 0)
"""Exit codes, the worst first: bugs and failures, then alarms, then what was left"""
HEADERS = ("arm", "state", "error [mm]", "done", "what to do")


@dataclass(frozen=True, kw_only=True)
class FleetRow:
    """One arm."""

    name: str
    address: str
    end: End
    """done: all that was asked for, also by an earlier call; failed; left: not now, or not allowed"""
    state: str
    """of a check: learning, steady, drifting, alarm, tolerance reached; of a repair: repaired; else how it ended"""
    error_mm: float | None
    """of the tool, newest: the true one where it is known"""
    found: str
    """what was found, or why it failed or was left"""
    todo: str
    """what the owner is to do"""
    steps: tuple[tuple[str, float], ...]
    """steps done in this call, and [s] that each took"""
    lost: int
    """pieces of work whose process was lost, and which were done again or not"""
    folder: Path
    """where its files are"""
    code: int
    """exit code that it alone would end with"""

    @property
    def cells(self) -> list[str]:
        """Its row of the table `HEADERS`."""
        seconds = sum(took for _, took in self.steps)
        done = ", ".join(name for name, _ in self.steps) + (f" ({seconds:.0f} s)" if self.steps else "")
        again = f"; {self.lost} lost" if self.lost else ""
        error = "" if self.error_mm is None else f"{self.error_mm:.1f}"
        return [self.name, self.state, error, f"{done}{again}", self.todo]


@dataclass(frozen=True, kw_only=True)
class FleetResult:
    """What became of all arms of one call."""

    verb: Verb
    rows: tuple[FleetRow, ...]
    """the worst first"""
    ended: datetime
    """UTC, without a zone"""
    seconds: float
    """[s] that the call took"""
    page: Path
    finished: bool
    """whether nothing is left to do: the next call begins anew"""

    @property
    def code(self) -> int:
        """Exit code of the command: of the arm that is worst."""
        return min((row.code for row in self.rows), key=_ORDER.index, default=0)


def rows_of(campaign: Campaign, standings: Sequence[Standing]) -> tuple[FleetRow, ...]:
    """Say what became of each arm, by its files; the worst first."""
    row = _checked if campaign.verb == "check" else _repaired
    rows = [row(campaign, one) for one in standings]
    return tuple(sorted(rows, key=lambda row: (_ORDER.index(row.code), -(row.error_mm or 0.0), row.name)))


def _checked(campaign: Campaign, one: Standing) -> FleetRow:
    row = campaign.check_of(one.arm) if one.end == "done" else None
    if row is None:
        return _undone(one, campaign.fleet.folder)
    code = ALARM if needs_repair(row) else DRIFTS if row.state == "drifting" else 0
    return _row(
        one, state="tolerance reached" if row.over else row.state, error_mm=row.counts_mm,
        found=row.line.partition(" Do: ")[0], todo=what_to_do(row),
        folder=campaign.fleet.folder / CHECKS / one.arm.name, code=code,
    )  # fmt: skip


def _repaired(campaign: Campaign, one: Standing) -> FleetRow:
    from rejoint.pages.report.contents import read_contents
    from rejoint.pages.report.errors import before_after

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
        one, state="quick try" if campaign.options.quick else "repaired",
        error_mm=None if after is None else 1e3 * after, found="" if errors is None else errors.sentence,
        todo=f"use {advised}: {command('deploy', one.arm.address, folder)}", folder=folder, code=0,
    )  # fmt: skip


def _recommended(folder: Path) -> str:
    from rejoint.control.comparison.recommend import recommend

    comparison = Run.open(folder).comparison
    return "" if comparison is None else recommend(comparison).controller


def _undone(one: Standing, folder: Path) -> FleetRow:
    """Tell of an arm that is not through."""
    code = PARTLY if one.end != "failed" else ROBOT if one.outcome is None else one.outcome.code
    code = code if code in _ORDER else ROBOT  # held, since nobody led any more
    todo = "mend that, then give the same command again" if one.end == "failed" else "once that is so: the same command"
    return _row(
        one, state=one.end or "left", error_mm=None, found=one.why, todo=todo, folder=folder, code=code
    )  # fmt: skip


def _row(
    one: Standing, *, state: str, error_mm: float | None, found: str, todo: str, folder: Path, code: int
) -> FleetRow:  # fmt: skip
    return FleetRow(
        name=one.arm.name, address=one.arm.address, end=one.end or "left", state=state, error_mm=error_mm, found=found,
        todo=todo, steps=tuple(one.steps), lost=one.lost, folder=folder, code=code,
    )  # fmt: skip
