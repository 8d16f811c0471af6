"""An outlook in one line that its owner understands: cause, millimetres, date, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta

from rejoint.diagnosis.monitoring.charts import FEWEST
from rejoint.diagnosis.monitoring.judge import Change, Outlook
from rejoint.system.shell import command

MONTH = timedelta(days=30)
"""Between two checks of an arm that does not change (chosen)"""
MEANINGS = {
    "hysteresis": "friction or weakness in slow motion",
    "reversal": "difference between its two directions",
    "sag": "giving way under its weight",
    "deviation": "distance from its commands",
    "error": "tool error",
}
"""What each quantity is, in words"""


def say(found: Outlook, robot: str, described: str = "") -> str:
    """Say in one line how an arm stands; ``robot`` is its address, ``described`` what a repair is told beside."""
    repair = command("repair", robot) + described
    error = _error(found)
    if found.moved:
        return _ask(found, error, repair)
    if found.state == "learning":
        missing = FEWEST + 1 - found.checks
        again = f"check again, {missing} more time{'s' * (missing > 1)}; the first ones may follow each other at once"
        return (
            f"Check {found.checks} since {_day(found.since)}: {FEWEST} are needed to know what is usual for this arm, "
            f"and one more to see a change. {error}. Do: {repair if found.over else again}."
        )
    worst = found.changes[0]
    if found.state == "steady":
        joints = len({one.joint for one in found.changes if one.joint})
        act = _act(found, worst, repair) if found.over else _next(found)
        return f"No change in {joints} joints since {_day(found.since)}. {error}. Do: {act}."
    called = [one for one in found.changes if one.state == found.state]
    others = sorted({one.joint or "the tool" for one in called} - {worst.joint or "the tool"})
    also = f"; also {', '.join(others)}" if others else ""
    return f"{_changed(worst)} ({found.state}){also}. {error}. Do: {_act(found, worst, repair)}."


def _ask(found: Outlook, error: str, repair: str) -> str:
    """Ask whether somebody moved the arm: what zeros do at once is no wear."""
    calls = [one for one in found.changes if one.state == "alarm" and one.quantity != "deviation" and one.joint]
    also = f" Beside that {', '.join(sorted({one.joint for one in calls}))} wears (alarm)." if calls else ""
    yes = "if so, check it again with --moved, five times"
    return (
        f"{cause_of(found)}, which is no wear: was the arm bumped, set anew or given another load?{also} {error}. Do: "
        f"{yes}; if not, look whether {found.moved[0].joint} has slipped, then {repair}."
    )


def cause_of(found: Outlook) -> str:
    """Name what changed most; empty where nothing did."""
    if found.moved:
        names, ways = [one.joint for one in found.moved], [f"{abs(one.degrees):.1f}" for one in found.moved]
        zeros = f"The zero of {names[0]} has" if len(names) == 1 else f"The zeros of {_list(names)} have"
        after, before = max(one.after for one in found.moved), max(one.before for one in found.moved)
        return f"{zeros} moved by {_list(ways)} deg between {_day(after)} and {_day(before)}"
    return _changed(found.changes[0]) if found.state in ("drifting", "alarm") else ""


def _list(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _changed(change: Change) -> str:
    since = "" if change.since is None else f" since {_day(change.since)}"
    return (
        f"{change.joint or 'Tool'}: {MEANINGS[change.quantity]} {change.usual_mm:.1f} -> {change.now_mm:.1f} mm{since}"
    )


def _error(found: Outlook) -> str:
    known = "" if found.error_known else " by the encoders"
    text = f"Tool error at the five poses {found.error_mm:.1f} mm{known}"
    if found.controlled_mm is not None:
        text = f"{text} without a controller, at most {found.controlled_mm:.1f} mm with that of its repair"
    if found.tolerance_mm is None:
        return text
    text = f"{text}, tolerance {found.tolerance_mm:.1f} mm"
    if found.over:
        return f"{text}, which is reached"
    if found.due is None:
        return text if found.state == "learning" or found.moved else f"{text}: no wear seen that leads there"
    due = found.due
    if due.late is None:
        return f"{text}, reached not before {_day(due.early)}"
    return f"{text}, reached between {_day(due.early)} and {_day(due.late)}"


def _next(found: Outlook) -> str:
    """Say when to check an arm again that has not changed; in time, where the tolerance may be reached before."""
    if found.due is not None and found.due.early - found.newest < MONTH:
        return f"nothing yet; check again by {_day(found.due.early)}, and make time for a repair"
    return "nothing; check again in a month"


def _act(found: Outlook, worst: Change, repair: str) -> str:
    if worst.better and worst.state in ("drifting", "alarm"):
        part = f"of {worst.joint}" if worst.joint else "of the arm"
        look = f"look what was done to the servo {part}, as it is better than it was; if it was changed or greased, or "
        return f"{look}the hand carries less, check with --moved, five times{f'; {repair}' if found.over else ''}"
    if found.over or found.state == "alarm":
        if worst.state not in ("drifting", "alarm"):  # it was so from the beginning
            return repair
        if worst.quantity == "deviation":
            look = f"look whether {worst.joint} has slipped or was set anew (then check with --moved)"
            return f"{look}; else {repair}"
        part = f"; if it stays, change the servo of {worst.joint}" if worst.joint else ""
        return f"{repair}{part}"
    return "check again within a week; no repair yet"


def _day(time: datetime) -> str:
    return f"{time:%Y-%m-%d}"
