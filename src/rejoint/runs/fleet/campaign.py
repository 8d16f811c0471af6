"""Checks or repairs of many arms: the steps left for each, read from files, and the result, the worst first."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

from rejoint.logs.history import CHECKS, SUMMARY, HistoryRow, utc_now
from rejoint.logs.runfolder import RunFolder, locked
from rejoint.pages.html import write_page
from rejoint.pages.words import plural
from rejoint.runs.failure import failure_of
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.history import ALARM, DRIFTS, code_of, state_of, summary_of, what_to_do
from rejoint.runs.repair import MOVING, RepairPlan, StageName, repair, stages_of
from rejoint.runs.run import Run, newest_or_new
from rejoint.system.files import read_json, saving, write_json
from rejoint.system.records import value_type
from rejoint.system.shell import command
from rejoint.system.stopping import Interrupted, check, noted, shielded

Step: TypeAlias = Literal["check"] | StageName


@value_type
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


class Work(NamedTuple):
    """One step of one arm."""

    arm: FleetArm
    step: Step
    folder: Path
    """of all runs and checks, or the run"""
    options: Mapping[str, Any]
    """of `repair`, or the check's `CheckNotes`"""
    new: Mapping[str, Any]
    """of a new run"""

    @property
    def moves(self) -> bool:
        """Whether the arm moves."""
        return self.step == "check" or self.step in MOVING

    @property
    def held(self) -> bool:
        """Whether it needs a connection: a real arm moves."""
        return self.moves and not self.arm.virtual


class WorkOutcome(NamedTuple):
    """End of a task; its findings are in files."""

    seconds: float = 0.0
    problem: str = ""
    """error in one line, or empty"""
    code: int = 0
    """exit code of that error"""


HELD = "held, as it was asked to stop"


def do_work(work: Work) -> WorkOutcome:
    """Do one task; errors are in the outcome."""
    begun, arm, outcome = time.monotonic(), work.arm, WorkOutcome()
    try:
        if work.step == "check":
            from rejoint.runs.stages.check import CheckNotes, check

            check(
                arm.address,
                history=work.folder,
                name=arm.name,
                arm=arm.description,
                tolerance_mm=arm.tolerance_mm,
                notes=CheckNotes(**work.options),
            )
        else:
            run = Run.plan(work.folder, arm.address, arm.built, **work.new)
            repair(arm.address, run=run, only=work.step, **work.options)
    except Interrupted:
        outcome = WorkOutcome(problem=HELD, code=ROBOT)
    except Exception as error:  # noqa: BLE001 - a bug in one arm's work is no end of the others'
        text, _, code = failure_of(error)
        outcome = WorkOutcome(problem="; ".join((text, *getattr(error, "__notes__", ()))), code=code)
    return outcome._replace(seconds=time.monotonic() - begun)


Verb: TypeAlias = Literal["check", "repair"]
End: TypeAlias = Literal["done", "failed", "left"]

STALE = {"check": timedelta(hours=12), "repair": timedelta(days=3)}
"""Age from which an interrupted call is not resumed; chosen"""
LOOK = 0.5
"""[s] between looks at clock and signals; chosen"""
HOLDING = 15.0
"""[s] to come to a hold at the end; chosen"""
PARTLY, ROBOT = 5, 4
"""Exit codes: partly done, robot failed"""

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

    def close(self) -> None:
        """Release all processes."""


@value_type
class CampaignInfo:
    """Description of a call."""

    begun: datetime
    """UTC, naive"""
    runs: dict[str, str]
    """run folder by arm name, for a repair"""
    quick: bool = False
    finished: bool = False


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
    running: Work | None = None
    held: bool = False
    """whether a hold was asked for"""


