"""The position loop of the servos themselves, as an owner may ask for it: ``?p=48&i=4``.

Sag of these servos is a known function of their gains: (duty - startup) / (P / 4) + dead zone counts, and any I removes
it. What is written here is lost with the power: the lock of the servos' memory is shut.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rejoint.control.servogains import Rung


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
"""Gains and within what they are tried (chosen: owners report P from 16 to 48, I up to 4; beyond, servos shake; the
startup force is 16 as sold)"""
LIMIT, LIMITED = "limit", 50
"""Name of the limit of the I part, and what it is set to with any I: 20 % of PWM (chosen: beyond friction)"""
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
    """Return what to write, one small step after the other: by name, a value of each joint; joints step side by side.

    The limit of the I part, where 0 is none, is raised before the I part of any joint, and lowered after that of all.
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
