"""What the columns of a file mean; units are never guessed.

A title is a group, a joint and a unit: ``position.elbow_deg``, ``act_m0``, ``actual_q_5``, ``tau_measured_2``.
`ImportOptions.columns` maps others: ``time_ms=t``, ``command.elbow=u3``, ``target.x_mm=gx``. ``elbow=q3`` or
``joint1=m0/6.33-0.184`` holds for all columns of a joint (torque is divided by the scale, current takes its sign).
``command=27..32`` names all joints from the base on.

In radians or degrees, the readings of an encoder step by the same amount on every joint. LeRobot's normalised values
step by 200 over the counts of a joint's calibrated range. All thresholds of these steps are chosen.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm
from rejoint.logs.joints import COUNTS_PER_TURN, TIME_UNITS, ImportOptions, Linear, half_ranges, joint_of, match_joints
from rejoint.logs.runlog import AXES, Array
from rejoint.system.errors import FileError, InputError
from rejoint.system.textfile import ANGLES, LENGTHS, shown, split_unit

FEWEST_VALUES = 20
"""Different readings for a step"""
FEWEST_STEPS = 10
"""Steps spanned by readings"""
ON, OFF = 0.9, 0.6
"""on a grid, and off it (1: all readings)"""
BITS = range(10, 22)
"""of encoders"""
SPANS = np.arange(1000, 4097)
"""[counts] of calibrated ranges"""


def on_grid(values: Array, *steps: float) -> float:
    """Largest share of values on multiples of one of ``steps``; 0: few steps."""
    counted = [step for step in steps if np.ptp(values) >= FEWEST_STEPS * step]
    return max((float(np.abs(np.mean(np.exp(2j * np.pi * values / step)))) for step in counted), default=0.0)


def readings(values: Array, decimals: int) -> list[Array]:
    """Different readings of the joints (T, n) that have enough."""
    return [one for joint in values.T if len(one := np.unique(np.round(joint, decimals))) >= FEWEST_VALUES]


def turn_bits(values: Array) -> int | None:
    """Return encoder bits of readings (T, n) [rad], or None."""
    found = readings(values, 12)
    return next((b for b in BITS if found and np.median([on_grid(one, 2 * np.pi / 2**b) for one in found]) > ON), None)


def unit_by_steps(raw: Array) -> tuple[str | None, str]:
    """Return unit of LeRobot's readings (T, n) by their steps, and why.

    LeRobot counts 4095 steps per turn, others 4096.
    """
    turn = [360.0 / (COUNTS_PER_TURN - less) for less in (0, 1)]
    joints = [(on_grid(values, *turn), *_best_grid(values)) for values in readings(raw, 4)]
    degrees = sum(share > ON for share, *_ in joints)
    steps = [step for share, step, fit in joints if fit > ON and share < OFF]
    if degrees > len(joints) / 2:
        return "deg", f"they come in steps of {turn[0]:.4f} on {degrees} joints, those of an encoder"
    if len(steps) > len(joints) / 2 and len({round(step, 4) for step in steps}) > 1:  # joints differ in their ranges
        return "normalised", f"they come in steps of {', '.join(f'{step:.4f}' for step in steps)}, no degrees do"
    return None, ""


def _best_grid(values: Array) -> tuple[float, float]:
    """Step of normalised values and their share on it; 0 for round numbers."""
    chosen = values[:: max(len(values) // 300, 1)]
    fit = np.abs(np.mean(np.exp(2j * np.pi * chosen[:, None] * SPANS / 200.0), axis=0))
    best = int(np.argmax(fit))
    rounded = on_grid(values, 0.05, 0.1, 0.2, 0.25, 0.5, 1.0) > ON
    return 200.0 / float(SPANS[best]), 0.0 if rounded else float(fit[best])


def calibrated_ranges(raw: Array, arm: Arm, path: Path) -> Array:
    """Calibrated range (n,) [counts] of joints from normalised readings (T, n); FileError without enough motion."""
    kind, why = unit_by_steps(raw)
    if kind == "deg":
        raise FileError(
            path, f"the states are degrees, but --angle-unit says normalised: {why}", "set --angle-unit deg"
        )
    counts = []
    for joint, name in zip(raw.T, arm.joint_names, strict=True):
        found = readings(joint[:, None], 4)
        step, fit = _best_grid(found[0]) if found else (0.0, 0.0)
        if fit < ON:
            raise FileError(
                path,
                f"the readings of {name} do not show the steps of its encoder: its range is not known",
                "give --calibration, or a recording in which it moves more",
            )
        counts.append(200.0 / step)
    return np.array(counts)


@dataclass(frozen=True, kw_only=True, eq=False)
class ColumnFrame:
    """Columns of a file on one clock, T rows."""

    path: Path
    titles: tuple[str, ...]
    values: Callable[[Sequence[int]], Array]
    """reads columns (T, k) in file units"""
    number: NDArray[np.int64]
    """(T,) row in the file"""
    place: str = "row"
    """``line``, ``message`` or ``row``"""
    time: Array | None = None
    """(T,) [s]; None: in a column"""
    angle_unit: str | None = None
    """default of angles"""
    found: str = "a table"
    """kind of the file"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """States or commands: T samples of n joints."""

    path: Path
    what: str
    """``state`` or ``command``"""
    time: Array
    """(T,) [s]"""
    value: Array
    """(T, n) [rad] in the arm's order"""
    columns: tuple[str, ...]
    """(n,) names in the file"""
    place: str
    """``line``, ``message`` or ``row``"""
    number: NDArray[np.int64]
    """(T,) place in the file"""
    more: Mapping[str, Array] = field(default_factory=dict)
    """other data with T rows, as fields of `RunLog`"""

    def __len__(self) -> int:
        return len(self.time)

    def where(self, sample: int) -> str:
        """Place of a sample in the file: ``line 17``."""
        return f"{self.place} {self.number[sample]}"

    def take(self, chosen: NDArray[np.bool_]) -> Track:
        """Return samples where ``chosen`` (T,) holds."""
        more = {name: values[chosen] for name, values in self.more.items()}
        return replace(self, time=self.time[chosen], value=self.value[chosen], number=self.number[chosen], more=more)

    def shifted(self, seconds: float) -> Track:
        """Return samples on a clock that starts ``seconds`` later."""
        return replace(self, time=self.time - seconds)


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedMotion:
    """A recorded motion before the checks."""

    name: str
    state: Track
    command: Track | None
    angle_unit: str
    """in the file"""
    robot: str
    """origin of the log"""
    half: Array | None = None
    """(n,) [rad] half ranges of normalised values"""
    units: Mapping[str, str] = field(default_factory=dict)
    """of `Track.more`"""
    extra: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def tracks(self) -> tuple[Track, ...]:
        """States, and commands."""
        return (self.state,) if self.command is None else (self.state, self.command)


