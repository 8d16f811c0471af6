"""All measurements of an arm by joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import CATALOGUE, Arm, Array, link_inertia
from rejoint.arms.workspace import torque_size
from rejoint.diagnosis import metrics
from rejoint.diagnosis.metrics import (
    INERTIA,
    LAG,
    OFFSET,
    SOFTNESS,
    WIDTH,
    Law,
    arm_delay,
    fit_law,
    fit_torque,
    torque_given,
)
from rejoint.diagnosis.regression import LinearFit, product, reciprocal, scaled, shifted, within
from rejoint.diagnosis.segments import STEP, STILL, ExcitationLog, is_excitation
from rejoint.logs.runlog import RunLog
from rejoint.system.statistics import NORMAL95, Estimate

LOADED = 0.05
"""[N m] gravity range on a myCobot 280 that a stiffness needs; chosen"""

FOLLOWS = 0.8
"""Share of the sag (`Law.follows`) from which it tells a stiffness. Measured: at least 0.86 for emulated arms of known
stiffness, at most 0.74 with gravity fed forward
"""

MODELLED = Estimate(1.0, 0.5, 2.0)
"""Stiffness over that by sag and a stranger's model: masses are wrong, and part of gravity may be fed forward, which
looks the same; chosen: half of it, and the real IRIS has 0.58 at joint 3
"""

TORQUES = within(1.0, 0.1)
"""The same by logged torques; chosen"""

SAG = within(1.0, 0.04)
"""The same by the sag of a known arm; measured on emulated worn ones, whose friction grows with the load"""

KNOWN_WITHIN, SURE_WITHIN = 4.0, 2.0
"""Ratio of the ends of an interval that is used alone, and that outranks inertia; chosen"""

FEWEST_STEPS, FEWEST_RESTS = 3, 4
"""Steps that overshoot needs, and rests that noise needs; chosen"""

SAME_SERVO = 0.4
"""Relative error of a motor's inertia from another joint; chosen"""

SAME_KIND = 0.25
"""Relative error of a motor's inertia from a healthy arm; chosen"""

MOTOR_SHARE = 0.35
"""Relative half width of a known motor inertia; chosen"""

OFFSET_ALLOWED = 0.01
"""[rad] offset of a healthy joint without load; chosen: 2 mm at a myCobot 280's tool"""

DELAY_ERROR = 0.003
"""[s] error of the delay; measured over emulated arms"""


