"""What the columns of a file mean; units are never guessed.

A title is a group, a joint and a unit: ``position.elbow_deg``, ``act_m0``, ``actual_q_5``, ``tau_measured_2``.
`ImportOptions.columns` maps others: ``time_ms=t``, ``command.elbow=u3``, ``target.x_mm=gx``. ``elbow=q3`` or
``joint1=m0/6.33-0.184`` holds for all columns of a joint (torque is divided by the scale, current takes its sign).
``command=27..32`` names all joints from the base on.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.joints import ANGLES, COUNTS_PER_TURN, half_ranges, match_joints, means_a_joint, radians
from rejoint.logs.options import OPTIONS, TIME_UNITS, ImportOptions, Linear
from rejoint.logs.runlog import AXES, Array
from rejoint.logs.track import MEASURED, ColumnFrame, Points, RecordedMotion, Track
from rejoint.logs.units import calibrated_ranges
from rejoint.system.errors import FileError, InputError
from rejoint.system.textfile import shown, split_unit

LENGTHS = {"m": 1.0, "mm": 1e-3}
"""[m]"""
UNITS: dict[str, dict[str, float]] = {
    "time": {unit: 1.0 / ticks for unit, ticks in TIME_UNITS.items()},
    "position": ANGLES,
    "command": ANGLES,
    "target": LENGTHS,
    "true_tcp": LENGTHS,
    "torque": {"Nm": 1.0, "mNm": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
    "gain": {},
    "powered": {},
}
"""SI units per unit of each group"""
SI = {"torque": "N m", "current": "A"}
_TIMES = ("time", "t", "timestamp")
_PREFIXES = {
    "position": "position", "pos": "position", "q": "position", "actual": "position", "act": "position",
    "present_position": "position", "actual_q": "position", "state.q": "position",
    "command": "command", "cmd": "command", "goal": "command", "goal_position": "command", "tgt": "command",
    "q_cmd": "command", "positioncmptd": "command", "target_q": "command", "state.q_d": "command",
    "torque": "torque", "effort": "torque", "tau": "torque", "tau_measured": "torque", "state.tau_j": "torque",
    "current": "current", "cur": "current", "actual_current": "current", "gain": "gain", "kp": "gain",
    "torque_enable": "powered", "target": "target", "true_tcp": "true_tcp",
}  # fmt: skip
"""Beginnings of titles"""
_RECORDERS = {"actual_q": ("rad", "s"), "state.q": ("rad", "ms"), "positioncmptd": ("rad", "ms")}
"""Implied units: RTDE of Universal Robots, libfranka's ``logToCSV``, wissem01chiha/dynamic- identification (Kinova
Gen3)"""
_ORDER = sorted(_PREFIXES, key=len, reverse=True)
_JOINT = re.compile(r"[._ ]?\[?(?P<number>\d+)\]?|[._ ](?P<name>.+)|")


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of a log."""

    index: int
    title: str
    group: str
    """key of `UNITS`"""
    name: str
    """joint, its number, or axis; empty: all joints"""
    unit: str | None
    """in the title"""
    linear: Linear | None = None
    """the user's, for this column"""


