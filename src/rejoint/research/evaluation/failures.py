"""Holds that ended too far from their target, one by one, and what the arm did in the last second."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm
from rejoint.control.guard import TRIPS, reason_names
from rejoint.research.evaluation.outcome import Outcome

FAR = 0.005
"""[m] settled encoder error from which a hold counts as failed"""

_TREMBLING = 0.5e-3  # [m] chosen: ten times what encoder counts alone make of a resting arm
_APPROACHING = 0.5e-3  # [m] in a second (chosen)
_SATURATED = 0.5  # share of the time (chosen)
_STICKING_LEAD = np.radians(3.0)  # chosen: what breaks a worn joint loose at its gain
_COUNTS = 2.5  # encoder counts that a joint may flicker while it stands


@dataclass(frozen=True, kw_only=True)
class Failure:
    """One hold that failed."""

    variant: str
    controller: str
    arm: int
    """wear seed"""
    target: int
    """its number, from 0"""
    point_mm: tuple[float, float, float]
    settled_mm: float | None
    """encoder error; None where the guard stopped the arm"""
    true_mm: float | None
    what: str
    """what happened, in words"""


def list_failures(arm: Arm, variant: str, controller: str, outcome: Outcome) -> tuple[Failure, ...]:
    """List the holds that ended farther away than `FAR`, and those that the guard ended."""
    failed = ~(outcome.settled <= FAR)
    found = []
    for b, k in np.argwhere(failed):
        x, y, z = (round(float(value) * 1e3, 1) for value in outcome.target[b, k])
        found.append(
            Failure(
                variant=variant, controller=controller, arm=int(outcome.wear_seed[b]), target=int(k),
                point_mm=(x, y, z), settled_mm=_mm(outcome.settled[b, k]), true_mm=_mm(outcome.settled_true[b, k]),
                what=what_happened(arm, outcome, int(b), int(k)),
            )
        )  # fmt: skip
    return tuple(found)


def what_happened(arm: Arm, outcome: Outcome, b: int, k: int) -> str:
    """Say what arm ``b`` did at target ``k``, the strongest reason first."""
    if not np.isfinite(outcome.settled[b, k]):
        names = ", ".join(reason_names(int(outcome.tripped[b]))) or "unknown"
        return f"stopped by the guard ({names})"
    said = []
    swing, lead, full = outcome.swing[b, k], outcome.lead[b, k], outcome.saturation[b, k]
    if outcome.oscillation[b, k] > _TREMBLING:
        j = int(np.argmax(swing))
        said.append(
            f"oscillates by {1e3 * outcome.oscillation[b, k]:.1f} mm, {arm.joint_names[j]} by "
            f"{np.degrees(swing[j]):.1f} deg"
        )
    said += [f"the motor of {arm.joint_names[j]} is at its limit" for j in np.flatnonzero(full > _SATURATED)]
    stuck = (swing < _COUNTS * arm.encoder_step) & (np.abs(lead) > _STICKING_LEAD) & (full <= _SATURATED)
    said += [
        f"{arm.joint_names[j]} stands while its command leads by {np.degrees(lead[j]):.1f} deg"
        for j in np.flatnonzero(stuck)
    ]
    flags = int(outcome.limited[b, k]) & ~int(TRIPS)
    if flags:
        said.append(f"the guard limits it ({', '.join(reason_names(flags))})")
    if outcome.approach[b, k] > _APPROACHING:
        said.append(f"still coming nearer, {1e3 * outcome.approach[b, k]:.1f} mm in the last second")
    return "; ".join(said) or "rests, and its command does not change"


def _mm(value: float) -> float | None:
    return round(1e3 * float(value), 3) if np.isfinite(value) else None
