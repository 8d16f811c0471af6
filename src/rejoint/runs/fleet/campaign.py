"""Checks or repairs of many arms: the steps left for each, read from files, and the result, the worst first."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

from rejoint.logs.history import CHECKS, SUMMARY, HistoryRow, read_rows, utc_now
from rejoint.logs.runfolder import RunFolder, locked
from rejoint.pages.html import write_page
from rejoint.pages.words import number, plural
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.history import what_to_do
from rejoint.runs.repair import MOVING, RepairPlan, StageName, repair, stages_of
from rejoint.runs.run import newest_or_new
from rejoint.session.inputs import Settings, arm_of
from rejoint.system.errors import FileError, RejointError, first_line
from rejoint.system.extras import explain, require
from rejoint.system.files import read_json, saving, write_json, write_text
from rejoint.system.shell import command
from rejoint.system.stopping import Interrupted, check, noted, shielded

Step: TypeAlias = Literal["check"] | StageName


@dataclass(frozen=True, kw_only=True)
class FleetRules:
    """FleetRules for all arms of one call, and options of each repair as in `rejoint.repair`."""

    somebody: bool = False
    """whether a person is present"""
    at_once: int = 1_000_000
    """most real arms that move at once"""
    fresh: bool = False
    """whether to restart an interrupted call"""
    needed: bool = False
    """whether to check first, and repair only if needed"""
    plan: RepairPlan = field(default_factory=RepairPlan)
    seed: int | None = None
    quick: bool = False
    now: Callable[[], datetime] = datetime.now


@dataclass(frozen=True, kw_only=True)
class Work:
    """One step of one arm."""

    arm: FleetArm
    step: Step
    folder: Path
    """of all runs and checks, or the run"""
    options: Mapping[str, Any] = field(default_factory=dict)
    """of `repair`"""

    @property
    def moves(self) -> bool:
        """Whether the arm moves."""
        return self.step == "check" or self.step in MOVING

    @property
    def held(self) -> bool:
        """Whether it needs a connection: a real arm moves."""
        return self.moves and not self.arm.virtual


@dataclass(frozen=True, kw_only=True)
class WorkOutcome:
    """End of a task; its findings are in files."""

    seconds: float = 0.0
    problem: str = ""
    """error in one line, or empty"""
    code: int = 0
    """exit code of that error"""
    trace: str = ""
    """of an unexpected error"""
    lost: bool = False
    """whether its process died"""


def do_work(work: Work) -> WorkOutcome:
    """Do one task; errors are in the outcome."""
    begun, arm, problem, code, trace = time.monotonic(), work.arm, "", 0, ""
    try:
        if work.step == "check":
            from rejoint.runs.stages.check import check

            check(arm.address, history=work.folder, name=arm.name, arm=arm.description, tolerance_mm=arm.tolerance_mm)
        else:
            repair(arm.address, run=work.folder, arm=arm.description, only=work.step, **work.options)
    except Interrupted as error:
        problem, code = "held, as it was asked to stop", error.exit_code
    except RejointError as error:
        problem, code = "; ".join((str(error), *getattr(error, "__notes__", ()))), error.exit_code
    except Exception as error:  # noqa: BLE001 - a bug in one arm's work is no end of the others'
        problem, code = explain(error) or "", 2
        if not problem:
            problem, code = f"a bug: {type(error).__name__}: {first_line(error)}", 1
            trace = "".join(traceback.format_exception(error))
    return WorkOutcome(seconds=time.monotonic() - begun, problem=problem, code=code, trace=trace)


Verb: TypeAlias = Literal["check", "repair"]

STALE = {"check": timedelta(hours=12), "repair": timedelta(days=3)}
"""Age from which an interrupted call is not resumed; chosen"""


@dataclass(frozen=True, kw_only=True)
class CampaignInfo:
    """Description of a call."""

    begun: datetime
    """UTC, naive"""
    runs: dict[str, str]
    """run folder by arm name, for a repair"""
    finished: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Campaign:
    """Progress of checks or repairs of many arms."""

    fleet: Fleet
    verb: Verb
    rules: FleetRules
    info: CampaignInfo
    resumed: bool
    """whether an earlier call began it"""

    @classmethod
    def open(cls, fleet: Fleet, verb: Verb, rules: FleetRules, arms: Sequence[FleetArm]) -> Campaign:
        """Resume or begin a call for ``arms``, with its folder locked (`Fleet.home`)."""
        path, now, resumed = fleet.home / f"{verb}.json", utc_now(), False
        info = CampaignInfo(begun=now, runs={})
        if path.exists() and not rules.fresh:
            last = read_json(path, CampaignInfo)
            # What was begun in the future was so by a wrong clock: no check of now would count for it.
            resumed = not last.finished and timedelta(0) <= now - last.begun < STALE[verb]
            info = last if resumed else info
        runs = {arm.name: _run_of(fleet, arm, info.runs.get(arm.name)) if verb == "repair" else "" for arm in arms}
        info = replace(info, runs=info.runs | runs)
        write_json(path, info)
        return cls(fleet=fleet, verb=verb, rules=rules, info=info, resumed=resumed)

    def run(self, arm: FleetArm) -> Path:
        """Run folder of an arm under repair."""
        return self.fleet.folder / self.info.runs[arm.name]

    def left(self, arm: FleetArm) -> tuple[Step, ...]:
        """Name the remaining steps of an arm."""
        if self.verb == "check":
            return ("check",) if self.check_of(arm) is None else ()
        files, rules = RunFolder(self.run(arm)), self.rules
        if rules.needed and not files.info.exists():  # an interrupted repair is gone on with in any case
            seen = self.check_of(arm)
            if seen is None:
                return ("check",)
            if not needs_repair(seen):
                return ()
        if files.finished.exists():
            return ()
        built = arm_of(arm.address, arm.description)
        stages = stages_of(arm.address, built, files, rules.plan, quick=rules.quick)
        return tuple(name for name, file in stages.items() if name == "report" or not file.exists())

    def work(self, arm: FleetArm, step: Step) -> Work:
        """Task of a step."""
        if step == "check":
            return Work(arm=arm, step=step, folder=self.fleet.folder)
        rules = self.rules
        options = {"quick": rules.quick, "plan": rules.plan, "settings": Settings(seed=rules.seed)}
        return Work(arm=arm, step=step, folder=self.run(arm), options=options)

    @property
    def through(self) -> bool:
        """Whether nothing is left that the file allows."""
        asked = [arm for arm in self.fleet.arms if arm.name in self.info.runs]
        allowed = [arm for arm in asked if arm.may_move and (self.verb == "check" or arm.may_repair)]
        return not any(self.left(arm) for arm in allowed)

    def check_of(self, arm: FleetArm) -> HistoryRow | None:
        """Newest check of an arm in this campaign."""
        begun = self.info.begun
        for place in sorted((self.fleet.folder / CHECKS / arm.name).glob(f"*/{SUMMARY}"), reverse=True):
            if place.parent.name < f"{begun:%Y%m%dT%H%M%S}":  # named after its time; of years, few are read
                break
            row = _summary(place)
            if row is not None and row.time >= begun:
                return row
        return None


def _summary(path: Path) -> HistoryRow | None:
    """Row of a whole arm; None from a missing or damaged file."""
    with suppress(FileError, FileNotFoundError):
        return next((row for row in read_rows(path) if not row.joint), None)
    return None


def _run_of(fleet: Fleet, arm: FleetArm, before: str | None) -> str:
    if before is not None and RunFolder(fleet.folder / before).finished.exists():
        return before
    built = arm_of(arm.address, arm.description)
    place = newest_or_new(arm.address, built, 0, fleet.folder / "repairs" / arm.name)
    return str(place.relative_to(fleet.folder))


def needs_repair(row: HistoryRow) -> bool:
    """Whether a check asks for a repair."""
    return row.state == "alarm" or row.over


End: TypeAlias = Literal["done", "failed", "left"]

LOOK = 0.5
"""[s] between looks at clock and signals; chosen"""
HOLDING = 15.0
"""[s] to come to a hold at the end; chosen"""
DRIFTS, ALARM, PARTLY, ROBOT = 6, 7, 5, 4
"""Exit codes: watch it, repair it, partly done, robot failed"""

# Exit codes, the worst first: bugs and failures, then alarms, then what was left
_ORDER = (1, ROBOT, 3, 2, ALARM, DRIFTS, PARTLY, 0)


class Executor(Protocol):
    """Runs tasks in processes here or elsewhere."""

    def begin(self, work: Work) -> None:
        """Start a task and return at once."""

    def wait(self, timeout: float) -> Sequence[tuple[Work, WorkOutcome]]:
        """Return ended tasks within ``timeout`` [s]."""

    def hold(self, work: Work) -> None:
        """Ask an arm to hold and its task to end."""


@dataclass(kw_only=True, eq=False)
class ArmProgress:
    """Progress of one arm in this call."""

    arm: FleetArm
    left: tuple[Step, ...]
    """remaining steps"""
    steps: list[tuple[Step, float]] = field(default_factory=list)
    """done in this call, with [s]"""
    end: End | None = None
    why: str = ""
    """reason of a failure or refusal"""
    code: int = PARTLY
    """exit code, unless done"""
    trace: str = ""
    """of an unexpected error"""
    running: Work | None = None
    held: bool = False
    """whether a hold was asked for"""


class _Drive:
    """Does the remaining steps of arms, and holds moving arms on Ctrl-C and SIGTERM."""

    def __init__(
        self, campaign: Campaign, arms: Sequence[FleetArm], executor: Executor, tell: Callable[[str], object]
    ) -> None:
        self.campaign, self.executor, self.tell = campaign, executor, tell
        self.arms = [ArmProgress(arm=arm, left=campaign.left(arm)) for arm in arms]

    def run(self) -> None:
        """Run until nothing is left for this call."""
        with noted():
            try:
                while self._turn():
                    self._wait()
            except BaseException:
                with shielded():
                    self._hold_all()
                raise

    def _turn(self) -> bool:
        """Begin and hold what the time asks for; returns whether anything is running."""
        check()
        for one in self.arms:
            if one.end is None and one.running is None:
                self._begin(one)
        for one in self.arms:
            if not one.arm.hours.is_open(self.campaign.rules.now()):
                self._hold(one)
        return any(one.running for one in self.arms)

    def _hold_all(self) -> None:
        """Bring real arms to a hold."""
        for one in self.arms:
            self._hold(one)
        until = time.monotonic() + HOLDING
        while any(one.running and one.running.held for one in self.arms) and time.monotonic() < until:
            self._wait()

    def _hold(self, one: ArmProgress) -> None:
        if one.running is not None and one.running.held and not one.held:
            one.held = True
            self.executor.hold(one.running)

    def _begin(self, one: ArmProgress) -> None:
        """Begin the next step of an arm, if it may begin."""
        if not one.left:
            one.end = "done"
            return
        rules, work = self.campaign.rules, self.campaign.work(one.arm, one.left[0])
        if work.moves:
            why = refused(work, rules)
            if why:
                one.end, one.why = "left", why
                return
            moving = [other.running for other in self.arms if other.running is not None and other.running.moves]
            if work.arm.bench and any(other.arm.bench == work.arm.bench for other in moving):
                return
            if work.held and sum(other.held for other in moving) >= rules.at_once:
                return
        one.running = work
        self.tell(f"{one.arm.name}: {work.step} begun")
        self.executor.begin(work)

    def _wait(self) -> None:
        for work, outcome in self.executor.wait(LOOK):
            one = next(one for one in self.arms if one.running is work)
            one.running = None
            self._end(one, work, outcome)
            kind = "failed" if one.end else f"done in {outcome.seconds:.0f} s"
            self.tell(f"{one.arm.name}: {work.step} {kind}{one.why and f': {one.why}'}")

    def _end(self, one: ArmProgress, work: Work, outcome: WorkOutcome) -> None:
        """Note how a step of an arm ended."""
        step, problem = work.step, outcome.problem
        if one.held and problem and not outcome.lost:
            one.end, one.why = "left", f"held during {step}; {_begins(one.arm, self.campaign.rules)}"
            return
        one.left, one.code, one.trace = self.campaign.left(one.arm), ROBOT, outcome.trace
        if outcome.lost:
            one.why = f"what did {step} was lost ({problem})" + ": look at the arm, then go on" * work.held
        elif problem:
            one.why = f"{step}: {problem}"
            one.code = outcome.code if outcome.code in _ORDER else ROBOT  # held, since the call had ended
        elif step in one.left[:1]:
            one.why = f"{step} ended, but left no file in {work.folder}: can all computers reach that folder?"
        else:
            one.steps.append((step, outcome.seconds))
            one.code = PARTLY
            return
        one.end = "failed"


def refused(work: Work, rules: FleetRules) -> str:
    """Say why an arm may not move now, or return an empty text."""
    arm = work.arm
    if not arm.may_move:
        return "may_move is not true in the file"
    if work.step != "check" and not arm.may_repair:
        return "may_repair is not true in the file"
    if arm.needs_somebody and not rules.somebody:
        return "somebody has to be there: say --somebody-is-there when somebody is"
    now = rules.now()
    return "" if arm.hours.begins(now) == now else _begins(arm, rules)


def _begins(arm: FleetArm, rules: FleetRules) -> str:
    opens = arm.hours.begins(rules.now())
    return "its hours never come" if opens is None else f"its hours begin {opens:%a %Y-%m-%d %H:%M}"


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
    folder: Path
    code: int
    """its exit code"""

    @property
    def cells(self) -> list[str]:
        """Row of the table `HEADERS`."""
        seconds = sum(took for _, took in self.steps)
        done = ", ".join(name for name, _ in self.steps) + (f" ({seconds:.0f} s)" if self.steps else "")
        error = "" if self.error_mm is None else f"{self.error_mm:.1f}"
        return [self.name, self.state, error, done, self.todo]


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


def _row(campaign: Campaign, one: ArmProgress) -> FleetRow:
    arm, end, folder = one.arm, one.end or "left", campaign.fleet.folder
    repairs = campaign.verb == "repair"
    row = FleetRow(
        name=arm.name,
        address=arm.address,
        end=end,
        state=end,
        error_mm=None,
        found=one.why,
        todo="mend that, then give the same command again" if end == "failed" else "once that is so: the same command",
        steps=tuple(one.steps),
        folder=campaign.run(arm) if repairs else folder,
        code=one.code,
    )
    if end != "done":
        return row
    if repairs and RunFolder(row.folder).info.exists():  # else the check said that there is no need
        return _repaired(row, quick=campaign.rules.quick)
    check = campaign.check_of(arm)
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
    found = _summary(row.folder / SUMMARY)
    if found is None:
        told = f"{row.folder / SUMMARY}: missing or damaged"
        return replace(row, state="damaged", found=told, todo="repair it again", code=2)
    whose, before = "by the encoders", found.error_mm
    if found.settled_true_mm is not None:
        whose, before = "of the tool", found.true_error_mm
    return replace(
        row,
        state="quick try" if quick else "repaired",
        error_mm=found.counts_mm,
        found=f"error {whose}: as found {number(before, 3, 'mm')}, now {number(found.counts_mm, 2, 'mm')}",
        todo=f"use {found.controller}: {command('deploy', row.address, row.folder)}",
        code=0,
    )


MakeExecutor: TypeAlias = Callable[[Sequence[FleetArm]], AbstractContextManager[Executor]]


def run_fleet(
    fleet: Fleet,
    verb: Verb,
    executor: MakeExecutor,
    rules: FleetRules,
    *,
    only: tuple[str, ...] = (),
    tell: Callable[[str], object] = lambda _: None,
) -> FleetResult:
    """Check or repair the arms of a fleet (``only``: their names), and write the page.

    ``executor`` makes what does the work; ``tell`` receives a line for each event. FileError or UnsavedError if the
    folder is in use or not writable; InputError for an unknown arm or cluster.
    """
    require(f"rejoint fleet {verb}", "report")
    arms, begun, place = fleet.only(only), time.monotonic(), fleet.home
    with locked(RunFolder(place)):
        campaign = Campaign.open(fleet, verb, rules, arms)
        start, since = "Starting the", ""
        if campaign.resumed:
            start, since = "Going on with the", f", begun {campaign.info.begun:%Y-%m-%d %H:%M} UTC"
        tell(f"{start} {verb} of {plural(len(campaign.info.runs), 'arm')} in {fleet.folder}{since}")
        with executor(arms) as ready:
            call = _Drive(campaign, arms, ready, tell)
            call.run()
        rows = [_row(campaign, one) for one in call.arms]
        result = FleetResult(
            verb=verb,
            rows=tuple(sorted(rows, key=lambda row: (_ORDER.index(row.code), -(row.error_mm or 0.0), row.name))),
            ended=utc_now(),
            seconds=time.monotonic() - begun,
            page=place / f"{verb}.html",
            finished=campaign.through,
        )
        with saving(result):
            write_json(place / f"{verb}.json", replace(campaign.info, finished=result.finished))
            for one in call.arms:
                if one.trace:
                    write_text(place / f"bug-{one.arm.name}.txt", one.trace)
            write_page(result.page, "fleet.html", result=result, headers=HEADERS)
    return result
