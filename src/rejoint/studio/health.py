"""What the servos of an arm that stands say before a motion: the page and `rejoint doctor` show it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm
from rejoint.control.robot import JointState

WARM = 50.0
"""[deg C] of a servo that should cool down before a motion (chosen: 15 below the guard's trip)"""
SAG = 0.85
"""Share of the usual supply below which a voltage is low (chosen)"""
SUPPLIES = (5.0, 7.4, 12.0)
"""[V] of servos (manuals of the STS3215 and the X series)"""
POWER = "check power supply and cables"


class Symptom(NamedTuple):
    """What was found."""

    found: str
    fix: str = ""
    """what to do; empty: nothing"""


def look_at_servos(arm: Arm, state: JointState) -> Iterator[Symptom]:
    """Compare positions, temperatures, supply and status with what they should be."""
    yield Symptom(f"all {arm.joints} servos answer")
    names, position = np.array(arm.joint_names), state.position[0]
    beyond = names[(position < arm.lower) | (position > arm.upper)].tolist()
    yield Symptom(f"beyond its limit: {', '.join(beyond) or 'no joint'}", "move it back by hand" * bool(beyond))
    heat = np.full(arm.joints, np.nan) if state.temperature is None else state.temperature[0]
    volts = np.full(arm.joints, np.nan) if state.voltage is None else state.voltage[0]
    high = float(np.nanmax(volts, initial=0.0))
    usual = min((one for one in SUPPLIES if one * (2.0 - SAG) >= high), default=high)
    for what, unit, values, bad, fix in (
        ("temperature", "deg C", heat, heat > WARM, "switch the arm off and let it cool down"),
        ("supply", "V", volts, volts < SAG * usual, f"{POWER}: {usual:g} V are usual"),
    ):
        worst = [f"{names[j]} {values[j]:.1f} {unit}" for j in np.flatnonzero(bad)]
        known = values[np.isfinite(values)]
        span = f"{known.min():.1f} to {known.max():.1f} {unit}" if len(known) else "not told"
        yield Symptom(f"{what}: {', '.join(worst) or span}", fix * bool(worst))
    words = [(name, word) for name, word in zip(names, state.trouble or (), strict=False) if word]
    for name, word in words:
        power = "voltage" in word or "supply" in word
        yield Symptom(f"{name} reports: {word}", POWER if power else "let it rest, and look at the joint")
    if not words and state.fault is not None and state.fault.any():
        yield Symptom("a servo reports a fault", "switch the arm off and on")
