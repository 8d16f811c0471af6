"""Result of each arm of a fleet, the worst first."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

from rejoint.logs.history import CHECKS, utc_now
from rejoint.logs.runfolder import RunFolder, locked
from rejoint.pages import html
from rejoint.runs.fleet.campaign import Campaign, Rules, Step, Verb, Work, WorkOutcome, needs_repair, state_folder
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.history import what_to_do
from rejoint.system.errors import RejointError
from rejoint.system.extras import require
from rejoint.system.files import saving, write_text
from rejoint.system.shell import command
from rejoint.system.stopping import check, noted, pause, shielded

End: TypeAlias = Literal["done", "failed", "left"]

LOOK = 0.5
"""[s] between looks at clock and signals; chosen"""
TRIES = 4
"""for one arm's lost tasks; chosen"""
ROOM = timedelta(minutes=5)
"""Least time for a motion before hours end; chosen: a diagnosis takes four minutes"""
HOLDING = 15.0
"""[s] to come to a hold at the end; chosen"""
IDLE = 30.0
"""[s] between looks at hours when idle; chosen"""


class Executor(Protocol):
    """Runs tasks in processes here or elsewhere."""

    def begin(self, work: Work) -> None:
        """Start a task and return at once."""

    def wait(self, timeout: float) -> Sequence[tuple[Work, WorkOutcome]]:
        """Return ended tasks within ``timeout`` [s]."""

    def hold(self, work: Work) -> None:
        """Ask an arm to hold and its task to end."""


@dataclass(kw_only=True, eq=False)
class Standing:
    """State of one arm in this call."""

    arm: FleetArm
    steps: list[tuple[Step, float]] = field(default_factory=list)
    """done in this call, with [s]"""
    end: End | None = None
    why: str = ""
    """reason of a failure or refusal"""
    outcome: WorkOutcome | None = None
    """of a failure"""
    lost: int = 0
    """tasks whose process was lost"""
    left: tuple[Step, ...] | None = None
    """remaining steps; None: unknown"""
    running: Work | None = None
    held: bool = False
    """whether a hold was asked for"""


@dataclass(kw_only=True, eq=False)
class _Lead:
    campaign: Campaign
    executor: Executor
    tell: Callable[[str], object]
    standings: list[Standing]

    def lead(self) -> None:
        """Run until nothing is left for this call."""
        rules = self.campaign.rules
        while True:
            check()
            waiting = self._begin()
            if any(one.running for one in self.standings):
                for one in self.standings:
                    if not one.arm.hours.is_open(rules.now()):
                        self._hold(one)
                self._wait()
            elif waiting:
                pause(IDLE)
            else:
                return

    def hold_all(self) -> None:
        """Bring real arms to a hold."""
        for one in self.standings:
            self._hold(one, again=True)
        until = time.monotonic() + HOLDING
        while any(one.running and one.running.held for one in self.standings) and time.monotonic() < until:
            self._wait()

    def _hold(self, one: Standing, *, again: bool = False) -> None:
        if one.running is not None and one.running.held and (again or not one.held):
            one.held = True
            self.executor.hold(one.running)

    def _wait(self) -> None:
        for work, outcome in self.executor.wait(LOOK):
            one = next(one for one in self.standings if one.running is work)
            one.running = one.left = None
            self._end(one, work, outcome)
            kind = "lost" if outcome.lost else "failed" if one.end else f"done in {outcome.seconds:.0f} s"
            self.tell(f"{one.arm.name}: {work.step} {kind}{one.why and f': {one.why}'}")

    def _begin(self) -> bool:
        """Begin what may begin; returns whether an arm waits for its hours."""
        rules, waiting = self.campaign.rules, False
        now = rules.now()
        idle = [one for one in self.standings if one.end is None and one.running is None]
        for one in sorted(idle, key=lambda one: one.arm.hours.closes(now) or datetime.max):  # else in their order
            if one.left is None:
                one.left = self.campaign.left(one.arm)
            if not one.left:
                one.end = "done"
                continue
            work = self.campaign.work(one.arm, one.left[0])
            if work.moves:
                refusal, opens = refused(work, rules), opening(one.arm, now)
                if refusal or opens != now:
                    one.why = refusal or _begins(opens)
                    later = not refusal and opens is not None and rules.stay
                    one.end, waiting = None if later else "left", waiting or later
                    continue
                if not self._has_room(work):
                    continue
            one.running, one.why = work, ""
            self.tell(f"{one.arm.name}: {work.step} begun")
            self.executor.begin(work)
        return waiting

    def _has_room(self, work: Work) -> bool:
        moving = [one.running for one in self.standings if one.running is not None and one.running.moves]
        if work.arm.bench and any(other.arm.bench == work.arm.bench for other in moving):
            return False
        return not work.held or sum(other.held for other in moving) < self.campaign.rules.at_once

    def _end(self, one: Standing, work: Work, outcome: WorkOutcome) -> None:
        """Note how a step of an arm ended."""
        step, problem = work.step, outcome.problem
        if outcome.lost:
            one.lost, one.why = one.lost + 1, problem
            if work.held:
                one.end = "failed"
                one.why = f"what held it was lost during {step} ({problem}): look at the arm, then go on"
            elif one.lost >= TRIES:
                one.end, one.why = "failed", f"{step} was lost {TRIES} times ({problem})"
        elif one.held and problem:
            one.end = "left"
            one.why = f"held during {step}; {_begins(opening(one.arm, self.campaign.rules.now()))}"
        elif problem:
            one.end, one.why, one.outcome = "failed", f"{step}: {problem}", outcome
        elif step in self.campaign.left(one.arm)[:1]:
            one.end = "failed"
            one.why = f"{step} ended, but left no file in {work.folder}: can all computers reach that folder?"
        else:
            one.steps.append((step, outcome.seconds))


