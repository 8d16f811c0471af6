"""All measurements of an arm by joint."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

from rejoint.arms import CATALOGUE, Arm, Array, link_inertia
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.workspace import largest_loads, torque_size
from rejoint.diagnosis import metrics
from rejoint.diagnosis.metrics import (
    COARSEST,
    INERTIA,
    LAG,
    OFFSET,
    SOFTNESS,
    WIDTH,
    Law,
    arm_delay,
    fit_effort,
    fit_law,
    fit_torque,
    mirrored_pulls,
    torque_given,
)
from rejoint.diagnosis.regression import LinearFit, product, reciprocal, scaled, shifted, within
from rejoint.diagnosis.segments import FREE, STEP, STILL, ExcitationLog, is_excitation
from rejoint.logs.columns import ZEROS
from rejoint.logs.runlog import RunLog
from rejoint.system.records import value_type
from rejoint.system.statistics import NORMAL95, Estimate

LOADED, LIGHT = 0.05, 0.01
"""[N m] gravity range on a myCobot 280 that a stiffness needs, and largest load of a joint that does not sag; chosen"""

FOLLOWS = 0.8
"""Share of the sag (`Law.follows`) from which it tells a stiffness. Measured: at least 0.86 for emulated arms of known
stiffness, at most 0.74 with gravity fed forward
"""

MODELLED = Estimate(1.0, 0.5, 2.0)
"""Stiffness over that by sag and a stranger's model: part of gravity may be fed forward; chosen: half
"""

MASS, CENTRE = 0.10, 0.15
"""Sigma of the log mass of a link, and of its centre of mass's place over its distance; chosen"""

USUAL, VARIED = 16.0, 0.9
"""[N m/rad] stiffness of a servo that carries a myCobot 280, and sigma of its logarithm; chosen"""

TORQUES = within(1.0, 0.1)
"""The same by logged torques; chosen"""

SAG = within(1.0, 0.04)
"""The same by the sag of a known arm; measured on emulated worn ones"""

CLEARER, DOUBTED = 2.0, 25.0
"""Least sag explained, in squared standard errors: times that by the model's gravity, for other than loads and zeros,
and beyond it, for signs, orders and zeros without the joint that gains most; chosen: right zeros reach 6 beyond, 18
with wrong masses
"""

FADED, BEYOND = 1.2, 5.0
"""The same for sag that fades; measured: at most 0.9 without an integral term, at least 1.5 with one"""

LOADS = np.arange(0.05, 1.01, 0.05)
"""Loads at the tip, over the mass of the arm, that might explain the sag; chosen"""

ANGLES = range(-45, 46, 5)
"""[deg] wrong zeros of single joints that might explain it; chosen"""

ENOUGH = 300.0
"""[s] of free motion that tell signs; chosen"""

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

NOT_KNOWN = Estimate(np.nan, np.nan, np.nan)
"""Stands for numbers that are not known: no comparison with it holds"""

OFFSET_ALLOWED = 0.01
"""[rad] offset of a healthy joint without load; chosen: 2 mm at a myCobot 280's tool"""

DELAY_ERROR = 0.003
"""[s] error of the delay; measured over emulated arms"""


@value_type
class JointMetrics:
    """One joint in numbers with 95 % intervals; None: unknown."""

    joint: str
    stiffness_nm_per_rad: Estimate | None = None
    """torque per radian of following error"""
    modelled_nm_per_rad: Estimate | None = None
    """the same by sag, without the model's doubt"""
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


@value_type
class Measurement:
    """What logs say about an arm."""

    joints: tuple[JointMetrics, ...]
    period_s: float
    """median of the readings"""
    effort_unit: str | None = None
    """of friction by torque or current; empty: that of the column"""
    torque_over_load: float | None = None
    """of logged torque, median: 1 expected"""

    def balance(self, arm: Arm) -> tuple[Array, Array]:
        """Sag per gravity torque (n,) [rad/(N m)] and lead without load (n,) [rad]; NaN if unknown.

        Joints that gravity hardly loads do not sag.
        """
        sag = 1.0 / np.array([(row.stiffness_nm_per_rad or NOT_KNOWN).value for row in self.joints])
        lead = -np.array([(row.offset_rad or NOT_KNOWN).value for row in self.joints])
        light = largest_loads(arm) < LIGHT * torque_size(arm)
        return np.where(np.isnan(sag) & light, 0.0, sag), lead