def read_motion(
    name: str,
    frames: Sequence[ColumnFrame],
    arm: Arm,
    options: ImportOptions,
    *,
    robot: str,
    extra: dict[str, str],
    notes: Sequence[str] = (),
) -> RecordedMotion:
    """Make a motion of columns on one clock, or of states and commands on their own.

    FileError for missing or double columns, or no unit; InputError for a wrong map.
    """
    tables = [_ForeignTable(frame, arm, options) for frame in frames]
    _check_map(tables, arm, options)
    state = next((table for table in tables if table.of("position")), None)
    if state is None:
        titles = ", ".join(shown(frame.titles) for frame in frames)
        raise FileError(
            frames[0].path,
            f"no column with joint positions; found {frames[0].found}: {titles}",
            "name them position.JOINT and command.JOINT, or map yours: --map JOINT=THEIRS; a time, position.JOINT and "
            "command.JOINT are expected",
        )
    commanding = next((table for table in tables if table.of("command")), None)
    half = _half_ranges(state, arm, options)
    made = [table.track(group, half) for table, group in ((state, "position"), (commanding, "command")) if table]
    remarks = [note for table in tables for note in table.notes]
    if half is not None and options.calibration is None:
        counts = ", ".join(
            f"{joint} {abs(one):.0f}" for joint, one in zip(arm.joint_names, 2 * half / _COUNT, strict=True)
        )
        remarks.append(
            f"without a calibration the ranges follow from the steps of the encoders ({counts} counts); "
            "the middle of each range is unknown and taken as zero: offsets, sag and places of the tool are not known"
        )
    return RecordedMotion(
        name=name,
        state=made[0],
        command=made[1] if len(made) > 1 else None,
        angle_unit="/".join(sorted(state.units)),
        units=state.measured_units,
        points=state.points(),
        robot=robot,
        extra=extra,
        notes=(*notes, *remarks),
    )


def holds_positions(titles: Sequence[str], options: ImportOptions) -> bool:
    """Whether titles, or the user's map, are a log's."""
    mapped = {
        part
        for text in (options.columns or {}).values()
        for part in (Linear.of(text, titles).column, *text.split(".."))
    }
    return bool(mapped & {*titles}) or any(
        found[1] in ("position", "command") and ("." in title or found[2].isdigit() or not found[2])
        for title in titles
        if (found := _classified(title))
    )


_COUNT = 2 * np.pi / COUNTS_PER_TURN


