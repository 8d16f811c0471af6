"""What can go wrong with an emulated arm, and how one asks for it: ``drop=0.05,stall=1.5/4,freeze=3@5,die@20``.

Times T count in seconds from the first byte that a client sends, and joints J from 1. Which of the answers are
hit is drawn with the seed, for every fault in a stream of its own: the same ones, whatever else is switched on.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import NamedTuple

from rejoint.system.errors import InputError

HOT_JOINT = 2
"""The joint that gets hot if none is named: the shoulder, which carries most (chosen)"""


@dataclass(frozen=True, kw_only=True)
class Stall:
    """Spans in which the link stands still."""

    duration: float
    """[s]"""
    every: float
    """[s] from the beginning of one to that of the next; the first begins after this time"""


@dataclass(frozen=True, kw_only=True)
class Absence:
    """A span in which there is no link."""

    after: float
    """[s]"""
    duration: float
    """[s]"""


@dataclass(frozen=True, kw_only=True)
class Onset:
    """Servos that something happens to."""

    joints: tuple[int, ...]
    """indices, from 0"""
    after: float
    """[s]"""


@dataclass(frozen=True, kw_only=True)
class Spell:
    """A span in which a servo is not heard of."""

    joint: int
    """index, from 0"""
    after: float
    """[s]"""
    duration: float
    """[s]"""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Everything that goes wrong; nothing by default. `KNOWN` says what each of them means."""

    drop: float = 0.0
    garbage: float = 0.0
    stale: float = 0.0
    split: float = 0.0
    half: float = 0.0
    double: float = 0.0
    echo: float = 0.0
    slow: float = 0.0
    """[s]"""
    stall: Stall | None = None
    gone: tuple[Absence, ...] = ()
    silent: float | None = None
    """[s]"""
    die: float | None = None
    """[s]"""
    freeze: tuple[Onset, ...] = ()
    blind: tuple[Onset, ...] = ()
    jump: tuple[Onset, ...] = ()
    limit: tuple[Onset, ...] = ()
    overheat: tuple[Onset, ...] = ()
    current: tuple[Onset, ...] = ()
    overload: tuple[Onset, ...] = ()
    voltage: tuple[Onset, ...] = ()
    mute: tuple[Spell, ...] = ()
    sag: float = 0.0
    """[ohm]"""


SERVO_BUS = ("mute", "sag")
"""Faults that an arm on its servos' own bus can have, and no other one: a computer in between hides them"""
NONE = Faults()


class _Form(NamedTuple):
    """How a kind of fault is written and read."""

    text: str
    ranges: str
    read: Callable[[str | None, str | None, int], object]
    """from what stands after ``=`` and after ``@``, and the number of joints; ValueError if it is not of this form"""


class Known(NamedTuple):
    """A fault that can be asked for."""

    form: _Form
    meaning: str


def _number(text: str | None, *, most: float = math.inf) -> float:
    value = float(text or "")
    if not (math.isfinite(value) and 0.0 <= value <= most):
        raise ValueError
    return value


def _nothing(text: str | None) -> None:
    if text is not None:
        raise ValueError


def _share(value: str | None, after: str | None, _joints: int) -> float:
    _nothing(after)
    return _number(value, most=1.0)


def _seconds(value: str | None, after: str | None, _joints: int) -> float:
    _nothing(after)
    return _number(value)


def _moment(value: str | None, after: str | None, _joints: int) -> float:
    _nothing(value)
    return _number(after)


def _pair(text: str | None) -> tuple[float, float]:
    first, _, second = (text or "").partition("/")
    return _number(first), _number(second)


def _stall(value: str | None, after: str | None, _joints: int) -> Stall:
    _nothing(after)
    duration, every = _pair(value)
    if duration >= every:
        raise ValueError
    return Stall(duration=duration, every=every)


def _absence(value: str | None, after: str | None, _joints: int) -> Absence:
    _nothing(after)
    begin, duration = _pair(value)
    return Absence(after=begin, duration=duration)


def _joint(value: str | None, after: str | None, joints: int) -> Onset:
    joint = int(value or "")
    if not 1 <= joint <= joints:
        raise ValueError
    return Onset(joints=(joint - 1,), after=_number(after))


def _spell(value: str | None, after: str | None, joints: int) -> Spell:
    joint = int(value or "")
    if not 1 <= joint <= joints:
        raise ValueError
    begin, duration = _pair(after)
    return Spell(joint=joint - 1, after=begin, duration=duration)


def _hot(value: str | None, after: str | None, joints: int) -> Onset:
    return _joint(str(min(HOT_JOINT, joints)) if value is None else value, after, joints)


def _all(value: str | None, after: str | None, joints: int) -> Onset:
    if value is None:
        return Onset(joints=tuple(range(joints)), after=_number(after))
    return _joint(value, after, joints)


