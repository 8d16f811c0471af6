"""Whose a run is: it knows an address, while its owner may have given the arm there a name.

Arms are plugged into one port one after the other, and addresses are given to other arms. So a run is of the arm that
was checked last at its address before it; where none was, of the one that was checked first after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rejoint.logs.history.identity import name_of
from rejoint.logs.history.rows import HistoryRow


def owners(rows: Sequence[HistoryRow]) -> Callable[[HistoryRow], str]:
    """Return what tells the name of the arm that a row is about, by all ``rows`` of a history."""
    checks: dict[str, list[HistoryRow]] = {}
    for row in sorted((row for row in rows if row.kind == "check" and not row.joint), key=lambda row: row.time):
        checks.setdefault(name_of(row.robot, row.model), []).append(row)

    def owner(row: HistoryRow) -> str:
        there = [] if row.kind == "check" else checks.get(name_of(row.robot, row.model), [])
        before = [one for one in there if one.time <= row.time]
        return (before[-1:] or there[:1] or [row])[0].arm

    return owner
