"""The servos' position loop, also as options of an address: ``?p=48&i=4``.

An STS3215 gives P / 4 per mille of duty per count of error beyond its dead zone, plus its startup force.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np

from rejoint.control.servogains import HEAVIEST, HOTTEST, Rung, ServoGains
from rejoint.robots.family import SerialAddress, TcpAddress, serial_address, tcp_address
from rejoint.system.errors import RobotError
from rejoint.system.stopping import ending, shielded


class Knob(NamedTuple):
    """An adjustable gain."""

    names: tuple[str, ...]
    """`REGISTERS` that it sets"""
    low: int
    high: int
    stride: int
    """largest change at once: limits the arm's jump"""


KNOBS: dict[str, Knob] = {
    "p": Knob(("p",), 8, 64, 4),
    "i": Knob(("i",), 0, 8, 1),
    "d": Knob(("d",), 16, 64, 8),
    "dead": Knob(("dead_cw", "dead_ccw"), 0, 16, 1),
    "startup": Knob(("startup",), 8, 48, 4),
}
"""Gains and tried limits (chosen: beyond, servos shake)"""
LIMIT, LIMITED = "limit", 50
"""Limit of the I part, and its value: 20 % of PWM (chosen: beyond friction)"""
REGISTERS = {LIMIT: 25, "p": 21, "d": 22, "i": 23, "startup": 24, "dead_cw": 26, "dead_ccw": 27}
"""Addresses, one byte each"""
FIRST, SIZE = 21, 7
"""Block of these registers"""
_STRIDES = {name: knob.stride for knob in KNOBS.values() for name in knob.names} | {LIMIT: LIMITED}
PAUSE = 0.05
"""[s] between steps (chosen: longer than a servo rings)"""
RUNGS = (
    Rung(("p",), (8, 16, 24, 32, 40, 48, 56, 64)),
    Rung(("dead_cw", "dead_ccw"), (0,), rising=False),
    Rung(("startup",), (16, 24, 32)),
    Rung(("i",), (1, 2, 4, 8), beside=((LIMIT, LIMITED),)),
)
"""Search order (chosen: within `KNOBS`)"""

Gains = Mapping[str, int]
Values = dict[str, tuple[int, ...]]
"""One per joint, by name"""


def read_gains(given: Mapping[str, str]) -> Gains:
    """Read gains from address options; ValueError."""
    found = {}
    for name, text in given.items():
        knob = KNOBS[name]
        if not (text.isascii() and text.isdecimal() and knob.low <= int(text) <= knob.high):
            raise ValueError(f"expected {name}=N with N from {knob.low} to {knob.high}, got {text!r}")
        found[name] = int(text)
    return found


def way(before: int, wanted: int, stride: int) -> list[int]:
    """Values to write, from ``before`` to ``wanted``."""
    step = stride if wanted > before else -stride
    return [*range(before + step, wanted, step), wanted] if wanted != before else []


def read_block(blocks: Sequence[bytes]) -> Values:
    """Gains in blocks of `SIZE` registers from `FIRST`."""
    return {name: tuple(block[cell - FIRST] for block in blocks) for name, cell in REGISTERS.items()}


def for_all(gains: Gains, joints: int) -> Values:
    """Equal gains for all ``joints``, with the I part's limit."""
    found = {name: (value,) * joints for knob, value in gains.items() for name in KNOBS[knob].names}
    return {LIMIT: (LIMITED,) * joints, **found} if gains.get("i") else found


def stiffer(name: str, before: int, now: int) -> bool:
    """Whether a servo pushes harder with the gain ``now``."""
    return now < before if name in KNOBS["dead"].names else now > before


