"""When an arm may move: hours of the week, and days on which it may not."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date, datetime, time, timedelta

DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
HORIZON = 400
"""[days] that are looked through for the next opening (chosen: longer than a year, in which every weekday comes)"""

_SPAN = re.compile(r"\s*(\w+)(?:\s*-\s*(\w+))?\s+(\d\d):(\d\d)\s*-\s*(\d\d):(\d\d)\s*")
_DATES = re.compile(r"\s*(\d{4}-\d\d-\d\d)(?:\s+to\s+(\d{4}-\d\d-\d\d))?\s*")
_DAY = timedelta(days=1)
_FULL = 24 * 60  # minutes of a day


@dataclass(frozen=True, kw_only=True)
class Hours:
    """Hours at which an arm may move, by the clock of the computer that leads."""

    spans: tuple[tuple[int, int, int], ...] = ()
    """weekday from Monday 0, first minute of the day, and the minute at which it ends: above 1440 on the day after;
    none where any time will do"""
    closed: tuple[tuple[date, date], ...] = ()
    """first and last day on which it may not move"""

    def is_open(self, now: datetime) -> bool:
        """Tell whether the arm may move at ``now``."""
        if any(first <= now.date() <= last for first, last in self.closed):
            return False
        minute = 60 * now.hour + now.minute
        today, before = now.weekday(), (now.weekday() - 1) % 7
        return not self.spans or any(
            (day == today and first <= minute < last) or (day == before and minute < last - _FULL)
            for day, first, last in self.spans
        )

    def opens(self, now: datetime) -> datetime | None:
        """Return ``now`` where the arm may move, else when it next may; None where that is not within `HORIZON`."""
        if self.is_open(now):
            return now
        return next((one for one in self._changes(now) if self.is_open(one)), None)

    def closes(self, now: datetime) -> datetime | None:
        """Return when an arm that may move at ``now`` next may not; None where that is not within `HORIZON`."""
        return next((one for one in self._changes(now) if not self.is_open(one)), None)

    def _changes(self, now: datetime) -> Iterator[datetime]:
        """Go through the times after ``now`` at which something may begin or end."""
        minutes = {0, *(edge % _FULL for _, first, last in self.spans for edge in (first, last))}
        for day in range(HORIZON):
            midnight = datetime.combine(now.date() + day * _DAY, time())
            for minute in sorted(minutes):
                if (one := midnight + timedelta(minutes=minute)) > now:
                    yield one


def read_hours(spans: Sequence[str], closed: Sequence[str] = ()) -> Hours:
    """Read ``Mon-Fri 08:00-18:00`` and ``2026-12-24 to 2027-01-06``; ValueError says which text is none such."""
    return Hours(
        spans=tuple(one for text in spans for one in _span(text)), closed=tuple(_dates(text) for text in closed)
    )


def _span(text: str) -> list[tuple[int, int, int]]:
    """Read the hours of one day, or of each of several: ``Fri 22:00-06:00`` ends on Saturday."""
    found = _SPAN.fullmatch(text)
    names = [] if found is None else [found[1], found[2] or found[1]]
    if found is None or not all(name.title() in DAYS for name in names):
        raise ValueError(f"expected hours such as Mon-Fri 08:00-18:00 (days {', '.join(DAYS)}), found {text[:40]!r}")
    first, last = (60 * int(found[i]) + int(found[i + 1]) for i in (3, 5))
    if first >= _FULL or last > _FULL or int(found[4]) > 59 or int(found[6]) > 59 or first == last:
        raise ValueError(f"expected two different times from 00:00 to 24:00, found {text[:40]!r}")
    day, end = (DAYS.index(name.title()) for name in names)
    count = (end - day) % 7 + 1
    return [((day + i) % 7, first, last if last > first else last + _FULL) for i in range(count)]


def _dates(text: str) -> tuple[date, date]:
    """Read a day, or the first and the last of several."""
    found = _DATES.fullmatch(text)
    try:
        first, last = (date.fromisoformat(one) for one in (found[1], found[2] or found[1])) if found else (None, None)
    except ValueError:
        first = last = None
    if first is None or last is None or first > last:
        raise ValueError(f"expected a day such as 2026-12-24, or 2026-12-24 to 2027-01-06, found {text[:40]!r}")
    return first, last
