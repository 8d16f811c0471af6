"""FLEET.toml: the arms of a lab, their addresses, hours and permissions.

::

    folder = "lab"                            # optional: where all runs and checks are; runs, beside this file
    hours = ["Mon-Fri 08:00-18:00"]           # optional: when arms may move, any time
    closed = ["2026-12-24 to 2027-01-06"]     # optional: days on which none may
    tolerance_mm = 3.0                        # optional: error of a tool that its owner can bear
    may_move = true                           # optional, false: nothing moves without it
    needs_somebody = true                     # optional, true: moves only where somebody is said to be there
    may_repair = false                        # optional, false: a repair moves an arm for longer than a check

    [[arm]]                                   # one for each arm
    name = "bench-3"
    address = "tcp://192.168.1.20:9000"
    description = "so101"                     # optional: name in the catalogue, or a file; as the address says
    bench = "table 1"                         # optional: arms of one bench never move at the same time
    hours = ["Sat 09:00-12:00"]               # optional, as are closed, tolerance_mm and the three permissions:
                                              # instead of those at the top

Paths are from the folder that the file is in; ``~`` is the home folder. Hours are by the clock of the computer that
leads.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from rejoint.arms import CATALOGUE
from rejoint.logs.history.identity import plain_name
from rejoint.robots import place_of
from rejoint.runs.fleet.hours import Hours, read_hours
from rejoint.runs.given import arm_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.tomltable import TomlTable, read_toml

FOLDER = "runs"
"""Where runs and checks are kept, beside the file, if it does not say"""

_SHARED = ("hours", "closed", "tolerance_mm", "may_move", "needs_somebody", "may_repair")
_TOP = ("folder", *_SHARED, "arm")
_ARM = ("name", "address", "description", "bench", *_SHARED)


@dataclass(frozen=True, kw_only=True)
class FleetArm:
    """One arm, as its owner describes it."""

    name: str
    address: str
    description: str | None = None
    """name in the catalogue or file; None for what the address says"""
    bench: str = ""
    """arms of one bench never move at the same time; empty for one that stands alone"""
    hours: Hours = field(default_factory=Hours)
    tolerance_mm: float | None = None
    may_move: bool = False
    needs_somebody: bool = True
    may_repair: bool = False

    @property
    def virtual(self) -> bool:
        """Whether it is emulated: it exists in whichever process asks for it, and nothing moves."""
        return place_of(self.address).virtual

    @property
    def resource(self) -> str:
        """What a computer of a cluster says that it has if it reaches this arm."""
        return f"arm-{self.name}"


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """All arms of a file."""

    path: Path
    folder: Path
    """below which all runs and checks are"""
    arms: tuple[FleetArm, ...]

    def only(self, names: tuple[str, ...]) -> tuple[FleetArm, ...]:
        """Return the arms that are called so, all where no name is given; InputError for a name that none has."""
        known = [arm.name for arm in self.arms]
        unknown = [name for name in names if name not in known]
        if unknown:
            raise InputError(f"{self.path} has no arm {', '.join(unknown)}; it has: {', '.join(known)}")
        return tuple(arm for arm in self.arms if not names or arm.name in names)


def read_fleet(path: Path | str) -> Fleet:
    """Read FLEET.toml; FileError names the line and the key that cannot be used."""
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
        name=name, address=address, description=description, hours=hours,
        bench=table.string("bench") if "bench" in table.data else "",
        tolerance_mm=_giver("tolerance_mm", table, top).number("tolerance_mm", above=0.0),
        may_move=_said("may_move", table, top, usual=False),
        needs_somebody=_said("needs_somebody", table, top, usual=True),
        may_repair=_said("may_repair", table, top, usual=False),
    )  # fmt: skip


def _giver(key: str, table: TomlTable, top: TomlTable) -> TomlTable:
    """Return the table that a key of an arm is to be read from: its own, or the top for all arms."""
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
    """Return the arm's name in the catalogue as it is, and a file as seen from the fleet's folder."""
    if "description" not in table.data:
        return None
    text = table.string("description")
    return text if text in CATALOGUE else str(_place(home, text))


def _place(home: Path, text: str) -> Path:
    """Return a path of the file as seen from its folder; ``~`` is the home folder, as on the command line."""
    return home / os.path.expanduser(text)  # noqa: PTH111 - that of Path fails where there is no home folder