@dataclass(frozen=True, kw_only=True)
class JointMetrics:
    """One joint in numbers with 95 % intervals; None: unknown."""

    joint: str
    stiffness_nm_per_rad: Estimate | None = None
    """torque per radian of following error"""
    hysteresis_rad: Estimate | None = None
    """full width between both directions, lag removed"""
    coulomb_nm: Estimate | None = None
    """friction of a moving joint"""
    lag_s: Estimate | None = None
    """following error over speed, less the common delay"""
    damping_ratio: Estimate | None = None
    """without friction: 1 aperiodic, 0.3 rings"""
    overshoot: Estimate | None = None
    """fraction of a step"""
    hunting_rad: Estimate | None = None
    """rms under constant commands, worst postures"""
    noise_rad: Estimate | None = None
    """rms of one reading at rest"""
    torque_limit_nm: Estimate | None = None
    """at the load: motor limit less stiction; None: not reached"""
    saturated_share: float = 0.0
    """of time, at the torque limit"""
    motor_inertia_kg_m2: float | None = None
    """of motor and gear at the joint"""
    sweep_gain: float | None = None
    """followed share of a slow sweep"""
    stuck_rad: float = 0.0
    """largest unexplained distance in a hold"""
    coulomb_effort: Estimate | None = None
    """in the unit of logged current or torque"""
    viscous_effort: Estimate | None = None
    """in that unit times s/rad"""
    offset_rad: Estimate | None = None
    """position without load minus command"""


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What logs say about an arm."""

    joints: tuple[JointMetrics, ...]
    period_s: float
    """median of the readings"""

    @property
    def balance(self) -> tuple[Array, Array]:
        """Sag per gravity torque (n,) [rad/(N m)], 0 if unknown, and lead without load (n,) [rad], NaN if unknown."""
        stiffness = [row.stiffness_nm_per_rad for row in self.joints]
        offset = [row.offset_rad for row in self.joints]
        return (
            np.array([0.0 if one is None else 1.0 / one.value for one in stiffness]),
            np.array([np.nan if one is None else -one.value for one in offset]),
        )


def measure(arm: Arm, log: RunLog, motors: Sequence[float | None] | None = None) -> Measurement:
    """Measure every joint; InputError for too little motion.

    ``motors``: a healthy arm's motor inertias [kg m^2], for the stiffness of joints without gravity load.
    """
    data = ExcitationLog.of(arm, log)
    delay = arm_delay(data)
    slow, fast = ([fit_law(data, joint, delay, fast=fast) for joint in range(arm.joints)] for fast in (False, True))
    ratios = [None if law is None else _inertia_ratio(law) for law in fast]
    joints = []
    for joint, (k, motor) in enumerate(_stiffness(arm, slow, ratios, motors)):
        law, dynamics = slow[joint], fast[joint]
        row = _row(data, joint, law, k)
        data.require(row.hunting_rad is not None, "holds", joint)
        data.require(row.noise_rad is not None, "readings at rest", joint)
        torque = {} if law is None or k is None else torque_given(data, joint, law, k.value, delay)
        damping = None if dynamics is None else _damping_ratio(dynamics)
        inertia = None if motor is None else motor.value
        joints.append(replace(row, damping_ratio=damping, motor_inertia_kg_m2=inertia, **torque))
    return Measurement(joints=tuple(joints), period_s=float(np.median(np.diff(log.time))))


def measure_joint(data: ExcitationLog, joint: int) -> JointMetrics:
    """Measure one joint from joined logs."""
    law = fit_law(data, joint)
    return _row(data, joint, law, _known(data, joint, law))


def _row(data: ExcitationLog, joint: int, law: Law | None, k: Estimate | None) -> JointMetrics:
    half = None if law is None else law.fit.estimate(WIDTH)
    effort = metrics.fit_effort(data, joint)
    return JointMetrics(
        joint=data.arm.joint_names[joint],
        stiffness_nm_per_rad=k,
        hysteresis_rad=None if half is None else scaled(half, 2.0),
        coulomb_nm=None if k is None or half is None else friction_torque(k, half),
        lag_s=None if law is None else law.fit.estimate(LAG),
        overshoot=metrics.overshoot(data, joint) if len(data.of_kind(STEP, joint)) >= FEWEST_STEPS else None,
        hunting_rad=metrics.hunting(data, joint),
        noise_rad=metrics.noise(data, joint)
        if is_excitation(data.log) or len(data.of_kind(STILL)) >= FEWEST_RESTS
        else None,
        sweep_gain=metrics.followed(data, joint),
        stuck_rad=metrics.farthest_off(data, joint, law),
        coulomb_effort=None if effort is None else effort.estimate(WIDTH),
        viscous_effort=None if effort is None else effort.estimate(LAG),
        offset_rad=None if law is None else scaled(law.fit.estimate(OFFSET), -1.0),
    )


def _stiffness(
    arm: Arm, laws: list[Law | None], ratios: list[Estimate | None], motors: Sequence[float | None] | None
) -> list[tuple[Estimate | None, Estimate | None]]:
    """Stiffness and motor inertia of each joint."""
    links = link_inertia(arm, arm.rest)
    found = [_loaded(arm, law, ratio, float(link)) for law, ratio, link in zip(laws, ratios, links, strict=True)]
    known = {joint: motor for joint, (_, motor) in enumerate(found) if motor is not None}
    if motors is not None and any(motor is not None for motor in motors):
        known = {joint: within(motor, SAME_KIND) for joint, motor in enumerate(motors) if motor is not None}
    for joint, ((k, _), ratio) in enumerate(zip(found, ratios, strict=True)):
        if not known or k is not None or ratio is None or ratio.value <= 0:
            continue
        near = min(known, key=lambda other: abs(other - joint))
        motor = known[near] if near == joint else product(known[near], within(1.0, SAME_SERVO))
        total = shifted(motor, float(links[joint]))
        if total is not None:
            found[joint] = product(total, reciprocal(ratio)), None
    return found


def sag(data: ExcitationLog, joint: int) -> tuple[float, float, float]:
    """Sag per gravity torque [rad/(N m)] of a joint, and logarithm and sigma of its stiffness; infinite if unknown."""
    law = fit_law(data, joint)
    k, softness = _known(data, joint, law), np.inf if law is None else float(law.fit.coefficients[SOFTNESS])
    if k is None or not k.low or k.high is None:
        return softness, 0.0, np.inf
    return softness, float(np.log(k.value)), float(np.log(k.high / k.low)) / (2.0 * NORMAL95)


def _known(data: ExcitationLog, joint: int, law: Law | None) -> Estimate | None:
    """Stiffness by logged torque, else by gravity."""
    return _slope(fit_torque(data, joint), TORQUES, KNOWN_WITHIN) or _by_sag(data.arm, law, KNOWN_WITHIN)


def _by_sag(arm: Arm, law: Law | None, ratio: float) -> Estimate | None:
    """Stiffness by gravity; None if the sag does not follow the model, or as `_slope`."""
    if law is None or law.follows < FOLLOWS or law.torque_range < LOADED * torque_size(arm):
        return None
    return _slope(law.fit, SAG if arm.name in CATALOGUE else MODELLED, ratio)


def _slope(fit: LinearFit | None, doubt: Estimate, ratio: float) -> Estimate | None:
    """Stiffness by following error over torque, widened by ``doubt``; None if its ends are ``ratio`` apart before."""
    if fit is None or fit.coefficients[SOFTNESS] <= 0:
        return None
    k = reciprocal(fit.estimate(SOFTNESS))
    return None if not k.low or k.high is None or k.high > ratio * k.low else product(k, doubt)


def _loaded(arm: Arm, law: Law | None, ratio: Estimate | None, link: float) -> tuple[Estimate | None, Estimate | None]:
    k = _by_sag(arm, law, SURE_WITHIN)
    if k is None or ratio is None or ratio.value <= 0:
        return k, None
    motor = shifted(product(k, ratio), -link)
    sure = motor is not None and motor.high is not None and motor.high - motor.value <= MOTOR_SHARE * motor.value
    return k, motor if sure else None


def _inertia_ratio(law: Law) -> Estimate:
    """J/k [s^2], widened by the delay's error."""
    ratio, lag = law.fit.estimate(INERTIA), float(law.fit.coefficients[LAG])
    half = float(np.hypot((ratio.high or 0.0) - ratio.value, DELAY_ERROR * lag))
    return Estimate(ratio.value, ratio.value - half, ratio.value + half)


def _damping_ratio(law: Law) -> Estimate | None:
    """(d/k) / (2 sqrt(J/k)); the uncertainty of d/k dominates."""
    ratio = float(law.fit.coefficients[INERTIA])
    return None if ratio <= 0 else scaled(law.fit.estimate(LAG), 0.5 / ratio**0.5)


def friction_torque(stiffness: Estimate, half_width: Estimate) -> Estimate:
    """F = k (F/k), or a bound for a half width of zero."""
    if half_width.value > 0:
        return product(stiffness, half_width)
    high = None if half_width.high is None else max(stiffness.value * half_width.high, 0.0)
    return Estimate(0.0, 0.0, high)