class _ForeignTable:
    """Columns of a frame with a meaning."""

    def __init__(self, frame: ColumnFrame, arm: Arm, options: ImportOptions) -> None:
        self.frame, self.arm, self.options = frame, arm, options
        self.notes: list[str] = []
        self.units: set[str] = set()
        self.measured_units: dict[str, str] = {}
        doubled = sorted({title for title in frame.titles if title and frame.titles.count(title) > 1})
        classified = {i: found for i, title in enumerate(frame.titles) if (found := _classified(title))}
        prefixes = {found[0] for found in classified.values()}
        self.recorder = next((units for prefix, units in _RECORDERS.items() if prefix in prefixes), None)
        self.columns = {
            i: Column(index=i, title=frame.titles[i], group=group, name=name, unit=unit)
            for i, (_, group, name, unit) in classified.items()
        }
        for column in self._mapped():
            self.columns[column.index] = column
        if twice := [column.title for column in self.columns.values() if column.title in doubled]:
            raise FileError(
                frame.path, f"line 1: column {', '.join(sorted({*twice}))} stands there twice", "rename one"
            )
        ignored = [title or "(no name)" for i, title in enumerate(frame.titles) if i not in self.columns]
        self.notes += [f"columns ignored: {shown(ignored)}"] * bool(ignored)

    def of(self, group: str) -> list[Column]:
        return [column for column in self.columns.values() if column.group == group]

    @property
    def known(self) -> set[str]:
        """Titles, and joint names in them."""
        return {*self.frame.titles, *(column.name for column in self.columns.values())}

    def _mapped(self) -> list[Column]:
        found: list[Column] = []
        for ours, theirs in (self.options.columns or {}).items():
            titles = self.frame.titles
            first, dots, last = theirs.partition("..")
            if dots and first in titles and last in titles:
                chosen = range(titles.index(first), titles.index(last) + 1)
                group, unit = next(
                    ((g, split_unit(ours, UNITS[g])[1]) for g in UNITS if ours.startswith(g)), (ours, None)
                )
                if group not in UNITS or len(chosen) != self.arm.joints:
                    raise InputError(f"--map {ours}={theirs}: {len(chosen)} columns for {self.arm.joints} joints")
                for i, joint in zip(chosen, self.arm.joint_names, strict=True):
                    linear = Linear(column=titles[i])
                    found.append(Column(index=i, title=titles[i], group=group, name=joint, unit=unit, linear=linear))
                continue
            linear = Linear.of(theirs, self.known)
            if linear.column not in titles:
                continue
            i, own = titles.index(linear.column), _classified(ours)
            said = split_unit(linear.column, TIME_UNITS | ANGLES | LENGTHS)[1]
            if own is not None:
                found.append(
                    Column(index=i, title=titles[i], group=own[1], name=own[2], unit=own[3] or said, linear=linear)
                )
            elif i not in self.columns:  # which joint it is says the map, to `match_joints`
                unit = split_unit(ours, ANGLES)[1] or said
                found.append(Column(index=i, title=titles[i], group="position", name=titles[i], unit=unit))
        if len({column.index for column in found}) < len(found):
            raise InputError("--map takes a column twice")
        return found

    def _unit(self, column: Column, default: str | None) -> str:
        key = "time_unit" if column.group == "time" else "angle_unit"
        declared, option = getattr(self.options, key), OPTIONS[key]
        if column.unit and declared and column.unit != declared:
            raise FileError(
                self.frame.path,
                f"column {column.title} is in {column.unit} by its name, but {option} says {declared}",
                f"leave {option} out or rename the column",
            )
        unit = column.unit or declared or default
        if unit is None:
            endings = " or ".join(f"{column.title}_{unit}" for unit in UNITS[column.group])
            raise FileError(
                self.frame.path, f"column {column.title} does not say its unit", f"rename it {endings} or set {option}"
            )
        return str(unit)

    def time(self) -> Array:
        times = self.of("time")
        if self.frame.time is not None:
            return self.frame.time
        if self.options.rate is not None and len(times) < 2:
            return np.arange(len(self.frame.number)) / self.options.rate
        if len(times) != 1:
            found = " and ".join(column.title for column in times) or "none"
            raise FileError(
                self.frame.path,
                f"{found} of the columns {shown(self.frame.titles)} says the time, expected one; the "
                f"file is {self.frame.found}",
                f"name one {' or '.join(f'time_{unit}' for unit in TIME_UNITS)}, map yours (--map time_s=THEIRS), or "
                "give the rows in a second (--rate)",
            )
        unit = self._unit(times[0], self.recorder[1] if self.recorder else None)
        return self.frame.values([times[0].index])[:, 0] / TIME_UNITS[unit]

    def raw(self, group: str) -> tuple[Array, list[Column]]:
        """Return a group (T, n) in the arm's order and file units, and its columns."""
        columns = self.of(group)
        if len(columns) == 1 and not columns[0].name and (self.arm.joints == 1 or group in ("gain", "powered")):
            columns = columns * self.arm.joints
            linear = [columns[0].linear or Linear(column="")] * self.arm.joints
        else:
            match = match_joints(
                [column.name for column in columns],
                self.arm,
                self.options,
                self.frame.path,
                group,
                [column.title for column in columns],
            )
            columns = [columns[i] for i in match.columns]
            linear = [own.linear or one for own, one in zip(columns, match.linear, strict=True)]
            if match.dropped and group in ("position", "command"):
                self.notes.append(f"{group}: names that are no joints dropped: {shown(match.dropped)}")
            if match.numbered:
                self.notes.append(
                    f"{group}: {columns[0].title} to {columns[-1].title} taken as the joints from the base on"
                )
        values = self.frame.values([column.index for column in columns])
        scale, offset = (np.array([getattr(one, key) for one in linear]) for key in ("scale", "offset"))
        if group == "torque":
            return values / scale, columns
        return (values * np.sign(scale) if group == "current" else values * scale + offset), columns

    def track(self, group: str, half: Array | None) -> Track:
        """States with all measurements, or commands."""
        raw, columns = self.raw(group)
        default = self.recorder[0] if self.recorder else self.frame.angle_unit
        units = [self._unit(column, default) for column in columns]
        self.units |= {*units}
        values = np.empty_like(raw)
        for joint, unit in enumerate(units):
            part = None if half is None else half[[joint]]
            values[:, [joint]] = radians(raw[:, [joint]], unit, part, self.frame.path)
        return Track(
            path=self.frame.path,
            what="state" if group == "position" else "command",
            time=self.time(),
            value=values,
            columns=tuple(column.title for column in columns),
            place=self.frame.place,
            number=self.frame.number,
            more=self._measured() if group == "position" else {},
        )

    def _measured(self) -> dict[str, Array]:
        found: dict[str, Array] = {}
        for group in (*MEASURED, "powered"):
            try:
                raw, columns = self.raw(group) if self.of(group) else (np.zeros(0), [])
            except FileError as error:
                self.notes.append(f"{group} left out: {error.problem}")
                continue
            if not columns:
                continue
            units = {column.unit or (next(iter(UNITS[group]), None) if self.recorder else None) for column in columns}
            unit = units.pop() if len(units) == 1 else None
            if group == "powered":
                found["gain"] = np.where(raw > 0, found.get("gain", np.nan), 0.0)
                continue
            found[group] = raw * UNITS[group].get(unit or "", 1.0)
            self.measured_units[group] = SI[group] if unit in UNITS[group] else ""
            if group in SI and unit is None:
                self.notes.append(f"{group}: {columns[0].title} says no unit; kept in the unit of the column")
        return found

    def points(self) -> dict[str, Points]:
        found = {}
        for group in ("target", "true_tcp"):
            columns = {column.name: column for column in self.of(group)}
            if not columns:
                continue
            if {*columns} != {*AXES} or len(self.of(group)) != len(AXES):
                raise FileError(
                    self.frame.path, f"columns of {group} are not x, y and z, once each", "name all three or none"
                )
            axes = [columns[axis] for axis in AXES]
            if unknown := [column.title for column in axes if column.unit is None]:
                raise FileError(
                    self.frame.path, f"column {unknown[0]} does not say its unit", "name it ..._m or ..._mm"
                )
            scale = np.array([LENGTHS[column.unit or "m"] for column in axes])
            found[group] = Points(time=self.time(), value=self.frame.values([column.index for column in axes]) * scale)
        return found