def steps(before: Mapping[str, tuple[int, ...]], wanted: Mapping[str, tuple[int, ...]]) -> list[dict[str, list[int]]]:
    """Values to write in small steps, by name, one per joint; the I part's limit is raised first and lowered last."""
    ways = [(name, before[name], wanted[name]) for name in REGISTERS if name in wanted and name != LIMIT]
    if LIMIT in wanted:
        most = tuple(map(max, before[LIMIT], wanted[LIMIT]))
        ways = [(LIMIT, before[LIMIT], most), *ways, (LIMIT, most, wanted[LIMIT])]
    found = []
    for name, here, there in ways:
        each = [[old, *way(old, new, _STRIDES[name])] for old, new in zip(here, there, strict=True)]
        longest = max(map(len, each))
        found += [{name: [one[min(k, len(one) - 1)] for one in each]} for k in range(1, longest)]
    return found


FULL = 1000.0
"""Duty of full PWM"""


class DutyLaw(NamedTuple):
    """Duty settings of one servo."""

    p: int
    startup: int
    above: int
    """[counts] dead zone for positive errors"""
    below: int
    """[counts] for negative errors"""

    def share(self, duty: int, error: int = 0) -> float:
        """Share of the largest torque, -1 to 1, of ``duty`` [0.1 %] at ``error`` [counts]."""
        size: float = abs(duty) - self.startup
        if size <= 0:
            return min(max(error, -self.below), self.above) * self.p / 4 / FULL
        size += (self.above if duty > 0 else self.below) * self.p / 4
        return min(size / FULL, 1.0) if duty > 0 else max(-size / FULL, -1.0)


LOCK, LOAD, HEAT = 55, 60, 63
"""Register addresses"""
_NEGATIVE = 1 << 10  # sign of a load

Read = Callable[[int, int, int, float | None], bytes]
"""Reads registers: ID, address, size, deadline [s]"""
Write = Callable[[int, int, Sequence[int], float | None], object]


class Tuning:
    """Registers of servos; ``wanted`` holds on every connection."""

    def __init__(
        self,
        ids: Sequence[int],
        wanted: Values,
        *,
        read: Read,
        write: Write,
        call: Callable[[int], str],
        wait: Callable[[float], object],
    ) -> None:
        """Callbacks: registers, a servo's name, and waiting."""
        self.values: Values = {}
        """in force, by `REGISTERS`"""
        self.laws: list[DutyLaw] = []
        """of these values, per servo"""
        self._ids, self._wanted = ids, wanted
        self._read, self._write, self._call, self._wait = read, write, call, wait

    def prepare(self, until: float | None) -> None:
        """Read the gains, and set the wanted ones."""
        self._look_up(until)
        self._walk(self._wanted, until, hottest=HOTTEST)

    def tune(self, gains: ServoGains) -> None:
        """Set gains, also on later connections."""
        self._walk(gains, None)
        self._wanted = {name: tuple(values) for name, values in gains.items()}

    def keep(self, gains: ServoGains) -> None:
        """Save gains; each lock is open meanwhile."""
        self.tune(gains)
        for index, servo in enumerate(self._ids):
            try:
                self._write(servo, LOCK, [0], None)
                for name, values in gains.items():
                    self._write(servo, REGISTERS[name], [values[index]], None)
            finally:
                with shielded():
                    self._write(servo, LOCK, [1], None)
            if self._read(servo, LOCK, 1, None) != b"\1":
                raise RobotError(f"the lock of {self._call(servo)} stays open; switch the arm's power off and on")
        self._look_up(None)
        if any(self.values[name] != tuple(values) for name, values in gains.items()):
            raise RobotError(f"the servos have not taken the gains; they are {self.values}")

    def _blocks(self, until: float | None) -> list[bytes]:
        return [self._read(servo, FIRST, SIZE, until) for servo in self._ids]

    def _look_up(self, until: float | None) -> None:
        blocks = self._blocks(until)
        self.values = read_block(blocks)
        self.laws = [DutyLaw(p=data[0], startup=data[3], above=data[5], below=data[6]) for data in blocks]

    def _walk(self, wanted: ServoGains, until: float | None, *, hottest: float = np.inf) -> None:
        before = self.values
        strange = [name for name in wanted if name not in before or len(wanted[name]) != len(self._ids)]
        if strange:
            known = f"{', '.join(before)} of {len(self._ids)} joints"
            raise RobotError(f"expected gains {known}, got {', '.join(strange)}")
        there = read_block(self._blocks(until))
        for step in steps(there, wanted):  # a walk that a lost connection cut short goes on
            self._take(step, until)
            problem = "" if ending() else self._problem(step, there, until, hottest)
            if problem:
                for back in steps(read_block(self._blocks(until)), before):
                    self._take(back, until)
                raise RobotError(f"{problem}; the gains are as before")
        self._look_up(until)

    def _take(self, step: Mapping[str, Sequence[int]], until: float | None) -> None:
        for name, values in step.items():
            for servo, value in zip(self._ids, values, strict=True):
                self._write(servo, REGISTERS[name], [value], until)
        self._wait(PAUSE)

    def _problem(self, step: Mapping[str, Sequence[int]], there: Values, until: float | None, hottest: float) -> str:
        ((name, values),) = step.items()
        for servo, old, value in zip(self._ids, there[name], values, strict=True):
            if not stiffer(name, old, value):  # else one that labours could not be relieved
                continue
            low, high, _, heat = self._read(servo, LOAD, 4, until)
            load = ((low | high << 8) & ~_NEGATIVE) / FULL
            if load > HEAVIEST or heat > hottest:
                return f"{self._call(servo)} does not bear {name}={value}: load {100 * load:.0f} %, {heat} deg C"
        return ""


