"""What the registers say that are read in each control cycle, of all servos of an arm.

Numbers are taken one by one: those of five servos are too few for NumPy, which between two cycles leaves the
processor's caches and then takes ten times as long.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from rejoint.robots.bus import Reading
from rejoint.robots.feetech.law import DutyLaw
from rejoint.robots.feetech.zeros import Zeros

PRESENT, BLOCK = 56, 15
"""Address of the first of them, and how many: position, speed, load, voltage, temperature, -, status, moving, goal,
current (Feetech's memory table of the STS/SMS series)"""
FAULTS = {1: "voltage", 2: "encoder", 4: "heat", 8: "over-current", 32: "overload"}
"""Bits of the status register."""
SAGGING = 0.75
"""share of the voltage at the start below which a supply sags (chosen: a motor has lost a quarter of its torque then,
and servos go silent at about half of it)"""
VOLT = 0.1
"""[V] of the register of the voltage"""
_ROW = struct.Struct("<HxxHBBxBxHxx")
"""of these position, load, voltage, temperature, status and goal"""


def decode(rows: Sequence[bytes], zeros: Zeros, laws: Sequence[DutyLaw], supply: Sequence[float]) -> Reading:
    """Return what the ``rows`` of n servos say; ``supply`` [V] is what each measured at the start."""
    places, loads, voltages, heats, well = [], [], [], [], True
    for row, law, before in zip(rows, laws, supply, strict=True):
        position, duty, volt, heat, status, goal = _ROW.unpack(row)
        place, voltage = signed(position, 15), volt * VOLT
        places.append(place)
        loads.append(law.share(signed(duty, 10), signed(goal, 15) - place))
        voltages.append(voltage)
        heats.append(heat)
        well = well and not status and voltage >= SAGGING * before
    table = np.array(zeros.radians(places) + loads + voltages + heats).reshape(4, len(rows))
    words = None if well else [_trouble(row, before) for row, before in zip(rows, supply, strict=True)]
    return Reading(
        position=table[0], load=table[1], voltage=table[2], temperature=table[3],
        fault=np.zeros(len(rows), bool) if words is None else np.array([word is not None for word in words]),
        trouble=None if words is None else tuple(word or "" for word in words),
    )  # fmt: skip


def signed(word: int, bit: int) -> int:
    """Return a number that is written as its size and a ``bit`` for the sign."""
    return -(word & ~(1 << bit)) if word & 1 << bit else word


def _trouble(row: bytes, before: float) -> str | None:
    """Put into words what a servo complains of; None for nothing, empty for a bit that has no name."""
    _, _, volt, _, status, _ = _ROW.unpack(row)
    voltage = volt * VOLT
    words = [name for bit, name in FAULTS.items() if status & bit]
    if voltage < SAGGING * before:
        words.append(f"the supply sags to {voltage:.1f} V from {before:.1f} V")
    return ", ".join(words) if status or words else None