def _classified(title: str) -> tuple[str, str, str, str | None] | None:
    """Prefix, group, joint or axis, and unit of a title; None: another title."""
    stem, unit = split_unit(title, TIME_UNITS)
    if stem.casefold() in _TIMES:
        return stem.casefold(), "time", "", unit
    for prefix in _ORDER:
        if not title.casefold().startswith(prefix):
            continue
        group = _PREFIXES[prefix]
        rest, unit = split_unit(f"x{title[len(prefix) :]}", UNITS[group])
        found = _JOINT.fullmatch(rest[1:])
        name = "" if found is None else found["number"] or found["name"] or ""
        if found is not None and (group not in ("target", "true_tcp") or name in AXES):
            return prefix, group, name, unit
    return None


def _check_map(tables: Sequence[_ForeignTable], arm: Arm, options: ImportOptions) -> None:
    known = set().union(*(table.known for table in tables))
    for ours, theirs in (options.columns or {}).items():
        joint = split_unit(ours, ANGLES)[0]
        ranged = ours.partition("_")[0] in UNITS and ".." in theirs
        if not (ranged or _classified(ours) or means_a_joint(joint, arm, replace(options, columns=None))):
            raise InputError(
                f"--map {ours}={theirs}: {ours} is nothing that a log has: time, JOINT, command.JOINT, torque.JOINT, "
                f"target.x or true_tcp.x; the joints are {', '.join(arm.joint_names)}"
            )
        column = Linear.of(theirs, known).column
        if column not in known and not (ranged and {*theirs.split("..")} <= known):
            found = tables[0].frame
            raise FileError(
                found.path,
                f"--map {ours}={theirs}: no column {column}; found {found.found}: {shown(found.titles)}",
                "name one of these",
            )


def _half_ranges(state: _ForeignTable, arm: Arm, options: ImportOptions) -> Array | None:
    """Half range (n,) [rad] of joints for normalised values."""
    if options.angle_unit != "normalised":
        return None
    if options.calibration is not None:
        return half_ranges(options.calibration, arm, options)
    return calibrated_ranges(state.raw("position")[0], arm, state.frame.path) * _COUNT / 2.0
