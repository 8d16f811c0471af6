"""From checks to rows and back: what a check leaves, and the earlier ones that it is judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby

from rejoint.diagnosis.monitoring.judge import Outlook, PastCheck
from rejoint.diagnosis.monitoring.measures import CheckMeasures, JointCheck
from rejoint.diagnosis.monitoring.words import cause_of
from rejoint.logs.history.rows import HistoryRow
from rejoint.runs.history.owners import owners

MOVED, SET_UP = "moved", "set up"
"""Why a new norm begins with a check: the arm was moved, or has another description"""

_MOST = 1e6
"""Bound of all that a check measures, in millimetres and degrees (chosen: a kilometre)"""
_TOOL = ("error_mm", "repeatability_mm", "approach_mm", "true_error_mm", "true_approach_mm", "temperature_c")


@dataclass(frozen=True, kw_only=True)
class Past:
    """What the history knows of an arm since its norm began."""

    visits: tuple[PastCheck, ...]
    """its checks, the oldest first"""
    setup: str
    """fingerprint of its description then; empty where it is not known"""
    left_mm: float | None
    """tool error that the controller of its last repair left; None where there was none"""


def rows_of(head: HistoryRow, measures: CheckMeasures) -> list[HistoryRow]:
    """Return the rows of a check, that of the arm first; ``head`` says what is the same in all of them."""
    tool = replace(head, **{name: getattr(measures, name) for name in _TOOL})
    return [tool, *(replace(head, **asdict(joint)) for joint in measures.joints)]


def with_outlook(rows: Sequence[HistoryRow], found: Outlook, line: str) -> list[HistoryRow]:
    """Add to the rows of a check how the arm stands by it, and each joint."""
    due = found.due
    joints = {name: _worst(found, name) for name in {row.joint for row in rows}}
    arm = replace(
        rows[0], state=found.state, cause=cause_of(found), line=line, tolerance_mm=found.tolerance_mm,
        controlled_mm=found.controlled_mm, due_early=None if due is None else due.early,
        due=None if due is None else due.middle, due_late=None if due is None else due.late,
    )  # fmt: skip
    return [arm, *(replace(row, state=joints[row.joint]) for row in rows[1:])]


def past_of(rows: Sequence[HistoryRow], arm: str, key: str) -> Past:
    """Return what the history knows of an arm since its norm began.

    A repair counts where it was this arm's (`owners`), or where no arm with a name was checked at its address, which
    gives the arm the name ``key``.
    """
    visits: list[PastCheck] = []
    setup, left = "", None
    owner = owners(rows)
    mine = [row for row in rows if row.arm == arm or (row.kind == "repair" and owner(row) in (arm, key))]
    mine.sort(key=lambda row: (row.time, row.kind))
    for (_, kind), group in groupby(mine, key=lambda row: (row.time, row.kind)):
        members = {row.joint: row for row in group}  # of a folder that was copied each stands there twice
        head = members.pop("", None)
        if kind == "repair":
            visits, left = [], None if head is None else head.left_mm
            setup = setup if head is None else head.setup
        elif kind == "check":
            measures = None if head is None else _measures(head, tuple(members.values()))
            if head is None or measures is None:
                continue
            visits, setup = [] if head.norm else visits, head.setup
            left = None if head.norm == SET_UP else left
            visits.append(PastCheck(time=head.time, measures=measures, used_h=head.used_h))
    return Past(visits=tuple(visits), setup=setup, left_mm=left)


def _worst(found: Outlook, joint: str) -> str:
    states = [one.state for one in found.changes if one.joint == joint]
    return next((state for state in ("alarm", "drifting", "learning", "steady") if state in states), "")


def _measures(head: HistoryRow, joints: Sequence[HistoryRow]) -> CheckMeasures | None:
    """Put a check together from its rows; None where something is missing in them, or no measurement.

    Another program may have written them, and one that is not a number would keep every later change from being seen.
    """
    if not all(map(_believable, (head, *joints))):
        return None
    needed = (head.error_mm, head.repeatability_mm, head.approach_mm)
    if None in needed or not joints:
        return None
    found = []
    for row in joints:
        values = {name: getattr(row, name) for name in JointCheck.__annotations__}
        if any(values[name] is None for name in ("hysteresis_mm", "reversal_mm", "deviation_mm", "lever_mm")):
            return None
        found.append(JointCheck(**values))
    return CheckMeasures(joints=tuple(found), **{name: getattr(head, name) for name in _TOOL})


def _believable(row: HistoryRow) -> bool:
    """Tell whether all that a row of a check measures is a number of a believable size, where it is there."""
    values = (getattr(row, name) for name in (*_TOOL, *JointCheck.__annotations__) if name != "joint")
    return all(value is None or abs(value) <= _MOST for value in values)