_SHARE = _Form("P", "P from 0 to 1", _share)
_AT_JOINT = _Form("J@T", "joint J from 1 to {joints}, T seconds", _joint)

KNOWN: dict[str, Known] = {
    "drop": Known(_SHARE, "share of answers that are lost"),
    "garbage": Known(_SHARE, "share of answers with random bytes before them or inside"),
    "stale": Known(_SHARE, "share of answers that repeat the previous one to the same question"),
    "split": Known(_SHARE, "share of answers that come in two pieces, with a pause between them"),
    "half": Known(_SHARE, "share of answers that break off inside the frame"),
    "double": Known(_SHARE, "share of answers that are sent twice"),
    "echo": Known(_SHARE, "share of answers that come behind an echo of their request"),
    "slow": Known(_Form("S", "S seconds", _seconds), "every answer takes S longer"),
    "stall": Known(
        _Form("D/E", "D seconds every E seconds, D below E", _stall),
        "the link stands still both ways; what was under way comes late",
    ),
    "gone": Known(
        _Form("T/D", "T and D seconds", _absence), "the connection is closed at T and refused for D, then all is well"
    ),
    "silent": Known(_Form("@T", "T seconds", _moment), "from T on nothing comes any more; the connection stays open"),
    "die": Known(_Form("@T", "T seconds", _moment), "the emulator ends at T without a word"),
    "freeze": Known(_AT_JOINT, "from T on the encoder of J tells what it told at T; its servo still sees"),
    "blind": Known(_AT_JOINT, "from T on the servo of J itself sees what it saw at T, and runs away when moved"),
    "jump": Known(_AT_JOINT, "the first reading of J after T is off by more than any servo can move"),
    "limit": Known(_AT_JOINT, "from T on the reading of J runs until it is beyond the nearer limit, and stays off"),
    "overheat": Known(
        _Form("@T or =J@T", "joint J from 1 to {joints} (otherwise 2), T seconds", _hot),
        "from T on a servo gets hot, beyond its own threshold, and says so",
    ),
    "current": Known(_AT_JOINT, "from T on the servo of J reports over-current, and a current at the top of its scale"),
    "overload": Known(_AT_JOINT, "from T on the servo of J reports overload"),
    "voltage": Known(
        _Form("@T or =J@T", "joint J from 1 to {joints} (otherwise all), T seconds", _all),
        "from T on the supply is too low, and the servos say so",
    ),
    "mute": Known(
        _Form("J@T/D", "joint J from 1 to {joints}, T and D seconds", _spell),
        "on a bus of servos: from T on, for D, the servo of J neither hears nor answers; it holds",
    ),
    "sag": Known(
        _Form("R", "R ohm", _seconds), "on a bus of servos: the supply has this resistance and sags under their current"
    ),
}
"""The faults in the words of the command line. One name, one field of `Faults`."""

_REPEATABLE = {field.name for field in fields(Faults) if field.default == ()}
_ITEM = re.compile(r"(?P<name>\w+)(?:=(?P<value>[^=@]*))?(?:@(?P<after>[^=@]*))?", re.ASCII)


def form(name: str) -> str:
    """Return how a fault is written, such as ``freeze=J@T``."""
    text = KNOWN[name].form.text
    return name + (text.replace("=", f"{name}=") if text.startswith("@") else f"={text}")


def _ranges(name: str, joints: int) -> str:
    return KNOWN[name].form.ranges.format(joints=joints)


def describe(joints: int) -> Iterable[str]:
    """Return a line per fault: how it is written, what it means, and what its letters stand for."""
    return (f"{form(name)}: {known.meaning} ({_ranges(name, joints)})" for name, known in KNOWN.items())


def parse_faults(text: str, joints: int) -> Faults:
    """Read faults, comma separated, of an arm with ``joints`` joints; InputError for what is no fault.

    Faults of joints and ``gone`` may be repeated, all others stand once.
    """
    found: dict[str, list[object]] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        match = _ITEM.fullmatch(item)
        name = re.split("[=@]", item)[0]
        if name not in KNOWN:
            known = "".join(f"\n  {line}" for line in describe(joints))
            raise InputError(f"'{item}' is no known fault; known are{known}")
        wanted = f"expected the fault {form(name)}, {_ranges(name, joints)}, got '{item}'"
        if match is None:
            raise InputError(wanted)
        try:
            value = KNOWN[name].form.read(match["value"], match["after"], joints)
        except ValueError:
            raise InputError(wanted) from None
        found.setdefault(name, []).append(value)
        if name not in _REPEATABLE and len(found[name]) > 1:
            raise InputError(f"the fault {name} may be given once, got '{text}'")
    values = {name: tuple(values) if name in _REPEATABLE else values[0] for name, values in found.items()}
    return Faults(**values)  # type: ignore[arg-type]  # `KNOWN` reads each field as what it is
