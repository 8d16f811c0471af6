"""What the columns of a table mean: by their titles, or as the user maps them; units are never guessed."""

from __future__ import annotations

import re
from dataclasses import dataclass

from rejoint.arms import Arm
from rejoint.logs.joints import means_a_joint
from rejoint.logs.options import OPTIONS, TIME_UNITS, ImportOptions
from rejoint.logs.runlog import AXES
from rejoint.logs.textfile import Sheet
from rejoint.system.errors import FileError, InputError

LENGTHS = {"m": 1.0, "mm": 1e3}
GROUPS = ("position", "command", "target", "true_tcp")
UNITS = {
    "time": tuple(TIME_UNITS), "position": ("rad", "deg"), "command": ("rad", "deg"),
    "target": tuple(LENGTHS), "true_tcp": tuple(LENGTHS),
}  # fmt: skip
_OPTION = {"time": "time_unit", "position": "angle_unit", "command": "angle_unit"}
_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*(\w+|°)\s*[\])]$")
"""A title with its unit in brackets, such as ``elbow [deg]`` or ``elbow [°]``"""


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column that a log is made of."""

    index: int
    title: str
    group: str
    """``time``, ``position``, ``command``, ``target`` or ``true_tcp``"""
    name: str
    """joint or axis"""
    unit: str


def understood(sheet: Sheet, arm: Arm, options: ImportOptions) -> tuple[list[Column], list[str]]:
    """Return the columns that a log is made of, and the titles of the others.

    FileError for a column without a unit or with two, and for one that the user maps and the file lacks;
    InputError for a map to something that no log has.
    """
    meanings = {title: title for title in sheet.titles} | _mapped(sheet, arm, options)
    columns, ignored = [], []
    for index, title in enumerate(sheet.titles):
        meaning = _plain(meanings[title])
        group = _group(meaning)
        if group is None:
            ignored.append(title or "(no name)")
            continue
        name, written = _parted(meaning.removeprefix(f"{group}."), group)
        if written is None:  # a mapped column may say its unit in its own title
            written = _parted(_plain(title), group)[1]
        unit = _unit(title, group, written, options, sheet)
        columns.append(Column(index=index, title=title, group=group, name=name, unit=unit))
    return columns, ignored


def _plain(title: str) -> str:
    """Write ``elbow [deg]`` as ``elbow_deg``."""
    found = _BRACKETS.match(title)
    if found is None:
        return title
    unit = "deg" if found[2] == "°" else found[2]
    known = {unit for units in UNITS.values() for unit in units}
    return f"{found[1]}_{unit}" if unit in known else title


def _group(meaning: str) -> str | None:
    """Tell what a column holds by its meaning; None for something that a log does not need."""
    if meaning in ("time", *(f"time_{unit}" for unit in TIME_UNITS)):
        return "time"
    group, _, name = meaning.partition(".")
    return group if group in GROUPS and name else None


def _parted(name: str, group: str) -> tuple[str, str | None]:
    """Split a name into itself and the unit that it ends in, if any."""
    stem, _, ending = name.rpartition("_")
    return (stem, ending) if stem and ending in UNITS[group] else (name, None)


def _mapped(sheet: Sheet, arm: Arm, options: ImportOptions) -> dict[str, str]:
    """Return the meaning of each title that the user maps; either side of a pair may be ours."""
    found: dict[str, str] = {}
    for left, right in (options.columns or {}).items():
        ours, theirs = _role(left, arm, options), right
        if ours is None or (theirs not in sheet.titles and left in sheet.titles):
            ours, theirs = _role(right, arm, options), left
        if ours is None:
            raise InputError(
                f"--map {left}={right}: neither side is something that a log has: time, JOINT, command.JOINT, target.x "
                f"or true_tcp.x; the joints are {', '.join(arm.joint_names)}"
            )
        if theirs not in sheet.titles:
            raise FileError(
                sheet.path, f"--map {left}={right}: no column {theirs}; found {sheet.found}: {sheet.shown}",
                "name one of these",
            )  # fmt: skip
        if theirs in found:
            raise InputError(f"--map takes column {theirs} twice: as {found[theirs]} and as {ours}")
        found[theirs] = ours
    return found


def _role(name: str, arm: Arm, options: ImportOptions) -> str | None:
    """Return what a name in a map stands for: a group, or a joint by itself, which is its position."""
    name = _plain(name)
    group = _group(name)
    joint = _parted(name.removeprefix(f"{group}."), group or "position")[0]
    if group in ("time", "target", "true_tcp"):
        return name if group == "time" or joint in AXES else None
    if not means_a_joint(joint, arm, options):
        return None
    return name if group else f"position.{name}"


def _unit(title: str, group: str, written: str | None, options: ImportOptions, sheet: Sheet) -> str:
    name = _OPTION.get(group)
    declared, option = (getattr(options, name), OPTIONS[name]) if name else (None, "")
    if written and declared and written != declared:
        raise FileError(
            sheet.path, f"column {title} is in {written} by its name, but {option} says {declared}",
            f"leave {option} out or rename the column",
        )  # fmt: skip
    unit: str | None = written or declared
    if unit is None:
        endings = " or ".join(f"{title}_{unit}" for unit in UNITS[group])
        more = f" or set {option}" if option else ""
        raise FileError(sheet.path, f"column {title} does not say its unit", f"rename it {endings}{more}")
    return unit