class Campaign:
    """Checks or repairs of many arms; holds moving arms on Ctrl-C and SIGTERM."""

    def __init__(self, fleet: Fleet, verb: Verb, rules: FleetRules, only: tuple[str, ...]) -> None:
        """Resume or begin a call for the arms ``only``, with its folder locked (`Fleet.home`)."""
        self.fleet, self.verb, self.rules, self.file = fleet, verb, rules, fleet.home / f"{verb}.json"
        arms, now, self.resumed = fleet.only(only), utc_now(), False
        self.info = CampaignInfo(begun=now, runs={}, quick=rules.quick)
        if self.file.exists() and not rules.fresh:
            last = read_json(self.file, CampaignInfo)
            # What was begun in the future was so by a wrong clock: no check of now would count for it.
            recent = timedelta(0) <= now - last.begun < STALE[verb]
            if recent and not last.finished and last.quick == rules.quick:
                self.info, self.resumed = last, True
        self.info.runs.update({arm.name: self._run_of(arm) if verb == "repair" else "" for arm in arms})
        write_json(self.file, self.info)
        self.arms = [ArmProgress(arm=arm, left=self.left(arm)) for arm in arms]

    def _run_of(self, arm: FleetArm) -> str:
        folder, before = self.fleet.folder, self.info.runs.get(arm.name)
        if before is not None and RunFolder(folder / before).finished.exists():
            return before
        return str(newest_or_new(arm.address, arm.built, folder / "repairs" / arm.name).relative_to(folder))

    def run_folder(self, arm: FleetArm) -> RunFolder:
        """Run folder of an arm under repair."""
        return RunFolder(self.fleet.folder / self.info.runs[arm.name])

    def left(self, arm: FleetArm) -> tuple[Step, ...]:
        """Name the remaining steps of an arm."""
        rules, seen = self.rules, self.check_of(arm)
        if self.verb == "check":
            return () if seen else ("check",)
        files = self.run_folder(arm)
        if rules.needed and not files.info.exists():  # an interrupted repair is gone on with in any case
            if seen is None:
                return ("check",)
            if code_of(seen) != ALARM:
                return ()
        if files.finished.exists():
            return ()
        stages = stages_of(arm.address, arm.built, files, rules.plan, quick=rules.quick)
        return tuple(name for name, file in stages.items() if name == "report" or not file.exists())

    def check_of(self, arm: FleetArm) -> HistoryRow | None:
        """Newest check of an arm in this campaign."""
        places = (self.fleet.folder / CHECKS / arm.name).glob(f"*/{SUMMARY}")
        rows = map(summary_of, sorted(places, reverse=True))  # their folders are named after their times
        return next((row for row in rows if row and row.time >= self.info.begun), None)

    def finish(self) -> bool:
        """Store whether nothing is left that the file allows, and return it."""
        finished = not any(
            self.left(arm)
            for arm in self.fleet.arms
            if arm.name in self.info.runs and arm.may_move and (self.verb == "check" or arm.may_repair)
        )
        write_json(self.file, replace(self.info, finished=finished))
        return finished

    def drive(self, executor: Executor, tell: Callable[[str], object]) -> None:
        """Work until nothing is left for this call."""
        self._executor, self._tell = executor, tell
        with noted():
            try:
                while self._turn():
                    self._wait()
            except BaseException:
                with shielded():
                    for one in self.arms:
                        self._hold(one)
                    until = time.monotonic() + HOLDING
                    while any(one.running and one.running.held for one in self.arms) and time.monotonic() < until:
                        self._wait()
                raise

    def _turn(self) -> bool:
        check()
        for one in self.arms:
            if one.end is None and one.running is None:
                self._begin(one)
        for one in self.arms:
            if not one.arm.opening.is_open(self.rules.now()):
                self._hold(one)
        return any(one.running for one in self.arms)

    def _hold(self, one: ArmProgress) -> None:
        if one.running is not None and one.running.held and not one.held:
            one.held = True
            self._executor.hold(one.running)

    def _begin(self, one: ArmProgress) -> None:
        if not one.left:
            one.end = "done"
            return
        arm, step, rules = one.arm, one.left[0], self.rules
        folder = self.fleet.folder if step == "check" else self.run_folder(arm).path
        options = {"quick": rules.quick, "plan": rules.plan}
        if step == "check":
            options = {"repair": command("fleet", "repair", self.fleet.path, "--only", arm.name)}
        new = {"seed": rules.seed, "name": arm.name, "fleet": str(self.fleet.path)}
        work = Work(arm=arm, step=step, folder=folder, options=options, new=new)
        if work.moves:
            one.why = self._refused(work)
            if one.why:
                one.end = "left"
                return
            moving = [other.running for other in self.arms if other.running is not None and other.running.moves]
            if arm.bench and any(other.arm.bench == arm.bench for other in moving):
                return
            if work.held and sum(other.held for other in moving) >= rules.at_once:
                return
        one.running = work
        self._tell(f"{arm.name}: {step} begun")
        self._executor.begin(work)

    def _wait(self) -> None:
        for work, outcome in self._executor.wait(LOOK):
            one = next(one for one in self.arms if one.running is work)
            one.running = None
            self._end(one, work, outcome)
            kind = "failed" if one.end else f"done in {outcome.seconds:.0f} s"
            self._tell(f"{one.arm.name}: {work.step} {kind}{one.why and f': {one.why}'}")

    def _end(self, one: ArmProgress, work: Work, outcome: WorkOutcome) -> None:
        step, problem = work.step, outcome.problem
        if one.held and problem == HELD:
            one.end, one.why = "left", f"held during {step}; {self._refused(work)}".rstrip("; ")
            return
        one.left = self.left(one.arm)
        if problem:
            one.why, one.code = f"{step}: {problem}", outcome.code
        elif step in one.left[:1]:
            one.why = f"{step} ended, but left no file in {work.folder}: can all computers reach that folder?"
            one.code = ROBOT
        else:
            one.steps.append((step, outcome.seconds))
            return
        one.end = "failed"

    def _refused(self, work: Work) -> str:
        arm, now = work.arm, self.rules.now()
        if not arm.may_move:
            return "may_move is not true in the file"
        if work.step != "check" and not arm.may_repair:
            return "may_repair is not true in the file"
        if arm.needs_somebody and not self.rules.somebody:
            return "somebody has to be there: say --somebody-is-there when somebody is"
        opens = arm.opening.begins(now)
        if opens is None:
            return "its hours never come"
        return "" if opens == now else f"its hours begin {opens:%a %Y-%m-%d %H:%M}"


