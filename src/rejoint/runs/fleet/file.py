"""The fleet file: arms, and when they may move."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime, time, timedelta
from pathlib import Path

from rejoint.arms import CATALOGUE
from rejoint.logs.history.rows import plain_name
from rejoint.robots import place_of
from rejoint.session.inputs import arm_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.tomltable import TomlTable, read_toml

DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
HORIZON = 400
"""[days] to search for the next opening; chosen"""

_SPAN = re.compile(r"\s*(\w+)(?:\s*-\s*(\w+))?\s+(\d\d):(\d\d)\s*-\s*(\d\d):(\d\d)\s*")
_DATES = re.compile(r"\s*(\d{4}-\d\d-\d\d)(?:\s+to\s+(\d{4}-\d\d-\d\d))?\s*")
_DAY = timedelta(days=1)
_FULL = 24 * 60  # minutes of a day


@dataclass(frozen=True, kw_only=True)
class Hours:
    """Hours at which an arm may move, by the local clock."""

    spans: tuple[tuple[int, int, int], ...] = ()
    """weekday from Monday 0, first and last minute of the day (above 1440: the next day); () always"""
    closed: tuple[tuple[date, date], ...] = ()
    """first and last day without motion"""

    def is_open(self, now: datetime) -> bool:
        """Whether the arm may move at ``now``."""
        if any(first <= now.date() <= last for first, last in self.closed):
            return False
        minute = 60 * now.hour + now.minute
        today, before = now.weekday(), (now.weekday() - 1) % 7
        return not self.spans or any(
            (day == today and first <= minute < last) or (day == before and minute < last - _FULL)
            for day, first, last in self.spans
        )

    def opens(self, now: datetime) -> datetime | None:
        """Return ``now`` if open, else the next opening; None beyond `HORIZON`."""
        if self.is_open(now):
            return now
        return next((one for one in self._changes(now) if self.is_open(one)), None)

    def closes(self, now: datetime) -> datetime | None:
        """End of the present opening; None beyond `HORIZON`."""
        return next((one for one in self._changes(now) if not self.is_open(one)), None)

    def _changes(self, now: datetime) -> Iterator[datetime]:
        minutes = {0, *(edge % _FULL for _, first, last in self.spans for edge in (first, last))}
        for day in range(HORIZON):
            midnight = datetime.combine(now.date() + day * _DAY, time())
            for minute in sorted(minutes):
                if (one := midnight + timedelta(minutes=minute)) > now:
                    yield one


def read_hours(spans: Sequence[str], closed: Sequence[str] = ()) -> Hours:
    """Read ``Mon-Fri 08:00-18:00`` and ``2026-12-24 to 2027-01-06``; ValueError names a wrong text."""
    return Hours(
        spans=tuple(one for text in spans for one in _span(text)), closed=tuple(_dates(text) for text in closed)
    )


def _span(text: str) -> list[tuple[int, int, int]]:
    """Read the hours of one or several days: ``Fri 22:00-06:00`` ends on Saturday."""
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
    found = _DATES.fullmatch(text)
    try:
        first, last = (date.fromisoformat(one) for one in (found[1], found[2] or found[1])) if found else (None, None)
    except ValueError:
        first = last = None
    if first is None or last is None or first > last:
        raise ValueError(f"expected a day such as 2026-12-24, or 2026-12-24 to 2027-01-06, found {text[:40]!r}")
    return first, last


FOLDER = "runs"
"""Default folder of runs and checks, beside the file"""

_SHARED = ("hours", "closed", "tolerance_mm", "may_move", "needs_somebody", "may_repair")
_TOP = ("folder", *_SHARED, "arm")
_ARM = ("name", "address", "description", "bench", *_SHARED)


@dataclass(frozen=True, kw_only=True)
class FleetArm:
    """One arm of the file."""

    name: str
    address: str
    description: str | None = None
    """catalogue name or file; default: by the address"""
    bench: str = ""
    """arms of one bench take turns; empty: none"""
    hours: Hours = field(default_factory=Hours)
    tolerance_mm: float | None = None
    may_move: bool = False
    needs_somebody: bool = True
    may_repair: bool = False

    @property
    def virtual(self) -> bool:
        """Whether it is emulated."""
        return place_of(self.address).virtual

    @property
    def resource(self) -> str:
        """Cluster resource of computers that reach this arm."""
        return f"arm-{self.name}"


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """All arms of a file."""

    path: Path
    folder: Path
    """of all runs and checks"""
    arms: tuple[FleetArm, ...]

    def only(self, names: tuple[str, ...]) -> tuple[FleetArm, ...]:
        """Named arms, default: all; InputError for an unknown name."""
        known = [arm.name for arm in self.arms]
        unknown = [name for name in names if name not in known]
        if unknown:
            raise InputError(f"{self.path} has no arm {', '.join(unknown)}; it has: {', '.join(known)}")
        return tuple(arm for arm in self.arms if not names or arm.name in names)


def read_fleet(path: Path | str) -> Fleet:
    """Read FLEET.toml; FileError names the wrong line and key."""
    place = Path(path)
    top = read_toml(place, _TOP, "check the path of the file with the arms")
    home = place.resolve().parent  # other processes stand in other folders
    arms: list[FleetArm] = []
    for table in top.tables("arm", _ARM):
        arm = _arm(table, top, home)
        for other in arms:
            if arm.name == other.name:
                raise table.error("name", f"two arms have the name {arm.name!r}")
            if place_of(arm.address).spot == place_of(other.address).spot:
                same = "" if arm.address == other.address else f", which is that of {other.name}, {other.address!r}"
                raise table.error("address", f"two arms have the address {arm.address!r}{same}")
        arms.append(arm)
    folder = _place(home, top.string("folder") if "folder" in top.data else FOLDER)
    return Fleet(path=place, folder=folder, arms=tuple(arms))


def _arm(table: TomlTable, top: TomlTable, home: Path) -> FleetArm:
    name, address = table.string("name"), table.string("address")
    if plain_name(name) != name:
        raise table.error("name", f"expected letters, digits, dots and dashes, such as bench-3, found {name[:40]!r}")
    try:
        place_of(address)
    except InputError as error:
        raise table.error("address", str(error)) from error
    description = _description(table, home)
    try:
        arm_of(address, description)
    except (InputError, FileError) as error:
        raise table.error("address" if description is None else "description", str(error)) from error
    hours = Hours(spans=_hours(table, top, "hours").spans, closed=_hours(table, top, "closed").closed)
    return FleetArm(
        name=name,
        address=address,
        description=description,
        hours=hours,
        bench=table.string("bench") if "bench" in table.data else "",
        tolerance_mm=_giver("tolerance_mm", table, top).number("tolerance_mm", above=0.0),
        may_move=_said("may_move", table, top, usual=False),
        needs_somebody=_said("needs_somebody", table, top, usual=True),
        may_repair=_said("may_repair", table, top, usual=False),
    )


def _giver(key: str, table: TomlTable, top: TomlTable) -> TomlTable:
    return table if key in table.data else top


def _said(key: str, table: TomlTable, top: TomlTable, *, usual: bool) -> bool:
    found = _giver(key, table, top).boolean(key)
    return usual if found is None else found


def _hours(table: TomlTable, top: TomlTable, key: str) -> Hours:
    giver = _giver(key, table, top)
    texts = giver.texts(key) or ()
    try:
        return read_hours(texts) if key == "hours" else read_hours((), texts)
    except ValueError as error:
        raise giver.error(key, str(error)) from error


def _description(table: TomlTable, home: Path) -> str | None:
    if "description" not in table.data:
        return None
    text = table.string("description")
    return text if text in CATALOGUE else str(_place(home, text))


def _place(home: Path, text: str) -> Path:
    """Path relative to the file's folder; ``~`` is the home folder."""
    return home / os.path.expanduser(text)  # noqa: PTH111 - that of Path fails where there is no home folder