Pending = tuple[str, Callable[[], RecordedMotion]]
"""Name of a motion, and its reader"""

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
NORMALISED_MOST = 101.0
"""LeRobot clips to -100..100 (chosen: with rounding)"""
POINTS = ("target", "true_tcp")
"""Groups of places"""
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


class Column(NamedTuple):
    """A column of a log."""

    place: int
    title: str
    group: str
    """key of `UNITS`"""
    name: str
    """joint, its number, or axis; empty: all joints"""
    unit: str | None
    """in the title"""
    scale: float = 1.0
    offset: float = 0.0
    """in the column's unit"""


def read_motion(
    name: str,
    frames: Sequence[ColumnFrame],
    arm: Arm,
    options: ImportOptions,
    *,
    source: Path,
    kind: str,
    notes: Sequence[str] = (),
    extra: Mapping[str, str] | None = None,
) -> RecordedMotion:
    """Make a motion of columns on one clock, or of states and commands on their own.

    ``source`` and ``kind`` are its file and format. FileError for missing or double columns, or no unit; InputError for
    a wrong map.
    """
    tables = [_ForeignTable(frame, arm, options) for frame in frames]
    first = frames[0]
    for ours, theirs in (options.columns or {}).items():
        if not any(ours in table.mapped for table in tables):
            raise FileError(
                first.path,
                f"--map {ours}={theirs}: no such column; found {first.found}: {shown(first.titles)}",
                "name one of these",
            )
    state, command = (next((table for table in tables if table.of(group)), None) for group in ("position", "command"))
    if state is None:
        titles = ", ".join(shown(frame.titles) for frame in frames)
        raise FileError(
            first.path,
            f"no column with joint positions; found {first.found}: {titles}",
            "name them position.JOINT and command.JOINT, or map yours: --map JOINT=THEIRS; a time, position.JOINT and "
            "command.JOINT are expected",
        )
    half = None
    if options.angle_unit == "normalised" and options.calibration is not None:
        half = half_ranges(options.calibration, arm, options)
    elif options.angle_unit == "normalised":
        counts = calibrated_ranges(state.values("position")[0], arm, first.path)
        half = counts * np.pi / COUNTS_PER_TURN
        told = ", ".join(f"{joint} {count:.0f}" for joint, count in zip(arm.joint_names, counts, strict=True))
        state.notes.append(
            f"without a calibration the ranges follow from the steps of the encoders ({told} counts); "
            "the middle of each range is unknown and taken as zero: offsets, sag and places of the tool are not known"
        )
    return RecordedMotion(
        name=name,
        state=state.track("position", half),
        command=None if command is None else command.track("command", half),
        angle_unit="/".join(sorted(state.units)),
        half=half,
        units=state.measured_units,
        robot=f"{kind}:{source.stem}",
        extra={"source": source.name, "format": kind, **(extra or {})},
        notes=(*notes, *(note for table in tables for note in table.notes)),
    )


