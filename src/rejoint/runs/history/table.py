"""All arms of a history at a glance, the worst first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from rejoint.logs.history.rows import HistoryRow

HEADERS = ("arm", "state", "error [mm]", "tolerance [mm]", "reached", "last check", "what to do")
_ORDER = ("alarm", "bad", "drifting", "worn", "steady", "ok", "learning", "unknown", "")


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
        """The last check, or the last run where there is no check."""
        checks = [row for row in self.rows if row.kind == "check"]
        return (checks or list(self.rows))[-1]

    @property
    def error(self) -> float | None:
        """[mm] newest error of the tool: the true one where it is known."""
        row = self.newest
        return row.error_mm if row.true_error_mm is None else row.true_error_mm

    @property
    def over(self) -> bool:
        """Whether the tolerance is reached."""
        limit = self.newest.tolerance_mm
        return limit is not None and self.error is not None and self.error >= limit


def arms_of(rows: Sequence[HistoryRow]) -> list[ArmHistory]:
    """Put rows, the oldest first, together by arm; what needs to be done first comes first."""
    found = []
    for name in sorted({row.arm for row in rows}):
        mine = [row for row in rows if row.arm == name]
        whole = tuple(row for row in mine if not row.joint)
        if whole:
            found.append(ArmHistory(name=name, rows=whole, joints=tuple(row for row in mine if row.joint)))
    return sorted(found, key=_urgency)


def cells(arm: ArmHistory) -> list[str]:
    """Return one row of the table `HEADERS`."""
    row = arm.newest
    by = "" if row.true_error_mm is not None or arm.error is None else " by encoders"
    return [
        arm.name, "tolerance reached" if arm.over else row.state,
        "" if arm.error is None else f"{arm.error:.1f}{by}",
        "" if row.tolerance_mm is None else f"{row.tolerance_mm:.1f}",
        "now" if arm.over else _span(row.due_early, row.due_late), f"{row.time:%Y-%m-%d}", what_to_do(row),
    ]  # fmt: skip


def what_to_do(row: HistoryRow) -> str:
    """Return the last part of what the owner was told."""
    return row.line.rpartition("Do: ")[2] if "Do: " in row.line else ""


def _span(early: datetime | None, late: datetime | None) -> str:
    if early is None:
        return ""
    return f"after {early:%Y-%m-%d}" if late is None else f"{early:%Y-%m-%d} to {late:%Y-%m-%d}"


def _urgency(arm: ArmHistory) -> tuple[bool, int, datetime, float]:
    row = arm.newest
    state = _ORDER.index(row.state) if row.state in _ORDER else len(_ORDER)
    return (not arm.over, state, row.due_early or datetime.max, -(arm.error or 0.0))
