"""The scheduler: each arm's steps in order, within its hours and permissions."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Literal, Protocol, TypeAlias

from rejoint.runs.fleet.campaign import Campaign, Lost, Step, Work, WorkOutcome
from rejoint.runs.fleet.file import FleetArm
from rejoint.system.stopping import check, noted, pause, shielded

Kind: TypeAlias = Literal["begun", "done", "failed", "lost"]
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

    def wait(self, timeout: float) -> Sequence[tuple[Work, WorkOutcome | Lost]]:
        """Return ended tasks within ``timeout`` [s]."""

    def hold(self, work: Work) -> None:
        """Ask an arm to hold and its task to end."""


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Rules for all arms of one call."""

    somebody: bool = False
    """whether a person is present"""
    stay: bool = False
    """whether to wait for later hours"""
    at_once: int = 1_000_000
    """most real arms that move at once"""
    fresh: bool = False
    """whether to restart an interrupted call"""
    now: Callable[[], datetime] = datetime.now


@dataclass(frozen=True, kw_only=True)
class Event:
    """An event of an arm."""

    arm: FleetArm
    step: Step
    kind: Kind
    text: str = ""
    seconds: float = 0.0


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


class _Lead:
    def __init__(
        self,
        arms: Sequence[FleetArm],
        campaign: Campaign,
        executor: Executor,
        rules: Rules,
        tell: Callable[[Event], object],
    ) -> None:
        self.standings = [Standing(arm=arm) for arm in arms]
        self._campaign, self._executor, self._rules, self._tell = campaign, executor, rules, tell

    def lead(self) -> None:
        """Run until nothing is left for this call."""
        while True:
            check()
            waiting = self._begin()
            if any(one.running for one in self.standings):
                for one in self.standings:
                    if not one.arm.hours.is_open(self._rules.now()):
                        self._hold(one)
                self._wait()
            elif waiting and self._rules.stay:
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
            self._executor.hold(one.running)

    def _wait(self) -> None:
        for work, ended in self._executor.wait(LOOK):
            one = next(one for one in self.standings if one.running is work)
            one.running = one.left = None
            kind, took = self._end(one, work.step, ended)
            self._tell(Event(arm=one.arm, step=work.step, kind=kind, text=one.why, seconds=took))

    def _begin(self) -> bool:
        now, waiting = self._rules.now(), False
        idle = [one for one in self.standings if one.end is None and one.running is None]
        for one in sorted(idle, key=lambda one: one.arm.hours.closes(now) or datetime.max):  # else in their order
            if one.left is None:
                one.left = self._campaign.left(one.arm)
            if not one.left:
                one.end = "done"
                continue
            work = self._campaign.work(one.arm, one.left[0])
            if work.moves:
                refusal, opens = refused(work, self._rules), opening(one.arm, now)
                if refusal or opens != now:
                    one.why = refusal or _begins(opens)
                    later = not refusal and opens is not None and self._rules.stay
                    one.end, waiting = None if later else "left", waiting or later
                    continue
                if not self._has_room(work):
                    continue
            one.running, one.why = work, ""
            self._tell(Event(arm=one.arm, step=work.step, kind="begun"))
            self._executor.begin(work)
        return waiting

    def _has_room(self, work: Work) -> bool:
        moving = [one.running for one in self.standings if one.running is not None and one.running.moves]
        if work.arm.bench and any(other.arm.bench == work.arm.bench for other in moving):
            return False
        return not work.held or sum(other.held for other in moving) < self._rules.at_once

    def _end(self, one: Standing, step: Step, ended: WorkOutcome | Lost) -> tuple[Kind, float]:
        """Note how a step of an arm ended; returns the kind of the event, and [s]."""
        if isinstance(ended, Lost):
            one.lost += 1
            one.why = ended.why
            if self._campaign.work(one.arm, step).held:
                one.end = "failed"
                one.why = f"what held it was lost during {step} ({ended.why}): look at the arm, then go on"
            elif one.lost >= TRIES:
                one.end, one.why = "failed", f"{step} was lost {TRIES} times ({ended.why})"
            return "lost", 0.0
        if one.held and ended.problem:
            one.end, one.why = "left", f"held during {step}; {_begins(opening(one.arm, self._rules.now()))}"
        elif ended.problem:
            one.end, one.why, one.outcome = "failed", f"{step}: {ended.problem}", ended
        elif step in self._campaign.left(one.arm)[:1]:
            folder = self._campaign.work(one.arm, step).folder
            one.end = "failed"
            one.why = f"{step} ended, but left no file in {folder}: can all computers reach that folder?"
        else:
            one.steps.append((step, ended.seconds))
        return "done" if one.end is None else "failed", ended.seconds


def drive(
    arms: Sequence[FleetArm],
    campaign: Campaign,
    executor: Executor,
    rules: Rules,
    tell: Callable[[Event], object] = lambda _: None,
) -> list[Standing]:
    """Do all remaining steps of all arms; Ctrl-C and SIGTERM first bring moving arms to a hold.

    ``tell`` receives each event. The arm whose hours end first comes first. Returns the state of each arm, in the order
    of ``arms``.
    """
    lead = _Lead(arms, campaign, executor, rules, tell)
    with noted():
        try:
            lead.lead()
        except BaseException:
            with shielded():
                lead.hold_all()
            raise
    return lead.standings


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
