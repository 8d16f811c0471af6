"""A reference from one arm that is known to be good: better than an emulated one, if there is such an arm.

Arms of a kind leave their makers with different settings: an SO-101 that LeRobot has set up holds its
position half as stiffly as its servos could. Beside another of its kind such an arm is not worn.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from rejoint.arms import Arm
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.healthy import NO_OFFSET, OVERSHOOT_ALLOWED, TOLERANCE, HealthyReference
from rejoint.diagnosis.measurement import JointMetrics
from rejoint.system.errors import InputError
from rejoint.system.statistics import Estimate

POSITIVE = ("stiffness_nm_per_rad", "coulomb_nm", "damping_ratio", "hysteresis_rad", "lag_s")
"""Quantities of a joint that are above zero in any arm"""


def reference_by(arm: Arm, good: Diagnosis) -> HealthyReference:
    """Make a reference of a diagnosis, each interval wider by the spread between arms.

    InputError if the diagnosis is of another kind of arm or says too little. The arm may be diagnosed by a robot or by
    logs of other motion.
    """
    if good.arm != arm.name:
        raise InputError(f"the arm known to be good is a {good.arm}, expected {arm.name}")
    error = None if good.evidence is None else good.evidence.rest_error_mm
    error = error if good.open_loop is None else good.open_loop.error_mm
    if error is None:
        raise InputError("the diagnosis of the arm known to be good says nothing about rest; take another one")
    return HealthyReference(
        arm=arm.name,
        source=f"an arm known to be good ({good.robot})",
        motors_kg_m2=tuple(row.motor_inertia_kg_m2 for row in good.measurement.joints),
        joints=tuple(_ranges(arm, row) for row in good.measurement.joints),
        error_mm=_factor(error),
        hidden_mm=None,
    )


def _ranges(arm: Arm, row: JointMetrics) -> JointMetrics:
    """Turn every interval of a joint into the range within which another arm counts as healthy."""
    changed: dict[str, Any] = {name: _factor(found) for name in POSITIVE if (found := getattr(row, name)) is not None}
    allowed = {"overshoot": OVERSHOOT_ALLOWED, "hunting_rad": arm.encoder_step, "noise_rad": arm.encoder_step}
    for name, margin in allowed.items():
        if (found := getattr(row, name)) is not None:
            changed[name] = _margin(found, margin)
    return dataclasses.replace(row, offset_rad=NO_OFFSET, **changed)


def _factor(found: Estimate) -> Estimate:
    low, high = _ends(found)
    return Estimate(found.value, max(low, 0.0) / (1 + TOLERANCE), high * (1 + TOLERANCE))


def _margin(found: Estimate, allowed: float) -> Estimate:
    low, high = _ends(found)
    margin = TOLERANCE * abs(found.value) + allowed
    return Estimate(found.value, low - margin, high + margin)


def _ends(found: Estimate) -> tuple[float, float]:
    return (
        found.value if found.low is None else found.low,
        found.value if found.high is None else found.high,
    )
