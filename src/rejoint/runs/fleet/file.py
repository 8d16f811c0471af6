"""The fleet file: arms, and when they may move."""

import os
import re
from contextlib import suppress
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
import tomlkit
from msgspec.structs import replace
from numpy.lib.stride_tricks import sliding_window_view

from rejoint.arms import CATALOGUE, Arm, Mask
from rejoint.logs.history import plain_name
from rejoint.robots import place_of
from rejoint.session.inputs import arm_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import Positive, Table, Text, Texts, read_toml, write_text

DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
ROOM = 5
"""[min] for which hours go on at least when a motion begins; chosen: a diagnosis takes four"""
HORIZON = 400
"""[days] to search for the next opening; chosen"""

_SPAN = re.compile(r"\s*(\w+)(?:\s*-\s*(\w+))?\s+(\d\d):([0-5]\d)\s*-\s*(\d\d):([0-5]\d)\s*")
_MINUTE, _MONDAY = timedelta(minutes=1), datetime(2001, 1, 1)
_DAY, _WEEK = 24 * 60, 7 * 24 * 60  # minutes


class Hours(NamedTuple):
    """Hours at which an arm may move, by the local clock."""

    spans: tuple[tuple[int, int], ...]
    """first minute of the week and number of minutes; (): always open"""
    closed: tuple[tuple[int, int], ...]
    """first and last minute without motion, from `_MONDAY`"""

    def _open(self, now: datetime, minutes: int) -> Mask:
        minute = (now - _MONDAY) // _MINUTE + np.arange(minutes)
        found = np.full(minutes, not self.spans)
        for first, length in self.spans:
            found |= (minute - first) % _WEEK < length
        for first, last in self.closed:
            found &= (minute < first) | (minute > last)
        return found

    def is_open(self, now: datetime) -> bool:
        """Whether the arm may move at ``now``."""
        return bool(self._open(now, 1)[0])

    def begins(self, now: datetime) -> datetime | None:
        """Return ``now`` if a motion may begin, else when it may next; None beyond `HORIZON`."""
        room = np.asarray(sliding_window_view(self._open(now, HORIZON * _DAY), ROOM).all(axis=1))
        if room[0]:
            return now
        return now.replace(second=0, microsecond=0) + int(room.argmax()) * _MINUTE if room.any() else None


def _span(text: str) -> list[tuple[int, int]]:
    """Read the hours of one or several days: ``Fri 22:00-06:00`` ends on Saturday."""
    if found := _SPAN.fullmatch(text):
        names = found[1].title(), (found[2] or found[1]).title()
        first, last = (60 * int(found[i]) + int(found[i + 1]) for i in (3, 5))
        if {*names} <= {*DAYS} and first < _DAY and last <= _DAY and first != last:
            day, end = map(DAYS.index, names)
            length = (last - first) % _DAY or _DAY
            return [((day + i) % 7 * _DAY + first, length) for i in range((end - day) % 7 + 1)]
    raise ValueError(
        f"expected hours such as Mon-Fri 08:00-18:00 (days {', '.join(DAYS)}, two different times from 00:00 to "
        f"24:00), found {text[:40]!r}"
    )


def _dates(text: str) -> tuple[int, int]:
    begin, _, end = text.partition(" to ")
    with suppress(ValueError):
        first, last = (date.fromisoformat(one.strip()) - _MONDAY.date() for one in (begin, end or begin))
        if first <= last:
            return first // _MINUTE, last // _MINUTE + _DAY - 1
    raise ValueError(f"expected a day such as 2026-12-24, or 2026-12-24 to 2027-01-06, found {text[:40]!r}")


FOLDER = "runs"
"""Default folder of runs and checks, beside the file"""


class _SharedTable(Table, kw_only=True):
    hours: Texts | None = None
    closed: Texts | None = None
    tolerance_mm: Positive | None = None
    may_move: bool = False
    needs_somebody: bool = True
    may_repair: bool = False


class _FleetTable(_SharedTable, kw_only=True):
    arm: Annotated[list[dict[str, Any]], msgspec.Meta(min_length=1)]
    folder: Text = FOLDER


