"""All measurements of an arm together: one row per joint, from the log of an excitation alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, link_inertia
from rejoint.diagnosis import metrics
from rejoint.diagnosis.dynamics import Law, arm_delay, fit_dynamics, torque_given
from rejoint.diagnosis.regression import LinearFit, product, reciprocal
from rejoint.diagnosis.segments import ExcitationLog
from rejoint.logs.runlog import RunLog
from rejoint.system.statistics import Estimate

GRAVITY_SHARE = 0.35
"""Relative half width up to which the stiffness from gravity is taken (chosen: wider than what inertia gives)."""

SAME_SERVO = 0.4
"""Relative error allowed for taking a motor's inertia from a neighbouring joint (chosen: small arms use the same
servo, or the next size, in neighbouring joints)."""

SAME_KIND = 0.25
"""Relative error allowed for taking a motor's inertia from a healthy arm of the same kind (chosen: gears and rotors do
not change with wear, but the inertia of a stiff joint is hard to measure)."""

MOTOR_SHARE = 0.35
"""Relative half width up to which a motor's inertia counts as known (chosen as for gravity)."""

OFFSET_ALLOWED = 0.01
"""[rad] that any healthy joint may rest off its command without load (chosen: what a twin believes of a servo before
any data, and 2 mm at the tool of a myCobot 280)"""

DELAY_ERROR = 0.003
"""[s] error of the delay (measured: its scatter over emulated arms of one channel); it enters J/k times the lag."""


