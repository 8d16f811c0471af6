"""What the columns of a file mean; units are never guessed.

The words of a title mean group, joint and unit: ``position.elbow_deg``, ``act_m0``, ``tau_measured_2``.
`ImportOptions.columns` maps others: ``time_ms=t``, ``target.x_mm=gx``. ``joint1=m0/6.33-0.184`` holds for all columns
of a joint (torque is divided by the scale, current takes its sign). ``command=27..32`` names all joints.

Readings in radians or degrees step alike on every joint; LeRobot's normalised values step by 200 over the counts of a
joint's range. Thresholds are chosen.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.logs.joints import (
    COUNTS_PER_TURN,
    NAMES,
    TIME_UNITS,
    ImportOptions,
    half_ranges,
    joint_in,
    match_joints,
    ordered,
    read_linear,
)
from rejoint.logs.runlog import AXES
from rejoint.system.errors import FileError, InputError
from rejoint.system.records import entity, taken
from rejoint.system.textfile import ANGLES, LENGTHS, shown, split_unit

FEWEST_VALUES = 20
"""Different readings for a step"""
FEWEST_STEPS = 10
"""Steps spanned by readings"""
ON, OFF = 0.9, 0.6
"""on a grid, and off it (1: all readings)"""
BITS = np.arange(10, 22)
"""of encoders"""
SPANS = np.arange(1000, 4097)
"""[counts] of calibrated ranges"""
ROUND = np.array([0.05, 0.1, 0.2, 0.25, 0.5, 1.0])
"""Steps of rounded values"""


def grid_shares(values: Array, steps: Array) -> Array:
    """Shares (k,) of ``values`` (T,) on multiples of each of ``steps`` (k,); 0: few steps."""
    shares = np.abs(np.mean(np.exp(2j * np.pi * values[:, None] / steps), axis=0))
    return np.where(np.ptp(values) >= FEWEST_STEPS * steps, shares, 0.0)


def readings(values: Array, decimals: int) -> list[Array]:
    """Different readings of the joints (T, n) that have enough."""
    return [one for joint in values.T if len(one := np.unique(np.round(joint, decimals))) >= FEWEST_VALUES]


def turn_bits(values: Array) -> int | None:
    """Return encoder bits of readings (T, n) [rad], or None."""
    shares = [grid_shares(one, 2 * np.pi / 2**BITS) for one in readings(values, 12)]
    fitting = BITS[np.median(shares, axis=0) > ON].tolist() if shares else []
    return fitting[0] if fitting else None


def unit_by_steps(raw: Array) -> tuple[str | None, str]:
    """Tell the unit of LeRobot's readings (T, n) by their steps, and why.

    LeRobot counts 4095 per turn, others 4096.
    """
    turn = 360.0 / (COUNTS_PER_TURN - np.arange(2))
    joints = [(grid_shares(values, turn).max(), _normalised_step(values)) for values in readings(raw, 4)]
    degrees = sum(share > ON for share, _ in joints)
    steps = [f"{step:.4f}" for share, step in joints if step and share < OFF]
    if degrees > len(joints) / 2:
        return "deg", f"they come in steps of {turn[0]:.4f} on {degrees} joints, those of an encoder"
    if len(steps) > len(joints) / 2 and len({*steps}) > 1:  # joints differ in their ranges
        return "normalised", f"they come in steps of {', '.join(steps)}, no degrees do"
    return None, ""


def _normalised_step(values: Array) -> float | None:
    """Step of normalised values; None for others, and for round numbers."""
    steps = 200.0 / SPANS
    shares = grid_shares(values[:: max(len(values) // 300, 1)], steps)
    rounded = grid_shares(values, ROUND).max() > ON
    return float(steps[np.argmax(shares)]) if shares.max() > ON and not rounded else None


STILL = 1.0
"""Range of a joint that stands, of 200; chosen: some encoder steps"""


def calibrated_ranges(raw: Array, arm: Arm, path: Path) -> Array:
    """Calibrated range (n,) [counts] of joints by normalised readings (T, n), of `STILL` ones the usual; FileError."""
    counts = []
    for joint, name, usual in zip(raw.T, arm.joint_names, np.ptp([arm.lower, arm.upper], axis=0), strict=True):
        step = next((_normalised_step(one) for one in readings(joint[:, None], 4)), None)
        if np.ptp(joint) < STILL:
            step = 200.0 * 2 * np.pi / (usual * COUNTS_PER_TURN)
        if step is None:
            raise FileError(
                path,
                f"the readings of {name} do not show the steps of its encoder: its range is not known",
                "give --calibration, or a recording in which it moves more",
            )
        counts.append(200.0 / step)
    return np.array(counts)


FEWEST = 2
"""Rows of a log"""
LATE = 10
"""Rows by which one may be late (chosen)"""
PAUSE = 1.0
"""[s] between motions (chosen: ten times a hobby servo's lag)"""


def sort_keys(time: Array) -> Array:
    """Keys (T,) that sort rows a little late."""
    latest = np.fmax.accumulate(time)
    moved = np.argsort(np.fmin(latest, time), kind="stable") - np.arange(len(time))
    return latest if np.abs(moved).max(initial=0) > LATE else np.fmin(latest, time)


@entity
class FileMotion:
    """A motion, T rows, and where it is from."""

    name: str
    path: Path
    number: NDArray[np.int64]
    """(T,) place in the file"""
    place: str = "row"
    """``line``, ``message`` or ``row``"""
    extra: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()


@entity
class RawMotion(FileMotion):
    """A motion as it is in a file: columns on one clock."""

    titles: tuple[str, ...]
    values: Callable[[Sequence[int]], Array]
    """reads columns (T, k) in file units"""
    time: Array | None = None
    """(T,) [s]; None: in a column"""
    angle_unit: str | None = None
    """default of angles"""
    time_unit: str | None = None
    """the same of times"""
    found: str = "a table"
    """kind of the file"""

    @classmethod
    def of(cls, name: str, path: Path, columns: Mapping[str, Array], **about: Any) -> RawMotion:  # noqa: ANN401
        """Make a motion of columns (T,) in memory; ``about``: its other fields."""
        table = np.array([*columns.values()]).T
        about = {"number": np.arange(1, len(table) + 1)} | about
        return cls(name=name, path=path, titles=tuple(columns), values=lambda chosen: table[:, chosen], **about)

    def with_commands(self, sent: RawMotion) -> RawMotion:
        """Add rows of what was ``sent``, on a clock of its own; FileError."""
        time, times = np.asarray(self.time), np.asarray(sent.time)
        if not (len(time) and len(times)):
            raise FileError(
                self.path, f"{len(time)} states and {len(times)} commands, expected both", "record it again"
            )
        keys = sort_keys(times)
        if (late := keys != times).any():
            said = f"command, {sent.place} {sent.number[late][0]}: the clock goes back, or is no number"
            raise FileError(sent.path, said, "cut the file there")
        common = min(time[-1], times[-1]) - max(time[0], times[0])
        if common < 0.5 * min(np.ptp(time), np.ptp(times)):
            raise FileError(
                self.path,
                f"states last from {time[0]:.6f} to {time[-1]:.6f} s, commands from {times[0]:.6f} to "
                f"{times[-1]:.6f} s: not one clock",
                "record both on one clock, or take the times of recording (--stamp log) of a bag",
            )
        order = np.argsort(np.concatenate([keys, sort_keys(time)]), kind="stable")
        parts = [one.values([*range(len(one.titles))]) for one in (sent, self)]
        table = np.full((len(order), sum(part.shape[1] for part in parts)), np.nan)
        table[: len(times), : len(sent.titles)], table[len(times) :, len(sent.titles) :] = parts
        table = table[order]
        return replace(
            self,
            titles=(*sent.titles, *self.titles),
            values=lambda chosen: table[:, chosen],
            time=np.concatenate([times, time])[order],
            number=np.concatenate([sent.number, self.number])[order],
        )


@entity
class RecordedMotion(FileMotion):
    """A motion of an arm before the checks; row k holds state k and the command in force."""

    time: Array
    """(T,) [s]"""
    position: Array
    """(T, n) [rad] in the arm's order"""
    command: Array | None
    """(T, n) [rad]"""
    columns: tuple[str, ...]
    """(n,) names of the positions in the file"""
    angle_unit: str
    """in the file"""
    half: Array | None
    """(n,) [rad] half ranges of normalised values"""
    more: Mapping[str, Array]
    """other data with T rows, as fields of `RunLog`"""
    units: Mapping[str, str]
    """of `more`"""

    def __len__(self) -> int:
        return len(self.time)

    def where(self, row: int) -> str:
        """Place of a row in the file: ``line 17``."""
        return f"{self.place} {self.number[row]}"

    @property
    def angles(self) -> dict[str, Array]:
        """States, and commands if there are any, (T, n) [rad]."""
        state = {"state": self.position}
        return state if self.command is None else state | {"command": self.command}

    def take(self, rows: NDArray[Any]) -> RecordedMotion:
        """Return rows by a mask (T,) or by indices."""
        names = ("number", "time", "position", *["command"] * (self.command is not None))
        return replace(taken(self, names, rows), more={name: one[rows] for name, one in self.more.items()})


UNITS: dict[str, dict[str, float]] = {
    "time": TIME_UNITS,
    "position": ANGLES,
    "command": ANGLES,
    "target": LENGTHS,
    "true_tcp": LENGTHS,
    "torque": {"Nm": 1.0, "mNm": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
    "gain": {},
    "powered": {},
}
"""SI units per unit of each group; of times, units per second"""
SI = {"torque": "N m", "current": "A"}
ZEROS = "zeros"
"""Key in ``extra``: why the zeros of the joints are not known"""
_MIDDLES = (
    "the middle of each joint's range is unknown and taken as zero: offsets, sag and places of the tool are not known, "
    "millimetres at the tool are rough"
)
NORMALISED_MOST = 101.0
"""LeRobot clips to -100..100 (chosen: with rounding)"""
MOTION = ("position", "command")
"""Groups of angles"""
POINTS = ("target", "true_tcp")
"""Groups of places"""
_WORDS, _RECORDERS = NAMES["words"], NAMES["recorders"]
"""Words of titles by their meaning; units of groups that recorders imply"""
_SPOKEN = NAMES["units"]
"""Units by their words"""
_KNOWN = {*_SPOKEN, *(word for key, words in _WORDS.items() if key != "motor" for word in words)}
_RANKED = ("asked", "read", "position", *SI)
_RANKS = {word: rank for rank, word in enumerate(word for key in _RANKED for word in _WORDS[key])}
"""Of words; the first ones are preferred"""
_LAST = len(_RANKS)
"""Rank of titles that name a joint alone"""
_EVERY = re.compile(rf"\bJOINT(_({'|'.join(unit for known in UNITS.values() for unit in known if unit.isalpha())}))?$")
"""A meaning that stands for every joint"""
# CamelCase holds several words, and libfranka's q_d is one
_WORD = re.compile(r"(?i:q_d)(?![^\W\d_])|[A-Z]+(?![a-z])|[A-Z]?[^\WA-Z\d_]+|\d+")
_POINT = re.compile(rf"({'|'.join(POINTS)})[. _]([xyz])")


class Column(NamedTuple):
    """A column of a log."""

    place: int
    title: str
    group: str = "position"
    """key of `UNITS`"""
    name: str = ""
    """joint, its number, or axis; empty: all joints"""
    unit: str | None = None
    """in the title"""
    rank: tuple[int, ...] = (0, _LAST)
    """of its words, unknown and weak ones first; lower ones are preferred"""
    scale: float = 1.0
    offset: float = 0.0
    """in the column's unit"""


def read_motion(motion: RawMotion, arm: Arm, options: ImportOptions, *, source: Path, kind: str) -> RecordedMotion:
    """Read the joints of ``arm`` from columns.

    ``source`` and ``kind`` are its file and format. FileError for missing or double columns, or no unit; InputError for
    a wrong map.
    """
    table = _GroupedColumns(motion, arm, options)
    half = table.half_ranges()
    position, columns, units = table.values("position", half)
    more, measured = table.measured()
    found = RecordedMotion(
        name=motion.name,
        path=motion.path,
        place=motion.place,
        number=motion.number,
        time=table.clock(),
        position=position,
        command=table.commands(half),
        columns=tuple(column.title for column in columns),
        angle_unit="/".join(sorted({*units})),
        half=half,
        more=more,
        units=measured,
        extra={"source": source.name, "format": kind, **table.extra},
    )
    return _held(replace(found.take(np.argsort(sort_keys(found.time), kind="stable")), notes=table.notes))


def _held(motion: RecordedMotion) -> RecordedMotion:
    """Rows with states, and the commands in force: each joint's until its next.

    The last one holds as long as any did.
    """
    out, notes = np.all(np.isnan(motion.position), axis=1), [*motion.notes]
    out &= not out.all()
    if lost := (out & (motion.command is None or np.isnan(motion.command).all(axis=1))).sum():
        notes.append(f"state: {lost} rows without any joint left out")
    if motion.command is not None:
        last = np.maximum.accumulate(np.where(np.isnan(motion.command), 0, np.arange(len(motion))[:, None]))
        command, latest = np.take_along_axis(motion.command, last, axis=0), last.max(axis=1)
        early = np.isnan(command).any(axis=1)
        times = motion.time[np.unique(latest[~early])]
        longest = max([PAUSE, *np.diff(times[np.isfinite(times)])]) if len(times) > 1 else np.inf
        with np.errstate(invalid="ignore"):  # of damaged times
            beyond = ~out & ((early & ~early.all()) | (motion.time - motion.time[latest] > longest))
        if beyond.any():
            notes.append(f"state: {beyond.sum()} samples before the first or after the last command left out")
        out |= beyond
        motion = replace(motion, command=command)
    return replace(motion.take(~out), notes=notes)


class _GroupedColumns:
    def __init__(self, motion: RawMotion, arm: Arm, options: ImportOptions) -> None:
        self.motion, self.arm, self.options = motion, arm, options
        self.notes, self.extra = [*motion.notes], {**motion.extra}
        named = (_classified(title, arm, i) for i, title in enumerate(motion.titles))
        found = sorted(filter(None, named), key=lambda column: column.rank, reverse=True)
        best = {(column.group, column.name): column.rank for column in found}
        self.columns = {one.place: one for one in found if one.rank == best[one.group, one.name]}
        bare = [column.place for column in self.of("position") if column.rank[-1] == _LAST]
        if len(self.of("position")) - len(bare) >= arm.joints:  # else columns are named as the joints
            self.columns = {i: one for i, one in self.columns.items() if i not in bare}
        measured = dict.fromkeys((*SI, "gain", "powered"), "")
        self.implied = {"time": motion.time_unit, **dict.fromkeys(MOTION, motion.angle_unit), **measured}
        begins = (one for title in motion.titles for one in _RECORDERS if title.casefold().startswith(one))
        self.implied |= _RECORDERS.get(next(begins, ""), {})
        mapped = [
            column
            for ours, theirs in options.columns.items()
            for one in (arm.joint_names if _EVERY.search(ours) else ("JOINT",))
            for column in self._mapped(ours.replace("JOINT", one), theirs.replace("JOINT", one))
        ]
        own = {column.place: column for column in mapped}
        if len(own) < len(mapped):
            raise InputError("--map takes a column twice")
        meant = {(one.group, one.name) for one in mapped}
        self.columns = {i: one for i, one in self.columns.items() if (one.group, one.name) not in meant} | own
        read = {one.place for one in found}  # but another column of the same means it more surely
        ignored = sorted({*range(len(motion.titles))} - {*self.columns}, key=lambda i: (i not in read, i))
        if ignored:
            self.notes.append(f"columns ignored: {shown([motion.titles[i] or '(no name)' for i in ignored])}")
        if not self.of("position"):
            raise FileError(
                motion.path,
                f"no column with joint positions; found {motion.found}: {shown(motion.titles)}",
                "name them position.JOINT and command.JOINT, or map yours: --map JOINT=THEIRS; a time, position.JOINT "
                "and command.JOINT are expected",
            )

    def of(self, group: str) -> list[Column]:
        return [column for column in self.columns.values() if column.group == group]

    def _mapped(self, ours: str, theirs: str) -> list[Column]:
        """Return the columns that ``theirs`` names, with the meaning of ``ours``."""
        titles, meaning = self.motion.titles, _classified(ours, self.arm)
        if meaning is None:
            raise InputError(
                f"--map {ours}={theirs}: {ours} is nothing that a log has: time, JOINT, command.JOINT, torque.JOINT, "
                f"target.x or true_tcp.x; the joints are {', '.join(self.arm.joint_names)}"
            )
        joint = bool(meaning.name) and (meaning.group, meaning.rank[-1]) == ("position", _LAST)  # alone: all of it
        known = {*titles, *(column.name for column in self.columns.values())}
        given, scale, offset = read_linear(theirs, known if {*theirs.split("..")} - {*titles} else {theirs})
        first, between, last = given.partition("..")
        if between and first in titles and last in titles:
            places, names = [*range(titles.index(first), titles.index(last) + 1)], self.arm.joint_names
            if joint or len(places) != len(names):
                raise InputError(f"--map {ours}={theirs}: {len(places)} columns for {len(names)} joints")
        else:
            places = [i for i, title in enumerate(titles) if title == given]
            joint = joint and not places
            if joint:
                places = [i for i, column in self.columns.items() if column.name == given]
            names = (meaning.name,) * len(places)
        if not places:
            raise FileError(
                self.motion.path,
                f"--map {ours}={theirs}: no such column; found {self.motion.found}: {shown(titles)}",
                "name one of these",
            )
        found = []
        for place, name in zip(places, names, strict=True):
            column = self.columns.get(place) or Column(place, titles[place])
            group = column.group if joint else meaning.group
            column = column._replace(unit=column.unit or split_unit(titles[place], UNITS[group])[1])
            if not joint or group in MOTION:
                column = column._replace(unit=meaning.unit or column.unit, scale=scale, offset=offset)
            else:  # the gear's torque, the motor's current, and what has no gear
                column = column._replace(scale={"torque": 1.0 / scale, "current": np.sign(scale)}.get(group, 1.0))
            found.append(column._replace(group=group, name=name))
        return found

    def _unit(self, column: Column) -> str:
        kind = "angle" if column.group in MOTION else column.group
        option, declared = f"--{kind}-unit", getattr(self.options, f"{kind}_unit", None)
        if column.unit and declared and column.unit != declared:
            raise FileError(
                self.motion.path,
                f"column {column.title} is in {column.unit} by its name, but {option} says {declared}",
                f"leave {option} out or rename the column",
            )
        unit = column.unit or declared or self.implied.get(column.group)
        if unit is None and kind == "time":  # a date of this century has one unit
            for (first,) in self._read([column])[:1]:
                unit = next((one for one, ticks in TIME_UNITS.items() if 1e9 < first / ticks < 4e9), None)
        if unit is None:
            endings = " or ".join(f"{column.title}_{unit}" for unit in UNITS[column.group])
            remedy = f"rename it {endings}" + f" or set {option}" * (kind in ("angle", "time"))
            raise FileError(self.motion.path, f"column {column.title} does not say its unit", remedy)
        return str(unit)

    def _read(self, columns: Sequence[Column]) -> Array:
        """Columns (T, k) in file units, mapped."""
        scale, offset = (np.array([getattr(column, key) for column in columns]) for key in ("scale", "offset"))
        return self.motion.values([column.place for column in columns]) * scale + offset

    def clock(self) -> Array:
        """Return times (T,) [s]."""
        times = self.of("time")
        if self.motion.time is not None:
            return self.motion.time
        if self.options.rate is not None:
            return np.arange(len(self.motion.number)) / self.options.rate
        parts = {(one.rank, one.unit) for one in times}
        if len(times) != 1 and (len(times), parts) != (2, {((_LAST,), "s"), ((_LAST,), "ns")}):
            found = " and ".join(column.title for column in times) or "none"
            raise FileError(
                self.motion.path,
                f"{found} of the columns {shown(self.motion.titles)} says the time, expected one; the "
                f"file is {self.motion.found}",
                f"name one {' or '.join(f'time_{unit}' for unit in TIME_UNITS)}, map yours (--map time_s=THEIRS), or "
                "give the rows in a second (--rate)",
            )
        return (self._read(times) / [TIME_UNITS[self._unit(one)] for one in times]).sum(axis=1)

    def _columns(self, group: str) -> list[Column]:
        """Columns of a group: the joints' in the arm's order, or x, y and z."""
        columns = self.of(group)
        names = [column.name for column in columns]
        if group in POINTS:
            if sorted(names) != [*AXES]:
                raise FileError(
                    self.motion.path, f"columns of {group} are not x, y and z, once each", "name all three or none"
                )
            return sorted(columns, key=lambda column: column.name)
        if names == [""] and (self.arm.joints == 1 or group in ("gain", "powered")):
            return columns * self.arm.joints
        titles = [column.title for column in columns]
        if all(map(str.isdecimal, names)) and 0 < len(self.options.names) < len(names):
            said = f"{group}: {len(names)} columns, and {len(self.options.names)} names in --order"
            raise FileError(self.motion.path, said, "name all, also those of no joint")
        match = match_joints(ordered(names, self.options), self.arm, self.motion.path, group, titles=titles)
        columns = [columns[i] for i in match.columns]
        if match.dropped and group in MOTION:
            self.notes.append(f"{group}: names that are no joints dropped: {shown(match.dropped)}")
        if match.numbered:
            self.notes.append(
                f"{group}: {columns[0].title} to {columns[-1].title} taken as the joints from the base on"
            )
        return columns

    def values(self, group: str, half: Array | None = None) -> tuple[Array, list[Column], list[str]]:
        """Return a group (T, n) in SI units and the arm's order, its columns and their units.

        LeRobot's normalised -100 and 100 are ``half`` (n,) [rad] from the middle of the calibrated range
        (``MotorsBus._normalize`` in huggingface/lerobot).
        """
        columns = self._columns(group)
        units, raw = [self._unit(column) for column in columns], self._read(columns)
        worst = np.max(np.abs(raw), where=np.isfinite(raw), initial=0.0)
        if half is not None and worst > NORMALISED_MOST:
            raise FileError(
                self.motion.path,
                f"{worst:g} is no normalised value, which lie in -100..100",
                "set another --angle-unit",
            )
        factors = np.array([UNITS[group].get(unit, 1.0) for unit in units]) if half is None else half / 100.0
        return raw * factors, columns, units

    def commands(self, half: Array | None) -> Array | None:
        """Return commands (T, n) [rad], if any; those of a few joints may be of something else."""
        try:
            return self.values("command", half)[0] if self.of("command") else None
        except FileError as error:
            if 2 * sum(not column.rank[0] for column in self.of("command")) > self.arm.joints:
                raise
            self.notes.append(f"command left out: {error.problem}; {error.remedy}")
            return None

    def half_ranges(self) -> Array | None:
        """Half ranges (n,) [rad] of normalised values, by the calibration, or the readings' steps."""
        if self.options.angle_unit != "normalised":
            return None
        if self.options.calibration is not None:
            return half_ranges(self.options.calibration, self.arm, self.options)
        raw = self._read(self._columns("position"))
        counts = calibrated_ranges(raw[np.isfinite(raw).all(axis=1)], self.arm, self.motion.path)
        told = ", ".join(f"{joint} {count:.0f}" for joint, count in zip(self.arm.joint_names, counts, strict=True))
        self.notes.append(
            f"without a calibration the ranges follow from the steps of the encoders, for still joints from "
            f"the arm's limits ({told} counts)"
        )
        self.extra[ZEROS] = _MIDDLES
        return counts * np.pi / COUNTS_PER_TURN

    def measured(self) -> tuple[dict[str, Array], dict[str, str]]:
        """Other measurements as fields of `RunLog`, and the units of those that have one."""
        found: dict[str, Array] = {}
        units = {}
        for group in [group for group in UNITS if group not in ("time", *MOTION) and self.of(group)]:
            try:
                values, columns, named = self.values(group)
            except FileError as error:
                self.notes.append(f"{group} left out: {error.problem}")
                continue
            if group == "powered":
                group, values = "gain", np.where(values > 0, found.get("gain", np.nan), 0.0)
            elif group in SI:
                if not np.nan_to_num(values).any():  # not measured
                    continue
                units[group] = SI[group] if all(named) else ""
                if not units[group]:
                    self.notes.append(f"{group}: {columns[0].title} says no unit; kept in the unit of the column")
            found[group] = np.where(np.isfinite(values), values, np.nan)
        return found, units


def _classified(title: str, arm: Arm, place: int = -1) -> Column | None:
    """Return the column that the words of a title mean, or None."""
    short, unit = split_unit(title, LENGTHS)
    if point := _POINT.fullmatch(short):
        return Column(place, title, point[1], point[2], unit)
    joint, start, end = joint_in(title, arm)
    beside = f"{title[:start]} {title[end:]}".rpartition("header")[2]  # of a message begins its stamp
    words = [one.casefold() for one in _WORD.findall(beside)]
    group = _group(words, joint)
    if group is None:
        return None
    short, unit = split_unit(title, UNITS[group])
    unit = unit or next((_SPOKEN[word] for word in words if _SPOKEN.get(word) in UNITS[group]), None)
    if group == "time":
        told = {*words} & {*_WORDS["time"], *_WORDS["watch"]}
        other = len({*words} & {*_WORDS["watch"], *_WORDS["clock"]})
        return Column(place, title, group, unit=unit, rank=(other if told else _LAST,))
    parts = [*_WORD.finditer(short)]
    said = [part.group().casefold() for part in parts]
    known = [word in _KNOWN for word in said]
    if not joint and False in known:
        first, last = known.index(False), len(known) - known[::-1].index(False)
        if title.startswith("/"):  # a path, which ends with the joint and its group
            first = max((i + 1 for i in range(last) if known[i]), default=0)
        joint = short[parts[first].start() : parts[last - 1].end()]
        stem = {*said[first:last]} - {*_WORDS["motor"]}
        if any(known[first:last]) or (len(stem) > 1 and joint[-1].isdecimal()):
            return None
    ranks = sorted(_RANKS[word] for word in words if word in _RANKS) or [_LAST]
    weak = [word for word in words if group != "command" and word in _WORDS["weak"]]
    strange = [word for word in words if not (word in _KNOWN or word.isdecimal())]
    return Column(place, title, group, joint, unit, (len(weak + strange), *ranks))


def _group(words: Sequence[str], joint: str) -> str | None:
    """Return the group of a title with these words beside a joint."""
    said = {*words}
    ticks = {_SPOKEN.get(word, word) for word in words} - {*_WORDS["clock"]}
    if ticks and ticks <= {*_WORDS["time"], *_WORDS["watch"], *_WORDS["stamp"], *TIME_UNITS}:
        return "time"
    if said & {*_WORDS["other"]}:
        return None
    group = next((one for one in ("powered", "position", *SI, "gain", "read", "weak") if said & {*_WORDS[one]}), "")
    angle = group in ("position", "read", "weak", "")
    if said & {*_WORDS["asked"]}:
        return "command" if angle else None
    beside = said - {*filter(str.isdecimal, said)}
    if not group and (beside - {*_WORDS["any"], *_SPOKEN} or not (beside or joint)):
        return None
    return "position" if angle else group
