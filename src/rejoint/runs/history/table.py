"""All arms of a history at a glance, the worst first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from rejoint.logs.history.rows import HistoryRow
from rejoint.runs.history.owners import owners
from rejoint.system.shell import command

HEADERS = ("arm", "state", "error [mm]", "tolerance [mm]", "reached", "last check", "what to do")
REPAIR, REPAIRED = "repair", "repaired"
"""Kind of the row of a finished repair, and the state of an arm that was not checked since"""
_ORDER = ("alarm", "bad", "drifting", "worn", REPAIRED, "steady", "ok", "learning", "unknown", "")


@dataclass(frozen=True, kw_only=True)
class ArmHistory:
    """One arm with all its rows."""

    name: str
    rows: tuple[HistoryRow, ...]
    """of the arm as a whole, the oldest first"""
    joints: tuple[HistoryRow, ...]
    """of its joints"""

    @property
    def newest(self) -> HistoryRow:
        """The last check or repair, or the last run where there is neither."""
        told = [row for row in self.rows if row.kind in ("check", "repair")]
        return (told or list(self.rows))[-1]

    @property
    def error(self) -> float | None:
        """[mm] newest error of the tool that counts for its owner."""
        return self.newest.counts_mm

    @property
    def over(self) -> bool:
        """Whether the tolerance is reached."""
        return self.newest.over

    @property
    def state(self) -> str:
        """How it stands, in a word or two."""
        return "tolerance reached" if self.over else REPAIRED if self.newest.kind == REPAIR else self.newest.state


def arms_of(rows: Sequence[HistoryRow]) -> list[ArmHistory]:
    """Put rows, the oldest first, together by arm; what needs to be done first comes first."""
    found = []
    owner = owners(rows)
    whose = [(owner(row), row) for row in rows]
    for name in sorted({name for name, _ in whose}):
        mine = sorted((row for other, row in whose if other == name), key=lambda row: row.time)
        whole = tuple(row for row in mine if not row.joint)
        if whole:
            found.append(ArmHistory(name=name, rows=whole, joints=tuple(row for row in mine if row.joint)))
    return sorted(found, key=_urgency)


def cells(arm: ArmHistory) -> list[str]:
    """Return one row of the table `HEADERS`."""
    row = arm.newest
    by = "" if row.true_error_mm is not None or arm.error is None else " by encoders"
    return [
        arm.name, arm.state, "" if arm.error is None else f"{arm.error:.1f}{by}",
        "" if row.tolerance_mm is None else f"{row.tolerance_mm:.1f}",
        "now" if arm.over else _span(row.due_early, row.due_late), f"{row.time:%Y-%m-%d}", what_to_do(row),
    ]  # fmt: skip


def what_to_do(row: HistoryRow) -> str:
    """Return the last part of what the owner was told; after a repair, that a norm is to be made."""
    if row.kind == REPAIR:
        return f"{command('check', row.robot)} --repeat 5"
    return row.line.rpartition("Do: ")[2] if "Do: " in row.line else ""


def _span(early: datetime | None, late: datetime | None) -> str:
    if early is None:
        return ""
    return f"after {early:%Y-%m-%d}" if late is None else f"{early:%Y-%m-%d} to {late:%Y-%m-%d}"


def _urgency(arm: ArmHistory) -> tuple[bool, int, datetime, float]:
    row = arm.newest
    state = _ORDER.index(arm.state) if arm.state in _ORDER else len(_ORDER)
    return (not arm.over, state, row.due_early or datetime.max, -(arm.error or 0.0))
