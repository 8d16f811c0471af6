"""The fleet file: arms, and when they may move."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime, time, timedelta
from itertools import chain
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec.structs import asdict

from rejoint.arms import CATALOGUE
from rejoint.logs.history import plain_name
from rejoint.robots import place_of
from rejoint.session.inputs import arm_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.tomltable import Positive, Table, Text, Texts, read_toml

DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
ROOM = 5
"""[min] for which hours go on at least when a motion begins; chosen: a diagnosis takes four"""
HORIZON = 400
"""[days] to search for the next opening; chosen"""

_SPAN = re.compile(r"\s*(\w+)(?:\s*-\s*(\w+))?\s+(\d\d):(\d\d)\s*-\s*(\d\d):(\d\d)\s*")
_DATES = re.compile(r"\s*(\d{4}-\d\d-\d\d)(?:\s+to\s+(\d{4}-\d\d-\d\d))?\s*")
_DAY, _MINUTE = timedelta(days=1), timedelta(minutes=1)
_FULL = 24 * 60  # minutes of a day


@dataclass(frozen=True, kw_only=True)
class Hours:
    """Hours at which an arm may move, by the local clock."""

    spans: tuple[tuple[int, int], ...] = ()
    """first minute of the week and number of minutes; (): always open"""
    closed: tuple[tuple[date, date], ...] = ()
    """first and last day without motion"""

    def is_open(self, now: datetime) -> bool:
        """Whether the arm may move at ``now``."""
        if any(first <= now.date() <= last for first, last in self.closed):
            return False
        minute = _FULL * now.weekday() + 60 * now.hour + now.minute
        return not self.spans or any((minute - first) % (7 * _FULL) < length for first, length in self.spans)

    def begins(self, now: datetime) -> datetime | None:
        """Return ``now`` if a motion may begin, else when it may next; None beyond `HORIZON`."""
        times = chain([now], self._changes(now))
        return next((at for at in times if all(self.is_open(at + one * _MINUTE) for one in range(ROOM))), None)

    def _changes(self, now: datetime) -> Iterator[datetime]:
        minutes = {0, *(edge % _FULL for first, length in self.spans for edge in (first, first + length))}
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


def _span(text: str) -> list[tuple[int, int]]:
    """Read the hours of one or several days: ``Fri 22:00-06:00`` ends on Saturday."""
    found = _SPAN.fullmatch(text)
    names = [] if found is None else [found[1], found[2] or found[1]]
    if found is None or not all(name.title() in DAYS for name in names):
        raise ValueError(f"expected hours such as Mon-Fri 08:00-18:00 (days {', '.join(DAYS)}), found {text[:40]!r}")
    first, last = (60 * int(found[i]) + int(found[i + 1]) for i in (3, 5))
    if first >= _FULL or last > _FULL or int(found[4]) > 59 or int(found[6]) > 59 or first == last:
        raise ValueError(f"expected two different times from 00:00 to 24:00, found {text[:40]!r}")
    day, end = (DAYS.index(name.title()) for name in names)
    length = (last - first) % _FULL or _FULL
    return [((day + i) % 7 * _FULL + first, length) for i in range((end - day) % 7 + 1)]


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


class _SharedTable(Table):
    hours: Texts | None = None
    closed: Texts | None = None
    tolerance_mm: Positive | None = None
    may_move: bool | None = None
    needs_somebody: bool | None = None
    may_repair: bool | None = None


class _ArmTable(_SharedTable, kw_only=True):
    name: Text
    address: Text
    description: Text | None = None
    bench: Text = ""


class _FleetTable(_SharedTable, kw_only=True):
    arm: Annotated[list[_ArmTable], msgspec.Meta(min_length=1)]
    folder: Text = FOLDER


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

    @property
    def home(self) -> Path:
        """Folder of its calls and pages."""
        return self.folder / "fleet"

    def only(self, names: tuple[str, ...]) -> tuple[FleetArm, ...]:
        """Named arms, default: all; InputError for an unknown name."""
        known = [arm.name for arm in self.arms]
        unknown = [name for name in names if name not in known]
        if unknown:
            raise InputError(f"{self.path} has no arm {', '.join(unknown)}; it has: {', '.join(known)}")
        return tuple(arm for arm in self.arms if not names or arm.name in names)


def read_fleet(path: Path | str) -> Fleet:
    """Read FLEET.toml; FileError names the wrong key."""
    place = Path(path)
    top = read_toml(place, _FleetTable, "check the path of the file with the arms")
    home = place.resolve().parent  # other processes stand in other folders
    arms: dict[str, FleetArm] = {}
    spots: dict[str, str] = {}
    for table in top.arm:
        try:
            arm = _arm(table, top, home)
            spot = place_of(arm.address).spot
            if arm.name in arms:
                raise ValueError("two arms have this name")
            if spot in spots:
                raise ValueError(f"address {arm.address!r} is that of {spots[spot]}, too")
        except (ValueError, FileError) as error:
            raise FileError(place, f"arm {table.name[:40]!r}: {error}", "correct the file") from error
        arms[arm.name], spots[spot] = arm, arm.name
    return Fleet(path=place, folder=_place(home, top.folder), arms=tuple(arms.values()))


def _arm(table: _ArmTable, top: _FleetTable, home: Path) -> FleetArm:
    """ValueError (as InputError is), FileError."""
    if plain_name(table.name) != table.name:
        raise ValueError("expected a name of letters, digits, dots and dashes, such as bench-3")
    description = table.description
    if description is not None and description not in CATALOGUE:
        description = str(_place(home, description))
    arm_of(table.address, description)
    shared = {name: getattr(top, name) for name in _SharedTable.__struct_fields__}
    said = {name: value for one in (shared, asdict(table)) for name, value in one.items() if value is not None}
    hours = read_hours(said.pop("hours", ()), said.pop("closed", ()))
    return FleetArm(**said | {"description": description, "hours": hours})


def _place(home: Path, text: str) -> Path:
    """Path relative to the file's folder; ``~`` is the home folder."""
    return home / os.path.expanduser(text)  # noqa: PTH111 - that of Path fails where there is no home folder