def measure(arm: Arm, log: RunLog, motors: Sequence[float | None] | None = None) -> Measurement:
    """Measure every joint; InputError for too little motion.

    ``motors``: a healthy arm's motor inertias [kg m^2], for the stiffness of joints without gravity load.
    """
    data = ExcitationLog.of(arm, log)
    delay = arm_delay(data)
    slow, fast = ([fit_law(data, joint, delay, fast=fast) for joint in range(arm.joints)] for fast in (False, True))
    ratios = [None if law is None else _inertia_ratio(law) for law in fast]
    late = [replace(one, start=one.start + delay, stop=one.stop + delay) for one in data.segments]
    answers, joints = replace(data, segments=tuple(late)), []
    for joint, (k, motor) in enumerate(_stiffness(arm, slow, ratios, motors)):
        law, dynamics, ratio = slow[joint], fast[joint], ratios[joint]
        row = _row(answers, joint, law, k)
        torque = {} if law is None or k is None else torque_given(data, joint, law, k.value, delay)
        # (d/k) / (2 sqrt(J/k)); the uncertainty of d/k dominates
        damping = scaled(dynamics.estimate(LAG), 0.5 / ratio.value**0.5) if dynamics and ratio else None
        inertia = None if motor is None else motor.value
        joints.append(replace(row, damping_ratio=damping, motor_inertia_kg_m2=inertia, **torque))
    return Measurement(joints=tuple(joints), period_s=log.period)


def measure_logs(data: ExcitationLog) -> Measurement:
    """Measure every joint from joined logs."""
    laws = _laws(data)
    rows = [_row(data, joint, *told) for joint, told in enumerate(zip(laws, _known(data, laws), strict=True))]
    return Measurement(
        joints=tuple(rows),
        period_s=data.log.period,
        effort_unit=data.effort_unit,
        torque_over_load=_over_load(data),
    )


def _row(data: ExcitationLog, joint: int, law: Law | None, k: Estimate | None) -> JointMetrics:
    half = None if law is None else _friction(law.estimate(WIDTH))
    effort = fit_effort(data, joint)
    dry, viscous = (_friction(effort.estimate(term)) if effort else None for term in (WIDTH, LAG))
    if dry is None or not (dry.low or (viscous and viscous.low)):  # none, or of a turned sign
        dry = viscous = None
    return JointMetrics(
        joint=data.arm.joint_names[joint],
        stiffness_nm_per_rad=k,
        modelled_nm_per_rad=k and _slope(law, within(1.0, 0.0), KNOWN_WITHIN),
        hysteresis_rad=half and scaled(half, 2.0),
        coulomb_nm=k and half and friction_torque(k, half),
        lag_s=None if law is None else law.estimate(LAG),
        overshoot=metrics.overshoot(data, joint) if len(data.of_kind(STEP, joint)) >= FEWEST_STEPS else None,
        hunting_rad=metrics.hunting(data, joint),
        noise_rad=metrics.noise(data, joint)
        if is_excitation(data.log) or len(data.of_kind(STILL)) >= FEWEST_RESTS
        else None,
        sweep_gain=metrics.followed(data, joint),
        stuck_rad=metrics.farthest_off(data, joint, law),
        coulomb_effort=dry,
        viscous_effort=viscous,
        offset_rad=None if law is None or ZEROS in data.log.extra else scaled(law.estimate(OFFSET), -1.0),
    )


def _friction(found: Estimate) -> Estimate | None:
    """Return a friction without what is below zero; None if nothing is left."""
    if (found.high or 0.0) <= 0.0:
        return None
    return Estimate(max(found.value, 0.0), max(found.low or 0.0, 0.0), found.high)


def _stiffness(
    arm: Arm, laws: list[Law | None], ratios: list[Estimate | None], motors: Sequence[float | None] | None
) -> list[tuple[Estimate | None, Estimate | None]]:
    links = link_inertia(arm, arm.rest)
    sure = _by_sag(arm, laws, SURE_WITHIN)
    own = [_motor(*one) for one in zip(sure, ratios, links, strict=True)]
    known = {joint: within(motor, SAME_KIND) for joint, motor in enumerate(motors or ()) if motor is not None} or {
        joint: motor for joint, motor in enumerate(own) if motor
    }
    for joint, (k, ratio) in enumerate(zip(sure, ratios, strict=True)):
        if not known or k is not None or ratio is None:
            continue
        near = min(known, key=lambda other: abs(other - joint))
        motor = known[near] if near == joint else product(known[near], within(1.0, SAME_SERVO))
        total = shifted(motor, links[joint])
        if total is not None:
            sure[joint] = product(total, reciprocal(ratio))
    return [(k or sag, motor) for k, sag, motor in zip(sure, _by_sag(arm, laws, KNOWN_WITHIN), own, strict=True)]


