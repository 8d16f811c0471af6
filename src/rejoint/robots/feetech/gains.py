"""The position loop of the servos themselves, as an owner may ask for it: ``?p=48&i=4``.

The address of such an arm is read here as well.

An STS3215 gives P / 4 per mille of duty for each count of error beyond its dead zone, and its startup force on top. The
load is reported in proportion to the error: less the startup force, plus what the dead zone leaves out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np

from rejoint.control.servogains import HEAVIEST, HOTTEST, Rung, ServoGains
from rejoint.robots.family import serial_address, tcp_address
from rejoint.system.errors import RobotError
from rejoint.system.stopping import ending, shielded


class Knob(NamedTuple):
    """A gain that may be asked for."""

    names: tuple[str, ...]
    """of `REGISTERS`, which it sets alike"""
    low: int
    high: int
    stride: int
    """largest change at once, so that no arm jumps by more than a fraction of its sag"""


KNOBS: dict[str, Knob] = {
    "p": Knob(("p",), 8, 64, 4),
    "i": Knob(("i",), 0, 8, 1),
    "d": Knob(("d",), 16, 64, 8),
    "dead": Knob(("dead_cw", "dead_ccw"), 0, 16, 1),
    "startup": Knob(("startup",), 8, 48, 4),
}
"""Gains and the limits within which they are tried (chosen: beyond, servos shake)"""
LIMIT, LIMITED = "limit", 50
"""Name of the limit of the I part, and its value with any I: 20 % of PWM (chosen: beyond friction)"""
REGISTERS = {LIMIT: 25, "p": 21, "d": 22, "i": 23, "startup": 24, "dead_cw": 26, "dead_ccw": 27}
"""Where each gain stands, one byte each"""
FIRST, SIZE = 21, 7
"""The registers that all of them lie in"""
_STRIDES = {name: knob.stride for knob in KNOBS.values() for name in knob.names} | {LIMIT: LIMITED}
PAUSE = 0.05
"""[s] between two steps (chosen: longer than a servo rings)"""
RUNGS = (
    Rung(("p",), (8, 16, 24, 32, 40, 48, 56, 64)),
    Rung(("dead_cw", "dead_ccw"), (0,), rising=False),
    Rung(("startup",), (16, 24, 32)),
    Rung(("i",), (1, 2, 4, 8), beside=((LIMIT, LIMITED),)),
)
"""What a search tries (chosen: within the limits of `KNOBS`)"""

Gains = Mapping[str, int]
Values = dict[str, tuple[int, ...]]
"""One of each joint, by name"""


def read_gains(given: Mapping[str, str]) -> Gains:
    """Read gains from the options of an address; ValueError for what is not within its limits."""
    found = {}
    for name, text in given.items():
        knob = KNOBS[name]
        if not (text.isascii() and text.isdecimal() and knob.low <= int(text) <= knob.high):
            raise ValueError(f"expected {name}=N with N from {knob.low} to {knob.high}, got {text!r}")
        found[name] = int(text)
    return found


def way(before: int, wanted: int, stride: int) -> list[int]:
    """Values to write one after the other, from what stands there to what is wanted."""
    step = stride if wanted > before else -stride
    return [*range(before + step, wanted, step), wanted] if wanted != before else []


def read_block(blocks: Sequence[bytes]) -> Values:
    """Return the gains that stand in `SIZE` registers from `FIRST` on, of each servo."""
    return {name: tuple(block[cell - FIRST] for block in blocks) for name, cell in REGISTERS.items()}


def for_all(gains: Gains, joints: int) -> Values:
    """Return the same gains for all ``joints``, with the limit that belongs to an I part."""
    found = {name: (value,) * joints for knob, value in gains.items() for name in KNOBS[knob].names}
    return {LIMIT: (LIMITED,) * joints, **found} if gains.get("i") else found


def stiffer(name: str, before: int, now: int) -> bool:
    """Tell whether a servo pushes harder with a gain of this name ``now`` than ``before``."""
    return now < before if name in KNOBS["dead"].names else now > before


def steps(before: Mapping[str, tuple[int, ...]], wanted: Mapping[str, tuple[int, ...]]) -> list[dict[str, list[int]]]:
    """Return what to write, one small step after the other: by name, a value of each joint.

    The limit of the I part is raised before the I part of any joint, and lowered after all.
    """
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
"""Duty of all of PWM, in the unit of the registers"""


@dataclass(frozen=True, kw_only=True)
class DutyLaw:
    """Settings of one servo, as its registers hold them."""

    p: int
    startup: int
    above: int
    """[counts] of the dead zone for positive errors"""
    below: int
    """[counts] likewise for negative ones"""

    def share(self, duty: int, error: int = 0) -> float:
        """Share of the largest torque, -1 to 1, of a ``duty`` [0.1 %] with its sign, at an ``error`` [counts]."""
        size: float = abs(duty) - self.startup
        if size <= 0:
            return min(max(error, -self.below), self.above) * self.p / 4 / FULL
        size += (self.above if duty > 0 else self.below) * self.p / 4
        return min(size / FULL, 1.0) if duty > 0 else max(-size / FULL, -1.0)


LOCK, LOAD, HEAT = 55, 60, 63
"""Addresses of registers."""
_NEGATIVE = 1 << 10  # sign of a load

Read = Callable[[int, int, int, float | None], bytes]
"""Registers of a servo: its ID, address and size, and [s] until when it is asked again"""
Write = Callable[[int, int, Sequence[int], float | None], object]


class Tuning:
    """What stands in the registers of the servos ``ids``; ``wanted`` is what is to be in force on every connection."""

    def __init__(
        self, ids: Sequence[int], wanted: Values, *, read: Read, write: Write, call: Callable[[int], str],
        wait: Callable[[float], object],
    ) -> None:  # fmt: skip
        """Take how registers are read and written, what a servo is called, and how time passes."""
        self.values: Values = {}
        """in force, by the names of `REGISTERS`"""
        self.laws: list[DutyLaw] = []
        """what a duty says of each servo's error, under these"""
        self._ids, self._wanted = ids, wanted
        self._read, self._write, self._call, self._wait = read, write, call, wait

    def prepare(self, until: float | None) -> None:
        """Read the gains, and bring them to those that are to be in force."""
        self._look_up(until)
        self._walk(self._wanted, until, hottest=HOTTEST)

    def tune(self, gains: ServoGains) -> None:
        """Bring the gains to these, also on later connections. How warm servos are is for who drives them to judge."""
        self._walk(gains, None)
        self._wanted = {name: tuple(values) for name, values in gains.items()}

    def keep(self, gains: ServoGains) -> None:
        """Bring the gains to these, and open each servo's lock for as long as it takes to save them."""
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

    def _there(self, until: float | None) -> Values:
        return read_block([self._read(servo, FIRST, SIZE, until) for servo in self._ids])

    def _look_up(self, until: float | None) -> None:
        blocks = [self._read(servo, FIRST, SIZE, until) for servo in self._ids]
        self.values = read_block(blocks)
        self.laws = [DutyLaw(p=data[0], startup=data[3], above=data[5], below=data[6]) for data in blocks]

    def _walk(self, wanted: ServoGains, until: float | None, *, hottest: float = np.inf) -> None:
        """Go there in small steps; RobotError, and all of them back, where a servo does not bear one."""
        before = self.values
        strange = [name for name in wanted if name not in before or len(wanted[name]) != len(self._ids)]
        if strange:
            known = f"{', '.join(before)} of {len(self._ids)} joints"
            raise RobotError(f"expected gains {known}, got {', '.join(strange)}")
        there = self._there(until)
        for step in steps(there, wanted):  # a walk that a lost connection cut short goes on
            self._take(step, until)
            problem = "" if ending() else self._problem(step, there, until, hottest)
            if problem:
                for back in steps(self._there(until), before):
                    self._take(back, until)
                raise RobotError(f"{problem}; the gains are as before")
        self._look_up(until)

    def _take(self, step: Mapping[str, Sequence[int]], until: float | None) -> None:
        for name, values in step.items():
            for servo, value in zip(self._ids, values, strict=True):
                self._write(servo, REGISTERS[name], [value], until)
        self._wait(PAUSE)

    def _problem(self, step: Mapping[str, Sequence[int]], there: Values, until: float | None, hottest: float) -> str:
        """Say which servo does not bear to be made stiffer than ``there``; empty where all do."""
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
    """Where a bus is, and what is known of the arm on it."""

    text: str
    """as the user wrote it"""
    port: str
    """as pyserial names it: ``/dev/ttyACM0``, ``socket://HOST:PORT``"""
    baud: int = _BAUD
    """[1/s]"""
    calibration: Path | None = None
    """LeRobot's calibration of this arm; None for the limits that its servos hold"""
    zero: tuple[float, ...] = ()
    """[deg] angle of each joint, by the arm's description, in the middle of its range; none for zero"""
    gains: Gains = field(default_factory=dict)
    """of the servos' own loop, by `rejoint.robots.feetech.gains.KNOBS`; none: as they are"""

    def __str__(self) -> str:
        return self.text

    @property
    def spot(self) -> str:
        """The one place that it means, however it is written."""
        plain = self.text.partition("?")[0]
        if self.port.startswith("/"):
            return serial_address(plain, baud=self.baud).spot
        return tcp_address(plain, port=_PORT).spot


