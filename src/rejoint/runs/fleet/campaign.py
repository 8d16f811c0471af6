"""What is left to do of each arm, read from files: a second call goes on where the first one was killed."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Literal, TypeAlias

from rejoint.logs.history.index import CHECKS
from rejoint.logs.history.rows import SUMMARY, HistoryRow, read_rows, utc_now
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.runs.chain import stages_of
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.fleet.work import RepairOptions, Step, Work
from rejoint.runs.given import arm_of
from rejoint.runs.run import is_finished, is_of_another, newest_or_new_in
from rejoint.system.errors import FileError
from rejoint.system.files import read_json, write_json

Verb: TypeAlias = Literal["check", "repair"]

STALE = {"check": timedelta(hours=12), "repair": timedelta(days=3)}
"""After which what was interrupted is not gone on with: finished arms begin again as well (chosen: a check is of one
day, and a weekend may lie within a repair)"""


@dataclass(frozen=True, kw_only=True)
class CampaignInfo:
    """What one call, and those that go on with it, are about; written before anything is done."""

    begun: datetime
    """UTC, without a zone"""
    runs: dict[str, str]
    """by the name of each arm that was asked for: of a repair, its run folder, below the folder of the fleet"""
    finished: bool = False
    """whether nothing was left to do"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Campaign:
    """Checks or repairs of many arms, as far as they are."""

    fleet: Fleet
    verb: Verb
    options: RepairOptions
    info: CampaignInfo
    resumed: bool
    """whether an earlier call had begun it"""

    @classmethod
    def open(
        cls, fleet: Fleet, verb: Verb, options: RepairOptions | None = None, *, only: tuple[str, ...] = (),
        anew: bool = False,
    ) -> Campaign:  # fmt: skip
        """Go on with what an earlier call left, or begin; who calls has the folder to itself (`state_folder`)."""
        path, now, arms = state_file(fleet, verb), utc_now(), fleet.only(only)
        before = read_json(path, CampaignInfo) if path.exists() else None
        # What was begun in the future was so by a wrong clock: no check of now would count for it.
        if before is not None and (before.finished or anew or not timedelta(0) <= now - before.begun < STALE[verb]):
            before = None
        runs = {} if before is None else dict(before.runs)
        for arm in arms:
            runs[arm.name] = _run_of(fleet, arm, runs.get(arm.name)) if verb == "repair" else ""
        info = CampaignInfo(begun=now if before is None else before.begun, runs=runs)
        write_json(path, info)
        return cls(fleet=fleet, verb=verb, options=options or RepairOptions(), info=info, resumed=before is not None)

    def run(self, arm: FleetArm) -> Path:
        """Return the run folder of an arm that is repaired."""
        return self.fleet.folder / self.info.runs[arm.name]

    def left(self, arm: FleetArm) -> tuple[Step, ...]:
        """Name the steps of an arm that are not done, in their order, by its files."""
        if self.verb == "check":
            return ("check",) if self.check_of(arm) is None else ()
        files, options = RunFolder(self.run(arm)), self.options
        if options.needed and not files.info.exists():  # an interrupted repair is gone on with in any case
            seen = self.check_of(arm)
            if seen is None:
                return ("check",)
            if not needs_repair(seen):
                return ()
        if files.finished.exists():
            return ()
        built = arm_of(arm.address, arm.description)
        stages = stages_of(arm.address, built, files, controllers=options.controllers, quick=options.quick)
        return tuple(name for name, file in stages.items() if name == "report" or not file.exists())

    def work(self, arm: FleetArm, step: Step) -> Work:
        """Return a step as it is to be done."""
        folder = self.fleet.folder if step == "check" else self.run(arm)
        return Work(arm=arm, step=step, folder=folder, options=self.options)

    @property
    def through(self) -> bool:
        """Whether nothing is left to do that the file allows."""
        asked = [arm for arm in self.fleet.arms if arm.name in self.info.runs]
        allowed = [arm for arm in asked if arm.may_move and (self.verb == "check" or arm.may_repair)]
        return not any(self.left(arm) for arm in allowed)

    def finish(self) -> None:
        """Note that it is through: the next call begins anew."""
        done = CampaignInfo(begun=self.info.begun, runs=self.info.runs, finished=True)
        write_json(state_file(self.fleet, self.verb), done)

    def check_of(self, arm: FleetArm) -> HistoryRow | None:
        """Return the newest check of an arm since this was begun; None where there is none."""
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
    """Return the run folder of an arm that is repaired, below that of the fleet: of an earlier call if it has one.

    Where its address or its description has changed since, an interrupted run is none to go on with.
    """
    built = arm_of(arm.address, arm.description)
    if before is not None:
        files = RunFolder(fleet.folder / before)
        if not is_of_another(files, arm.address, built) or is_finished(files):
            return before
    place, _ = newest_or_new_in(fleet.folder / "repairs" / arm.name, arm.address, built)
    return str(place.relative_to(fleet.folder))


def needs_repair(row: HistoryRow) -> bool:
    """Tell whether a check says that its arm is to be repaired."""
    return row.state == "alarm" or row.over


def state_folder(fleet: Fleet) -> Path:
    """Return where a fleet keeps what its calls are about, and their pages."""
    return fleet.folder / "fleet"


def state_file(fleet: Fleet, verb: Verb) -> Path:
    """Return the file of `CampaignInfo`."""
    return state_folder(fleet) / f"{verb}.json"