def sags(data: ExcitationLog) -> tuple[Array, Array, Array]:
    """Return ends (n, 2) of sag per gravity torque [rad/(N m)], or NaN; and of stiffness, logarithm and sigma (n,)."""
    laws = _laws(data)
    slopes = [law.estimate(SOFTNESS) if law else NOT_KNOWN for law in laws]
    ends = [(k.low, k.high) if k and k.low and k.high else (0.0, np.inf) for k in _known(data, laws)]
    low, high = np.log(np.maximum(ends, 1e-300)).T
    sigma = (high - low) / (2.0 * NORMAL95)
    softness = np.array([(k.low, k.high) for k in slopes], dtype=float)
    return softness, np.where(np.isfinite(high), 0.5 * (low + high), 0.0), sigma


def _laws(data: ExcitationLog) -> list[Law | None]:
    return [fit_law(data, joint) for joint in range(data.arm.joints)]


def sag_doubt(data: ExcitationLog) -> str:
    """Doubt about base, signs, order, zeros, load or controller where others explain the sag better; else empty."""
    if not data.log.commanded or data.log.period > COARSEST:
        return ""
    eye, free = np.eye(data.arm.joints), data.of_kind(FREE)
    few = free[:: 1 + int(sum(one.stop - one.start for one in free) / ENOUGH)]
    joints = [*zip(data.arm.joint_names, eye, strict=True)]
    ways = [(way, f"{name} turned the other way: check its sign") for name, way in joints]
    ways += [
        (one - other, f"{a} and {b} were exchanged: check their order") for (a, one), (b, other) in pairwise(joints)
    ]
    mirrors = [eye, *(eye - 2.0 * np.outer(way, way) / (way @ way) for way, _ in ways)]
    pulls, *others = mirrored_pulls(replace(data, segments=tuple(few)), np.stack(mirrors))
    right, tried = _explained(pulls), [(_explained(one), words) for one, (_, words) in zip(others, ways, strict=True)]
    alongs = (np.linalg.pinv(pulls[:, :3, :3], 1e-6) @ pulls[:, :3, -1:])[..., 0]
    bases = np.array([_explained(pulls, along) for along in alongs])
    base = (
        "gravity pulled not along (0, 0, -1) of the base: if the arm is mounted so, let a fixed joint in its file turn "
        "the base; else check signs and zeros, and whether a spring or the controller carries more than the weight"
    )
    load = "the tip carried more: if it did, weigh that and diagnose with --payload; else check the zeros of the joints"
    loads = [(_explained(pulls, np.append(GRAVITY, one)), load) for one in data.arm.mass.sum() * LOADS]
    zeros = []
    for name, one in joints:
        for degrees in ANGLES:
            c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
            along = np.concatenate([c * GRAVITY, [0.0], 0.5 * np.kron(one, [1.0 - c + s, 1.0 - c - s])])
            zero = f"{name} stood {degrees:+d} degrees from where it reads: check its zero, then the load"
            zeros.append((_explained(pulls, along), zero))
    fading = np.append(np.zeros(pulls.shape[-1] - 2), 1.0)
    integral = "the controller integrated its error, which hides stiffness and friction: switch its integral term off"
    found, total = [], right.sum()
    # the other joints tell whether what explains one of them is gravity
    if (bases * (1.0 - eye)).sum(axis=1).max() >= max(CLEARER * total, total + DOUBTED):
        found.append((bases.sum(axis=1).max(), base))
    for guesses, clearer, beyond, last in (
        (tried, CLEARER, DOUBTED, -1),
        (loads, 1.0, DOUBTED, None),
        (zeros, 1.0, DOUBTED, -1),
        ([(_explained(pulls, fading), integral)], FADED, BEYOND, None),
    ):
        best, words = max(guesses, key=lambda one: one[0].sum())
        if best.sum() >= clearer * total and np.sort(best - right)[:last].sum() >= beyond:
            found.append((best.sum(), words))
    return f"joints sag as if {max(found)[1]}" if found else ""


def _explained(pulls: Array, along: Array = GRAVITY) -> Array:
    """Sag (n,) by gravity ``along`` (3,) [m/s^2], and a mass [kg] at the tip, in squared standard errors."""
    known = len(along)
    sag, error = pulls[:, :known, :known] @ along, pulls[:, :known, -1]
    return (sag * error).sum(axis=1).clip(0.0) ** 2 / ((sag**2).sum(axis=1) + 1e-12)


