"""Units by the steps of encoders: in radians or degrees each has one step, whatever the joint.

LeRobot's normalised values step by 200 over the counts of a joint's calibrated range. All thresholds are chosen.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.joints import COUNTS_PER_TURN
from rejoint.system.errors import FileError

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