HEADERS = ("arm", "state", "error [mm]", "done", "what to do")


@value_type
class FleetRow:
    """One arm."""

    name: str
    address: str
    end: End
    """done (perhaps earlier), failed or left"""
    state: str
    """learning, steady, drifting, alarm, tolerance reached, repaired, or how it ended"""
    error_mm: float | None
    """newest tool error, as in the history"""
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
        spent = f" ({sum(took for _, took in self.steps):.0f} s)" if self.steps else ""
        done = ", ".join(name for name, _ in self.steps) + spent
        return [self.name, self.state, "" if self.error_mm is None else f"{self.error_mm:.1f}", done, self.todo]


@value_type
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
        return self.rows[0].code


def _row(campaign: Campaign, one: ArmProgress) -> FleetRow:
    arm, end, files = one.arm, one.end or "left", campaign.run_folder(one.arm)
    row = FleetRow(
        name=arm.name,
        address=arm.address,
        end=end,
        state=end,
        error_mm=None,
        found=one.why,
        todo="mend that, then repeat the command" if end == "failed" else "when that is so, repeat the command",
        steps=tuple(one.steps),
        folder=files.path,
        code=one.code,
    )
    repaired = campaign.verb == "repair" and files.info.exists()  # else the check said that there is no need
    seen = summary_of(files.path / SUMMARY) if repaired else campaign.check_of(arm)
    if end == "done" and repaired and campaign.rules.quick:
        return replace(row, state="quick try", todo="repair it without --quick", code=0)
    if end != "done" or seen is None:
        return row
    return replace(
        row,
        state=state_of(seen),
        error_mm=seen.counts_mm,
        found=seen.line.partition(" Do: ")[0] + (f" Use {seen.controller}." if repaired else ""),
        todo=what_to_do(seen),
        folder=files.path if repaired else campaign.fleet.folder / CHECKS / arm.name,
        code=0 if repaired else code_of(seen),
    )


def run_fleet(
    fleet: Fleet,
    verb: Verb,
    executor: Callable[[Sequence[FleetArm]], Executor],
    rules: FleetRules,
    *,
    only: tuple[str, ...] = (),
    tell: Callable[[str], object] = lambda _: None,
) -> FleetResult:
    """Check or repair the arms of a fleet (``only``: their names), and write the page.

    ``executor`` makes what does the work of these arms; ``tell`` receives a line for each event. FileError or
    UnsavedError if the folder is in use or not writable; InputError for an unknown arm or cluster.
    """
    begun, place = time.monotonic(), fleet.home
    with locked(RunFolder(place)):
        campaign = Campaign(fleet, verb, rules, only)
        start, since = "Starting the", ""
        if campaign.resumed:
            start, since = "Going on with the", f", begun {campaign.info.begun:%Y-%m-%d %H:%M} UTC"
        tell(f"{start} {verb} of {plural(len(campaign.arms), 'arm')} in {fleet.folder}{since}")
        with closing(executor([one.arm for one in campaign.arms])) as ready:
            campaign.drive(ready, tell)
        rows = [_row(campaign, one) for one in campaign.arms]
        result = FleetResult(
            verb=verb,
            rows=tuple(sorted(rows, key=lambda row: (_ORDER.index(row.code), -(row.error_mm or 0.0), row.name))),
            ended=utc_now(),
            seconds=time.monotonic() - begun,
            page=place / f"{verb}.html",
            finished=campaign.finish(),
        )
        with saving(result):
            write_page(result.page, "fleet.html", result=result, headers=HEADERS)
    return result