def _over_load(data: ExcitationLog) -> float | None:
    """Return `Measurement.torque_over_load`."""
    if data.effort_unit != "N m":
        return None
    loaded = np.ptp(data.gravity, axis=0) >= LOADED * torque_size(data.arm)
    fits = [fit_effort(data, joint, own=True) for joint in np.flatnonzero(loaded).tolist()]
    found = [fit.coefficients[SOFTNESS] for fit in fits if fit]
    return float(np.median(found)) if found else None


def _known(data: ExcitationLog, laws: Sequence[Law | None]) -> list[Estimate | None]:
    by_sag = _by_sag(data.arm, [None] * data.arm.joints if ZEROS in data.log.extra else laws, KNOWN_WITHIN)
    # else nothing shows that the column holds torques of the joints, in this unit and sign, after the gear
    if not 1.0 / SURE_WITHIN < (_over_load(data) or 0.0) < SURE_WITHIN:
        return by_sag
    by_torque = [_slope(fit_torque(data, joint), TORQUES, KNOWN_WITHIN) for joint in range(data.arm.joints)]
    return [one or sag for one, sag in zip(by_torque, by_sag, strict=True)]


def _by_sag(arm: Arm, laws: Sequence[Law | None], ratio: float) -> list[Estimate | None]:
    """Stiffness by gravity; None if the sag does not follow the model, or its ends are ``ratio`` apart."""
    loaded = [law if law and law.torque_range >= LOADED * torque_size(arm) else None for law in laws]
    if arm.name in CATALOGUE:
        return [_slope(law, SAG, ratio) if law else None for law in loaded]
    value, sigma = _uncertain_masses(arm, loaded)
    told = [law is not None and law.follows >= FOLLOWS for law in loaded] & (2.0 * NORMAL95 * sigma < np.log(ratio))
    told &= value < np.log(USUAL * torque_size(arm)) + NORMAL95 * VARIED  # stiffer: gravity is fed forward
    ends = np.exp(value + NORMAL95 * sigma * np.array([[0.0], [-1.0], [1.0]])).T.tolist()
    return [product(Estimate(*one), MODELLED) if known else None for one, known in zip(ends, told, strict=True)]


def _uncertain_masses(arm: Arm, laws: Sequence[Law | None]) -> tuple[Array, Array]:
    """Logarithm and sigma (n,) of the stiffness at which all sags agree best with links like the arm's."""
    n, centre = arm.joints, CENTRE * np.linalg.norm(arm.com, axis=1)[:, None]
    usual = np.log(USUAL * torque_size(arm))

    def residuals(x: Array) -> Array:
        mass, stiffness = arm.mass * np.exp(MASS * x[:n]), np.exp(usual + VARIED * x[n : 2 * n])
        com = arm.com + centre * x[2 * n :].reshape(n, 3)
        links = np.column_stack([mass, mass[:, None] * com]).ravel()
        pairs = [(law.moments, k) for law, k in zip(laws, stiffness, strict=True) if law and law.moments is not None]
        return np.concatenate([x, *(moments[:, -1] - moments[:, :-1] @ links / k for moments, k in pairs)])

    found = least_squares(residuals, np.zeros(5 * n))
    sigma = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    return usual + VARIED * found.x[n : 2 * n], VARIED * sigma[n : 2 * n]


def _slope(fit: LinearFit | None, doubt: Estimate, ratio: float) -> Estimate | None:
    """Stiffness by following error over torque, widened by ``doubt``; None if its ends are ``ratio`` apart before."""
    if fit is None or fit.coefficients[SOFTNESS] <= 0:
        return None
    k = reciprocal(fit.estimate(SOFTNESS))
    return None if not k.low or k.high is None or k.high > ratio * k.low else product(k, doubt)


def _motor(k: Estimate | None, ratio: Estimate | None, link: float) -> Estimate | None:
    if k is None or ratio is None:
        return None
    motor = shifted(product(k, ratio), -link)
    sure = motor and motor.high and motor.high - motor.value <= MOTOR_SHARE * motor.value
    return motor if sure else None


def _inertia_ratio(law: Law) -> Estimate | None:
    """J/k [s^2], widened by the delay's error; None unless it is positive."""
    ratio, lag = law.estimate(INERTIA), law.coefficients[LAG]
    if ratio.value <= 0:
        return None
    half = np.hypot((ratio.high or 0.0) - ratio.value, DELAY_ERROR * lag)
    return Estimate(ratio.value, ratio.value - half, ratio.value + half)


def friction_torque(stiffness: Estimate, half_width: Estimate) -> Estimate:
    """F = k (F/k), or a bound for a half width of zero."""
    return product(stiffness, half_width) if half_width.value > 0 else scaled(half_width, stiffness.value)
