"""The position loop of the servos themselves, as an owner may ask for it: ``?p=48&i=4``.

Sag of these servos is a known function of their gains: (duty - startup) / (P / 4) + dead zone counts, and any I removes
it. What is written here is lost with the power: the lock of the servos' memory is shut.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Knob(NamedTuple):
    """A gain that may be asked for."""

    registers: tuple[int, ...]
    low: int
    high: int
    stride: int
    """largest change at once, so that no arm jumps by more than a fraction of its sag"""


KNOBS: dict[str, Knob] = {
    "p": Knob((21,), 8, 64, 4),
    "i": Knob((23,), 0, 8, 1),
    "d": Knob((22,), 16, 64, 8),
    "dead": Knob((26, 27), 0, 16, 1),
}
"""Gains and within what they are tried (chosen: owners report P from 16 to 48, I up to 4; beyond, servos shake)"""
INTEGRAL_LIMIT, LIMITED = 25, 50
"""Register of the limit of the I part, and what is written there with any I: 20 % of PWM (chosen: beyond friction)"""
PAUSE = 0.05
"""[s] between two steps (chosen: longer than a servo rings)"""
HOTTEST, HEAVIEST = 55.0, 0.7
"""[deg C] and share of PWM at which a servo's gains are taken back (chosen: below its own protections)"""

Gains = Mapping[str, int]


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