@dataclass(frozen=True, kw_only=True)
class JointMetrics:
    """One joint in numbers; every estimate with its 95 % interval."""

    joint: str
    stiffness_nm_per_rad: Estimate | None
    """of the servo loop: torque per radian of following error; None where the log does not tell"""
    stiffness_source: str
    """``gravity`` (sag in held postures), ``inertia`` (motion of a joint that gravity does not load) or ``none``"""
    hysteresis_rad: Estimate | None
    """full width of the following error between moving up and moving down, lag removed; None if it hardly moves"""
    coulomb_nm: Estimate | None
    """friction of a moving joint; None where the stiffness is not known or the joint hardly moves"""
    lag_s: Estimate | None
    """following error over speed, beyond the delay that all joints share; None if it hardly moves"""
    damping_ratio: Estimate | None
    """of the servo loop, friction left out: 1 aperiodic, 0.3 rings; None where the motion does not tell"""
    overshoot: Estimate | None
    """fraction of a step; None without steps"""
    hunting_rad: Estimate | None
    """rms motion while every command stands still, in the worst postures; None if they never do"""
    noise_rad: Estimate | None
    """rms of a single reading at rest; None without rest"""
    torque_limit_nm: Estimate | None
    """that reaches the load when the motor gives all it has: its limit less stiction; None where it never did"""
    torque_seen_nm: float
    """largest torque seen; the limit is not below"""
    saturated_share: float
    """share of the time at the torque limit"""
    motor_inertia_kg_m2: float | None
    """of motor and gear, seen from the joint; None where gravity does not load it enough to tell"""
    sweep_gain: float | None
    """share of a slow sweep that the joint follows; None where no sweep could be sent"""
    stuck_rad: float
    """farthest that the joint stayed off what its own stiffness explains, in a held posture"""
    offset_rad: Estimate | None = None
    """position under no load, minus command; None where the joint hardly moves"""


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What an excitation says about an arm."""

    joints: tuple[JointMetrics, ...]
    delay_s: float | None
    """of commands and answers on their way; None where it cannot be told from the lag of the joints"""
    period_s: float
    """median time between readings"""


def measure(arm: Arm, log: RunLog, motors: Sequence[float | None] | None = None) -> Measurement:
    """Measure every joint from the log of an excitation; InputError if it does not hold enough of one.

    ``motors`` are the motor inertias [kg m^2] of a healthy arm of the kind, None where unknown. With them
    the stiffness of joints that gravity does not load is better known than from the log alone.
    """
    data = ExcitationLog.of(arm, log)
    delay = arm_delay(data)
    dynamics = [fit_dynamics(data, joint, delay) for joint in range(arm.joints)]
    sags = [metrics.holds(data, joint).sag() for joint in range(arm.joints)]
    stiffness = _stiffness(arm, [fit for fit, _ in sags], [_inertia_ratio(fit) for fit in dynamics], motors)
    joints = tuple(_joint(data, joint, delay, dynamics[joint], stiffness[joint]) for joint in range(arm.joints))
    return Measurement(joints=joints, delay_s=delay, period_s=float(np.median(np.diff(log.time))))


@dataclass(frozen=True, kw_only=True)
class _Stiffness:
    """Stiffness of a joint, where it comes from, and the motor inertia that goes with it."""

    value: Estimate | None = None
    source: str = "none"
    motor: Estimate | None = None


def _joint(data: ExcitationLog, joint: int, delay: float, dynamics: LinearFit, stiffness: _Stiffness) -> JointMetrics:
    sweep = metrics.sweep_fit(data, joint, delay)
    lag, half_width = (None, None) if sweep is None else (sweep.estimate(0), sweep.estimate(1))
    k, held = stiffness.value, metrics.holds(data, joint)
    hunting, noise = metrics.hunting(data, joint), metrics.noise(data, joint)
    data.require(hunting is not None, "holds", joint)
    data.require(noise is not None, "readings at rest", joint)
    row = JointMetrics(
        joint=data.arm.joint_names[joint],
        stiffness_nm_per_rad=k,
        stiffness_source=stiffness.source,
        hysteresis_rad=None if half_width is None else scaled(half_width, 2.0),
        coulomb_nm=None if k is None or half_width is None else friction_torque(k, half_width),
        lag_s=lag,
        damping_ratio=_damping_ratio(dynamics),
        overshoot=metrics.overshoot(data, joint),
        hunting_rad=hunting,
        noise_rad=noise,
        torque_limit_nm=None,
        torque_seen_nm=0.0,
        saturated_share=0.0,
        motor_inertia_kg_m2=None if stiffness.motor is None else stiffness.motor.value,
        sweep_gain=metrics.sweep_gain(data, joint),
        stuck_rad=_stuck(held),
        offset_rad=None if lag is None else scaled(held.sag()[0].estimate(0), -1.0),
    )
    if k is None or lag is None or half_width is None:
        return row
    surely = row.offset_rad is not None and surely_offset(row.offset_rad)
    offset = -row.offset_rad.value if surely and row.offset_rad else 0.0
    law = Law(stiffness=k.value, lag=lag.value, half_width=max(half_width.value, 0.0), delay=delay, offset=offset)
    torque = torque_given(data, joint, law)
    return replace(
        row, torque_limit_nm=torque.limit, torque_seen_nm=torque.seen, saturated_share=torque.saturated_share
    )


def _stiffness(
    arm: Arm, sags: list[LinearFit], ratios: list[Estimate], motors: Sequence[float | None] | None
) -> list[_Stiffness]:
    """Stiffness from gravity where that is precise, else from J/k and the motor inertia of the nearest known joint."""
    links = link_inertia(arm, arm.rest)
    found = [_from_gravity(sag, ratio, float(link)) for sag, ratio, link in zip(sags, ratios, links, strict=True)]
    known = {joint: row.motor for joint, row in enumerate(found) if row.motor is not None}
    if motors is not None and any(motor is not None for motor in motors):
        known = {joint: _within(motor, SAME_KIND) for joint, motor in enumerate(motors) if motor is not None}
    if not known:
        return found
    for joint, row in enumerate(found):
        if row.value is not None or ratios[joint].value <= 0:
            continue
        near = min(known, key=lambda other: abs(other - joint))
        motor = known[near] if near == joint else product(known[near], _within(1.0, SAME_SERVO))
        total = _shifted(motor, float(links[joint]))
        if total is not None:
            found[joint] = _Stiffness(value=product(total, reciprocal(ratios[joint])), source="inertia")
    return found


def _from_gravity(sag: LinearFit, ratio: Estimate, link: float) -> _Stiffness:
    k = reciprocal(sag.estimate(1)) if sag.coefficients[1] > 0 else None
    if k is None or k.low is None or k.high is None or k.high - k.low > 2 * GRAVITY_SHARE * k.value:
        return _Stiffness()
    motor = _shifted(product(k, ratio), -link) if ratio.value > 0 else None
    if motor is None or motor.high is None or motor.high - motor.value > MOTOR_SHARE * motor.value:
        return _Stiffness(value=k, source="gravity")
    return _Stiffness(value=k, source="gravity", motor=motor)


def _inertia_ratio(dynamics: LinearFit) -> Estimate:
    """J/k [s^2] of a fit, its interval widened by what the delay may be wrong."""
    ratio, lag = dynamics.estimate(0), float(dynamics.coefficients[1])
    half = float(np.hypot((ratio.high or 0.0) - ratio.value, DELAY_ERROR * lag))
    return Estimate(ratio.value, ratio.value - half, ratio.value + half)


def _within(value: float, share: float) -> Estimate:
    return Estimate(value, value * (1 - share), value * (1 + share))


def _damping_ratio(dynamics: LinearFit) -> Estimate | None:
    """(d/k) / (2 sqrt(J/k)); the uncertainty of d/k dominates."""
    ratio, lag = float(dynamics.coefficients[0]), dynamics.estimate(1)
    return None if ratio <= 0 else scaled(lag, 0.5 / ratio**0.5)


def friction_torque(stiffness: Estimate, half_width: Estimate) -> Estimate:
    """F = k (F/k); a half width that is not above zero gives no friction, with the bound that it allows."""
    if half_width.value > 0:
        return product(stiffness, half_width)
    high = None if half_width.high is None else max(stiffness.value * half_width.high, 0.0)
    return Estimate(0.0, 0.0, high)


def surely_offset(offset: Estimate, *, doubt: float = 0.0) -> bool:
    """Whether the whole interval of an offset lies beyond what a healthy joint may have and ``doubt`` [rad]."""
    low, high = offset.low, offset.high
    return low is not None and high is not None and max(low, -high) > OFFSET_ALLOWED + doubt


def _stuck(held: metrics.HeldPostures) -> float:
    fit, _ = held.sag()
    expected = fit.coefficients[0] + fit.coefficients[1] * held.torque.mean(axis=1)
    return float(np.abs(held.error.mean(axis=1) - expected).max())


def scaled(estimate: Estimate, factor: float) -> Estimate:
    """Multiply a number and its interval."""
    low, high = (None if end is None else factor * end for end in (estimate.low, estimate.high))
    return Estimate(factor * estimate.value, *((high, low) if factor < 0.0 else (low, high)))


def _shifted(estimate: Estimate, offset: float) -> Estimate | None:
    """Add a number to a positive quantity; None if nothing positive is left."""
    value = estimate.value + offset
    if value <= 0:
        return None
    low = None if estimate.low is None else max(estimate.low + offset, 0.05 * value)
    return Estimate(value, low, None if estimate.high is None else estimate.high + offset)