FORM = "feetech:///dev/DEVICE or feetech://HOST:PORT"
_PORT = 9000
# [1/s] of a servo as sold
_BAUD = 1_000_000
_OPTIONS = ("baud", "calibration", "zero", *KNOBS)


@dataclass(frozen=True, kw_only=True)
class FeetechAddress:
    """A bus, and what is known of its arm."""

    wire: TcpAddress | SerialAddress
    calibration: Path | None = None
    """LeRobot's; None: the servos' own limits"""
    zero: tuple[float, ...] = ()
    """[deg] of each joint in mid-range; empty: zero"""
    gains: Gains = field(default_factory=dict)
    """by `rejoint.robots.feetech.gains.KNOBS`; empty: unchanged"""

    def __str__(self) -> str:
        return str(self.wire)

    @property
    def spot(self) -> str:
        """Equal for all its addresses."""
        return self.wire.spot


def feetech_address(text: str) -> FeetechAddress:
    """Read ``feetech:///dev/DEVICE`` or ``feetech://HOST:PORT``, with options; ValueError."""
    plain, _, query = text.partition("?")
    options = parse_qs(query, strict_parsing=True, keep_blank_values=True) if query else {}
    unknown = set(options) - set(_OPTIONS)
    if unknown or any(len(values) > 1 or not values[0] for values in options.values()):
        raise ValueError(f"expected each of {', '.join(_OPTIONS)} once at most, got {query!r}")
    given = {name: values[0] for name, values in options.items()}
    wire: TcpAddress | SerialAddress
    if not urlsplit(plain).netloc:
        wire = serial_address(f"{plain}?baud={given.get('baud', _BAUD)}", baud=_BAUD)
    elif "baud" in given:
        raise ValueError("the baud rate is that of the other machine; leave it out")
    else:
        wire = tcp_address(plain, port=_PORT)
    return FeetechAddress(
        wire=replace(wire, text=text),
        zero=_degrees(given.get("zero")),
        calibration=Path(given["calibration"]).expanduser() if "calibration" in given else None,
        gains=read_gains({name: given[name] for name in KNOBS if name in given}),
    )


def _degrees(text: str | None) -> tuple[float, ...]:
    if text is None:
        return ()
    try:
        found = tuple(float(word) for word in text.split(","))
    except ValueError:
        found = ()
    if not found or not all(-180.0 <= angle <= 180.0 for angle in found):
        raise ValueError(f"expected zero=DEG,DEG,... from -180 to 180, one per joint, got {text!r}")
    return found
