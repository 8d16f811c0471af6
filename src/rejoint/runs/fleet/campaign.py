"""The steps left for each arm, read from files: a check or stages of a repair."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Literal, TypeAlias

from rejoint.logs.history import CHECKS, SUMMARY, HistoryRow, read_rows, utc_now
from rejoint.logs.runfolder import RunFolder
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.repair import MOVING, RepairPlan, StageName, repair, stages_of
from rejoint.runs.run import is_finished, is_of_another, newest_or_new_in
from rejoint.session.inputs import Settings, arm_of
from rejoint.system.errors import FileError, RejointError, first_line
from rejoint.system.extras import explain
from rejoint.system.files import read_json, write_json
from rejoint.system.stopping import Interrupted

Step: TypeAlias = Literal["check"] | StageName


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Rules for all arms of one call, and options of each repair as in `rejoint.repair`."""

    somebody: bool = False
    """whether a person is present"""
    stay: bool = False
    """whether to wait for later hours"""
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
    """whether its process or node died"""


def do_work(work: Work) -> WorkOutcome:
    """Do one task; errors are in the outcome."""
    begun, problem, code, trace = time.monotonic(), "", 0, ""
    try:
        _do(work)
    except Interrupted as error:
        problem, code = "held, as it was asked to stop", error.exit_code
    except RejointError as error:
        problem, code = "; ".join((str(error), *getattr(error, "__notes__", ()))), error.exit_code
    except Exception as error:  # noqa: BLE001 - a bug in one arm's work is no end of the others'
        problem, code = (explain(error) or "") if isinstance(error, ImportError) else "", 2
        if not problem:
            problem, code = f"a bug: {type(error).__name__}: {first_line(error)}", 1
            trace = "".join(traceback.format_exception(error))
    return WorkOutcome(seconds=time.monotonic() - begun, problem=problem, code=code, trace=trace)


def _do(work: Work) -> None:
    arm = work.arm
    if work.step == "check":
        from rejoint.runs.stages.check import check

        check(arm.address, history=work.folder, name=arm.name, arm=arm.description, tolerance_mm=arm.tolerance_mm)
    else:
        repair(arm.address, run=work.folder, arm=arm.description, only=work.step, **work.options)


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
    rules: Rules
    info: CampaignInfo
    resumed: bool
    """whether an earlier call began it"""

    @classmethod
    def open(cls, fleet: Fleet, verb: Verb, rules: Rules, only: tuple[str, ...] = ()) -> Campaign:
        """Resume or begin a call, with its folder locked (`state_folder`)."""
        path, now, arms = state_file(fleet, verb), utc_now(), fleet.only(only)
        before = info = CampaignInfo(begun=now, runs={})
        if path.exists() and not rules.fresh:
            last = read_json(path, CampaignInfo)
            # What was begun in the future was so by a wrong clock: no check of now would count for it.
            info = last if not last.finished and timedelta(0) <= now - last.begun < STALE[verb] else info
        runs = {arm.name: _run_of(fleet, arm, info.runs.get(arm.name)) if verb == "repair" else "" for arm in arms}
        resumed, info = info is not before, replace(info, runs=info.runs | runs)
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
        stages = stages_of(arm.address, built, files, controllers=rules.plan.controllers, quick=rules.quick)
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

    def finish(self) -> None:
        """Mark the campaign as finished."""
        write_json(state_file(self.fleet, self.verb), replace(self.info, finished=True))

    def check_of(self, arm: FleetArm) -> HistoryRow | None:
        """Newest check of an arm in this campaign."""
        begun = self.info.begun
        for place in sorted((self.fleet.folder / CHECKS / arm.name).glob(f"*/{SUMMARY}"), reverse=True):
            if place.parent.name < f"{begun:%Y%m%dT%H%M%S}":  # named after its time; of years, few are read
                break
            with suppress(FileError):  # a damaged one is made again
                row = next((row for row in read_rows(place) if not row.joint), None)
                if row is not None and row.time >= begun:
                    return row
        return None


def _run_of(fleet: Fleet, arm: FleetArm, before: str | None) -> str:
    built = arm_of(arm.address, arm.description)
    if before is not None:
        files = RunFolder(fleet.folder / before)
        if not is_of_another(files, arm.address, built) or is_finished(files):
            return before
    place, _ = newest_or_new_in(fleet.folder / "repairs" / arm.name, arm.address, built)
    return str(place.relative_to(fleet.folder))


def needs_repair(row: HistoryRow) -> bool:
    """Whether a check asks for a repair."""
    return row.state == "alarm" or row.over


def state_folder(fleet: Fleet) -> Path:
    """Folder of a fleet's campaigns and pages."""
    return fleet.folder / "fleet"


def state_file(fleet: Fleet, verb: Verb) -> Path:
    """File of `CampaignInfo`."""
    return state_folder(fleet) / f"{verb}.json"