class FleetArm(_SharedTable, kw_only=True):
    """One arm of the file."""

    name: Text
    address: Text
    description: Text | None = None
    """catalogue name or file; default: by the address"""
    bench: Text = ""
    """arms of one bench take turns; empty: none"""

    @property
    def opening(self) -> Hours:
        """Hours at which it may move; ValueError names a wrong text."""
        spans = tuple(one for text in self.hours or () for one in _span(text))
        return Hours(spans=spans, closed=tuple(map(_dates, self.closed or ())))

    @property
    def virtual(self) -> bool:
        """Whether it is emulated."""
        return place_of(self.address).virtual

    @property
    def built(self) -> Arm:
        """The arm; InputError, FileError."""
        return arm_of(self.address, self.description)

    @property
    def resource(self) -> str:
        """Cluster resource of computers that reach this arm."""
        return f"arm-{self.name}"


class Fleet(NamedTuple):
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
    home, arms = place.resolve().parent, dict[str, FleetArm]()  # other processes stand in other folders
    shared = {name: getattr(top, name) for name in _SharedTable.__struct_fields__}
    for table in top.arm:
        try:
            arm = msgspec.convert(shared | table, FleetArm)
            if plain_name(arm.name) != arm.name:
                raise ValueError("expected a name of letters, digits, dots and dashes, such as bench-3")
            if arm.description is not None and arm.description not in CATALOGUE:
                arm = replace(arm, description=str(_place(home, arm.description)))
            arm.opening, arm.built  # noqa: B018 - what cannot be read or built is refused now
            spot = place_of(arm.address).spot
            if arm.name in {other.name for other in arms.values()}:
                raise ValueError("another arm has this name")
            if spot in arms:
                raise ValueError(f"address {arm.address!r} is that of {arms[spot].name}, too")
        except (ValueError, FileError) as error:
            raise FileError(place, f"arm {str(table.get('name'))[:40]!r}: {error}", "correct the file") from error
        arms[spot] = arm
    return Fleet(path=place, folder=_place(home, top.folder), arms=tuple(arms.values()))


def _place(home: Path, text: str) -> Path:
    return home / os.path.expanduser(text)  # noqa: PTH111 - that of Path fails where there is no home folder


NAMES = "FLEET.toml"
"""File with the arms that have a name"""


def names_file() -> Path:
    """Return `NAMES` in this folder, or else that of the user."""
    home = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")  # noqa: PTH111 - as in `_place`
    return Path(NAMES) if Path(NAMES).exists() else Path(home) / "rejoint" / NAMES


def known_arms() -> tuple[FleetArm, ...]:
    """Return the arms in `names_file`; FileError."""
    path = names_file()
    return read_fleet(path).arms if path.exists() else ()


def named_arm(name: str) -> FleetArm | None:
    """Return the arm of that name in `names_file`; None: there is none. FileError."""
    return None if ":" in name else next((arm for arm in known_arms() if arm.name == name), None)


def name_arm(name: str, **values: str | float) -> Path:
    """Write an arm into `names_file`, which stays as it was otherwise; FileError where it cannot be one."""
    path = names_file()
    if known := named_arm(name):
        raise InputError(f"{name} is the name of {known.address}; to free it: rejoint arms remove {name}")
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    document = tomlkit.parse(before)
    document.setdefault("arm", tomlkit.aot()).append({"name": name, **values})
    write_text(path, tomlkit.dumps(document))
    try:
        read_fleet(path)
    except FileError:
        write_text(path, before) if before else path.unlink()
        raise
    return path


def remove_name(name: str) -> Path:
    """Take an arm out of `names_file`; InputError for an unknown name."""
    path = names_file()
    document = tomlkit.parse(path.read_text(encoding="utf-8") if path.exists() else "")
    names = [arm["name"] for arm in document.get("arm", ())]
    if name not in names:
        raise InputError(f"there is no arm {name!r} in {path}; there are: {', '.join(names) or 'none'}")
    if len(names) == 1:
        path.unlink()  # a file without arms is refused
    else:
        del document["arm"][names.index(name)]
        write_text(path, tomlkit.dumps(document))
    return path