def feetech_address(text: str) -> FeetechAddress:
    """Read ``feetech:///dev/DEVICE`` or ``feetech://HOST:PORT``, with options after a question mark.

    ValueError otherwise.
    """
    plain, _, query = text.partition("?")
    options = parse_qs(query, strict_parsing=True, keep_blank_values=True) if query else {}
    unknown = set(options) - set(_OPTIONS)
    if unknown or any(len(values) > 1 or not values[0] for values in options.values()):
        raise ValueError(f"expected each of {', '.join(_OPTIONS)} once at most, got {query!r}")
    given = {name: values[0] for name, values in options.items()}
    parts = urlsplit(plain)
    if parts.netloc:
        if "baud" in given:
            raise ValueError("the baud rate is that of the other machine; leave it out")
        server = tcp_address(plain, port=_PORT)
        port = f"socket://{server.host}:{server.port}"
    elif parts.path.startswith("/") and parts.path != "/":
        port = parts.path
    else:
        raise ValueError(f"not of the form {FORM}")
    baud = given.get("baud", str(_BAUD))
    if not (baud.isascii() and baud.isdecimal() and int(baud) > 0):
        raise ValueError(f"the baud rate must be a positive whole number, got {baud!r}")
    return FeetechAddress(
        text=text, port=port, baud=int(baud), zero=_degrees(given.get("zero")),
        calibration=Path(given["calibration"]).expanduser() if "calibration" in given else None,
        gains=read_gains({name: given[name] for name in KNOBS if name in given}),
    )  # fmt: skip


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