def holds_positions(titles: Sequence[str], options: ImportOptions) -> bool:
    """Whether titles, or the user's map, are a log's."""
    mapped = {
        part
        for text in (options.columns or {}).values()
        for part in (Linear.of(text, titles).column, *text.split(".."))
    }
    return bool(mapped & {*titles}) or any(
        found[1] in ("position", "command") and ("." in title or not found[2] or found[2][-1].isdigit())
        for title in titles
        if (found := _classified(title))
    )


class _ForeignTable:
    """Columns of a frame with a meaning."""

    def __init__(self, frame: ColumnFrame, arm: Arm, options: ImportOptions) -> None:
        self.frame, self.arm, self.options = frame, arm, options
        self.notes: list[str] = []
        self.units: set[str] = set()
        self.measured_units: dict[str, str] = {}
        classified = {i: found for i, title in enumerate(frame.titles) if (found := _classified(title))}
        self.recorder = next((_RECORDERS[one[0]] for one in classified.values() if one[0] in _RECORDERS), None)
        self.columns = {
            i: Column(i, frame.titles[i], group, name, unit) for i, (_, group, name, unit) in classified.items()
        }
        mapped = [(ours, column) for pair in (options.columns or {}).items() for ours, column in self._mapped(*pair)]
        self.mapped = {ours for ours, _ in mapped}
        if len({column.place for _, column in mapped}) < len(mapped):
            raise InputError("--map takes a column twice")
        self.columns |= {column.place: column for _, column in mapped}
        titles = [column.title for column in self.columns.values()]
        if twice := sorted({title for title in titles if title and frame.titles.count(title) > 1}):
            raise FileError(frame.path, f"line 1: column {', '.join(twice)} stands there twice", "rename one")
        ignored = [title or "(no name)" for i, title in enumerate(frame.titles) if i not in self.columns]
        self.notes += [f"columns ignored: {shown(ignored)}"] * bool(ignored)

    def of(self, group: str) -> list[Column]:
        return [column for column in self.columns.values() if column.group == group]

    def _mapped(self, ours: str, theirs: str) -> list[tuple[str, Column]]:
        """Columns that ``theirs`` names: one, a range, or all of a joint."""
        titles, joint, own = self.frame.titles, joint_of(ours, self.arm), _classified(ours)
        if joint is None and own is None:
            raise InputError(
                f"--map {ours}={theirs}: {ours} is nothing that a log has: time, JOINT, command.JOINT, torque.JOINT, "
                f"target.x or true_tcp.x; the joints are {', '.join(self.arm.joint_names)}"
            )
        first, dots, last = theirs.partition("..")
        names: list[str] = []
        linear = Linear(column=theirs)
        if dots and first in titles and last in titles:
            chosen = list(range(titles.index(first), titles.index(last) + 1))
            names = list(self.arm.joint_names)
            if joint is not None or len(chosen) != len(names):
                raise InputError(f"--map {ours}={theirs}: {len(chosen)} columns for {len(names)} joints")
        else:
            linear = Linear.of(theirs, {*titles, *(column.name for column in self.columns.values())})
            chosen = [titles.index(linear.column)] if linear.column in titles else []
            if joint is not None and not chosen:
                chosen = [i for i, column in self.columns.items() if column.name == linear.column]
        found = []
        for place, i in enumerate(chosen):
            before = self.columns.get(i)
            said = (before and before.unit) or split_unit(titles[i], TIME_UNITS | ANGLES | LENGTHS)[1]
            scale, offset = linear.scale, linear.offset
            if joint is not None:
                group, name, unit = before.group if before else "position", joint, split_unit(ours, ANGLES)[1]
                if group not in ("position", "command"):  # the gear's torque, the motor's current, and what has no gear
                    scale = {"torque": 1.0 / scale, "current": np.sign(scale)}.get(group, 1.0)
                    offset, unit = 0.0, None
            elif own is not None:
                group, name, unit = own[1], names[place] if names else own[2], own[3]
            found.append((ours, Column(i, titles[i], group, name, unit or said, scale, offset)))
        return found

    def _unit(self, column: Column, default: str | None) -> str:
        options = {
            "time": ("--time-unit", self.options.time_unit),
            "position": ("--angle-unit", self.options.angle_unit),
        }
        option, declared = options.get("position" if column.group == "command" else column.group, ("", None))
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
                self.frame.path,
                f"column {column.title} does not say its unit",
                f"rename it {endings}{option and f' or set {option}'}",
            )
        return str(unit)

    def _read(self, columns: Sequence[Column]) -> Array:
        """Columns (T, k) in file units, mapped."""
        scale, offset = (np.array([getattr(column, key) for column in columns]) for key in ("scale", "offset"))
        return self.frame.values([column.place for column in columns]) * scale + offset

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
        unit = self._unit(times[0], self.recorder and self.recorder[1])
        return self._read(times)[:, 0] / TIME_UNITS[unit]

    def values(self, group: str) -> tuple[Array, list[Column]]:
        """Return a group (T, n) in the arm's order and file units, and its columns."""
        columns = self.of(group)
        if len(columns) == 1 and not columns[0].name and (self.arm.joints == 1 or group in ("gain", "powered")):
            columns = columns * self.arm.joints
        else:
            names, titles = [column.name for column in columns], [column.title for column in columns]
            match = match_joints(names, self.arm, self.frame.path, group, titles=titles)
            columns = [columns[i] for i in match.columns]
            if match.dropped and group in ("position", "command"):
                self.notes.append(f"{group}: names that are no joints dropped: {shown(match.dropped)}")
            if match.numbered:
                told = f"{columns[0].title} to {columns[-1].title} taken as the joints from the base on"
                self.notes.append(f"{group}: {told}")
        return self._read(columns), columns

    def track(self, group: str, half: Array | None) -> Track:
        """States with all measurements, or commands, in radians.

        LeRobot's normalised -100 and 100 are ``half`` (n,) [rad] from the middle of the calibrated range
        (``MotorsBus._normalize`` in huggingface/lerobot).
        """
        raw, columns = self.values(group)
        units = [self._unit(column, self.recorder[0] if self.recorder else self.frame.angle_unit) for column in columns]
        self.units |= {*units}
        factor = np.array([ANGLES.get(unit, 1.0 if half is None else half[i] / 100.0) for i, unit in enumerate(units)])
        if half is not None and (np.abs(raw) > NORMALISED_MOST).any():
            worst = float(raw.flat[int(np.nanargmax(np.abs(raw)))])
            said = f"{worst:g} is no normalised value, which lie in -100..100"
            raise FileError(self.frame.path, said, "set another --angle-unit")
        return Track(
            path=self.frame.path,
            what="state" if group == "position" else "command",
            time=self.time(),
            value=raw * factor,
            columns=tuple(column.title for column in columns),
            place=self.frame.place,
            number=self.frame.number,
            more=self._measured() if group == "position" else {},
        )

    def _measured(self) -> dict[str, Array]:
        found = {group: self._points(group) for group in POINTS if self.of(group)}
        for group in ("torque", "current", "gain", "powered"):
            if not self.of(group):
                continue
            try:
                raw, columns = self.values(group)
            except FileError as error:
                self.notes.append(f"{group} left out: {error.problem}")
                continue
            if group == "powered":
                found["gain"] = np.where(raw > 0, found.get("gain", np.nan), 0.0)
                continue
            known = next(iter(UNITS[group]), None) if self.recorder else None
            units = {column.unit or known for column in columns}
            unit = units.pop() if len(units) == 1 else None
            found[group] = raw * UNITS[group].get(unit or "", 1.0)
            self.measured_units[group] = SI[group] if unit in UNITS[group] else ""
            if group in SI and unit is None:
                self.notes.append(f"{group}: {columns[0].title} says no unit; kept in the unit of the column")
        return found

    def _points(self, group: str) -> Array:
        """Places (T, 3) [m] of the tool."""
        axes = sorted(self.of(group), key=lambda column: column.name)
        if [column.name for column in axes] != [*AXES]:
            raise FileError(
                self.frame.path, f"columns of {group} are not x, y and z, once each", "name all three or none"
            )
        return self._read(axes) * np.array([LENGTHS[self._unit(column, None)] for column in axes])


def _classified(title: str) -> tuple[str, str, str, str | None] | None:
    """Prefix, group, joint or axis, and unit of a title; None: another title."""
    stem, unit = split_unit(title, TIME_UNITS)
    if stem.casefold() in _TIMES:
        return stem.casefold(), "time", "", unit
    for prefix in _ORDER:
        if not title.casefold().startswith(prefix):
            continue
        group = _PREFIXES[prefix]
        spelled = {unit.casefold(): unit for unit in UNITS[group]} | {unit: unit for unit in UNITS[group]}
        rest, unit = split_unit(f"x{title[len(prefix) :]}", spelled)
        found = _JOINT.fullmatch(rest[1:])
        name = "" if found is None else found["number"] or found["name"] or ""
        if found is not None and (group not in POINTS or name in AXES):
            return prefix, group, name, spelled.get(unit or "")
    return None