def drive(
    arms: Sequence[FleetArm], campaign: Campaign, executor: Executor, tell: Callable[[str], object]
) -> list[Standing]:
    """Do all remaining steps; Ctrl-C and SIGTERM first bring moving arms to a hold.

    Arms whose hours end first come first. Returns their states, in the order of ``arms``.
    """
    standings = [Standing(arm=arm) for arm in arms]
    lead = _Lead(campaign=campaign, executor=executor, tell=tell, standings=standings)
    with noted():
        try:
            lead.lead()
        except BaseException:
            with shielded():
                lead.hold_all()
            raise
    return standings


def refused(work: Work, rules: Rules) -> str:
    """Say why an arm may not move now, or return an empty text."""
    arm = work.arm
    if not arm.may_move:
        return "may_move is not true in the file"
    if work.step != "check" and not arm.may_repair:
        return "may_repair is not true in the file"
    if arm.needs_somebody and not rules.somebody:
        return "somebody has to be there: say --somebody-is-there when somebody is"
    return ""


def opening(arm: FleetArm, now: datetime) -> datetime | None:
    """Return ``now`` if an arm may begin to move, else its next opening."""
    opens = arm.hours.opens(now)
    closes = None if opens is None else arm.hours.closes(opens)
    if opens == now and closes is not None and closes - now < ROOM:
        return arm.hours.opens(closes)
    return opens


def _begins(opens: datetime | None) -> str:
    return "its hours never come" if opens is None else f"its hours begin {opens:%a %Y-%m-%d %H:%M}"


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
        return _repaired(row, quick=campaign.rules.quick)
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
    tell: Callable[[str], object] = lambda _: None,
) -> FleetResult:
    """Check or repair the arms of a fleet (``only``: their names), and write the page.

    ``executor`` makes what does the work; ``tell`` receives a line for each event. FileError or UnsavedError if the
    folder is in use or not writable; InputError for an unknown arm or cluster.
    """
    require(f"rejoint fleet {verb}", "report")
    arms, begun, place = fleet.only(only), time.monotonic(), state_folder(fleet)
    with locked(RunFolder(place)):
        campaign = Campaign.open(fleet, verb, rules, only)
        start, since = "Starting the", ""
        if campaign.resumed:
            start, since = "Going on with the", f", begun {campaign.info.begun:%Y-%m-%d %H:%M} UTC"
        tell(f"{start} {verb} of {len(campaign.info.runs)} arms in {fleet.folder}{since}")
        with executor(arms) as ready:
            standings = drive(arms, campaign, ready, tell)
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
