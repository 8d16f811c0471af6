"""The servos' position loop, also as options of an address: ``?p=48&i=4``.

An STS3215 gives P / 4 per mille of duty per count of error beyond its dead zone, plus its startup force.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Protocol
from urllib.parse import parse_qs, urlsplit

import numpy as np

from rejoint.control.servogains import HEAVIEST, HOTTEST, Rung, ServoGains
from rejoint.robots.family import SerialAddress, TcpAddress, serial_address, tcp_address
from rejoint.system.errors import RobotError
from rejoint.system.stopping import ending


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
"""Addresses, one byte each, side by side"""
_STRIDES = {name: knob.stride for knob in KNOBS.values() for name in knob.names} | {LIMIT: LIMITED}
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


def for_all(gains: Gains, joints: int) -> Values:
    """Equal gains for all ``joints``, with the I part's limit."""
    found = {name: (value,) * joints for knob, value in gains.items() for name in KNOBS[knob].names}
    return {LIMIT: (LIMITED,) * joints, **found} if gains.get("i") else found


PAUSE = 0.05
"""[s] between steps (chosen: longer than a servo rings)"""


def steps(before: ServoGains, wanted: ServoGains) -> Iterator[dict[str, list[int]]]:
    """Yield values to write in small steps, by name, one per joint; the I part's limit rises first and falls last."""
    ways = [(name, before[name], wanted[name]) for name in before if name in wanted and name != LIMIT]
    if LIMIT in wanted:
        most = tuple(map(max, before[LIMIT], wanted[LIMIT]))
        ways = [(LIMIT, before[LIMIT], most), *ways, (LIMIT, most, wanted[LIMIT])]
    for name, here, there in ways:
        now, stride = list(here), _STRIDES[name]
        while now != list(there):
            now = [min(max(end, value - stride), value + stride) for value, end in zip(now, there, strict=True)]
            yield {name: now}


class GainMemory(Protocol):
    """Where the gains of n servos are."""

    @property
    def names(self) -> Sequence[str]:
        """(n,) names of the servos, in messages."""

    def read_gains(self) -> Values:
        """Gains in force."""

    def write_gain(self, name: str, values: Sequence[int]) -> None:
        """Set one gain of all servos."""

    def strain(self, joint: int) -> tuple[float, float]:
        """Share of the largest torque, and temperature [deg C]."""

    def wait(self, duration: float) -> None:
        """Wait [s]."""


class Tuning:
    """Gains of servos; ``wanted`` ones hold on every connection."""

    def __init__(self, memory: GainMemory, wanted: ServoGains) -> None:
        self.values: Values = {}
        """in force"""
        self._memory, self._wanted = memory, wanted

    def prepare(self) -> None:
        """Read the gains, and set the wanted ones."""
        self.look_up()
        self._walk(self._wanted, hottest=HOTTEST)

    def tune(self, gains: ServoGains) -> None:
        """Set gains, also on later connections; RobotError where a servo does not bear them."""
        self._walk(gains)
        self._wanted = {name: tuple(values) for name, values in gains.items()}

    def look_up(self) -> None:
        """Read the gains."""
        self.values = self._memory.read_gains()

    def _walk(self, wanted: ServoGains, *, hottest: float = np.inf) -> None:
        before, joints = self.values, len(self._memory.names)
        strange = [name for name in wanted if name not in before or len(wanted[name]) != joints]
        if strange:
            known = f"{', '.join(before)} of {joints} joints"
            raise RobotError(f"expected gains {known}, got {', '.join(strange)}")
        there = self._memory.read_gains()
        for step in steps(there, wanted):  # a walk that a lost connection cut short goes on
            self._take(step)
            problem = "" if ending() else self._problem(step, there, hottest)
            if problem:
                for back in steps(self._memory.read_gains(), before):
                    self._take(back)
                raise RobotError(f"{problem}; the gains are as before")
        self.look_up()

    def _take(self, step: Mapping[str, Sequence[int]]) -> None:
        for name, values in step.items():
            self._memory.write_gain(name, values)
        self._memory.wait(PAUSE)

    def _problem(self, step: Mapping[str, Sequence[int]], there: Values, hottest: float) -> str:
        ((name, values),) = step.items()
        for joint, (old, value) in enumerate(zip(there[name], values, strict=True)):
            if not (value < old if name in KNOBS["dead"].names else value > old):
                continue  # else one that labours could not be relieved
            load, heat = self._memory.strain(joint)
            if load > HEAVIEST or heat > hottest:
                servo = self._memory.names[joint]
                return f"{servo} does not bear {name}={value}: load {100 * load:.0f} %, {heat:.0f} deg C"
        return ""


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


def duty_laws(gains: ServoGains) -> list[DutyLaw]:
    """Laws (n,) of servos with these gains."""
    names = ("p", "startup", "dead_cw", "dead_ccw")
    return [DutyLaw(*values) for values in zip(*(gains[name] for name in names), strict=True)]


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
