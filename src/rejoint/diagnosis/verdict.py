"""Named findings from numbers: what is worn, its error at the tool, and a sentence.

A finding's 95 % interval lies wholly outside the healthy range, on the bad side. Without a reference only absolute
faults count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, position_kinematics
from rejoint.arms.workspace import length_size
from rejoint.diagnosis.healthy import OVERSHOOT_ALLOWED, HealthyReference
from rejoint.diagnosis.measurement import JointMetrics, Measurement, surely_offset
from rejoint.diagnosis.open_loop import Postures
from rejoint.diagnosis.regression import mean_of
from rejoint.system.statistics import Estimate

BAD_MM = 3.0
"""Tool error of a bad finding: a healthy myCobot's (Park et al. 2024, section IV-B); goes with the reach"""

FELT_MM = 0.05
"""Tool error of a finding that counts; chosen"""

RINGING_RATIO = 0.4
"""Damping ratio of ringing without a reference: 25 % overshoot (second order)"""

SWINGING_RATIO = 0.5
"""Damping ratio without ringing: 16 % overshoot (second order)"""

QUIET_COUNTS = 2.0
"""Encoder counts of rms motion at rest beyond flicker"""

SATURATED = 0.3
"""Share of time at the limit that hides stiffness and friction; chosen"""

FOLLOWS = 0.3
"""Share of a slow sweep of a stuck joint; chosen: a worn one makes 0.7"""

STUCK_ERROR = 0.17
"""[rad] following error of a stuck joint without sweep; chosen: twice a worn joint's sag"""

STUCK_COUNTS = 10.0
"""Encoder counts off what stiffness explains of a stuck joint; chosen"""

GRAVITY_DOUBT = 0.2
"""Relative error of sag by wrong masses; chosen"""

UNLOADED = 1e-6
"""[N m] of gravity up to which a joint is unloaded: rounding"""

WORKING_SPEED = 0.5
"""[rad/s] at which a lag becomes millimetres; chosen"""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that is wrong with one joint."""

    joint: str
    kind: str
    """stuck, weak_gain, friction, hysteresis, play_in_loop, torque_limit, low_damping, lag, offset or noise"""
    severity: str
    """worn or bad"""
    quantity: str
    """with unit, such as ``stiffness_nm_per_rad``"""
    measured: Estimate
    healthy: Estimate | None
    """mean and healthy range; None without a reference"""
    tcp_mm: float
    """tool error in the ten target postures"""
    sentence: str

    @property
    def felt(self) -> bool:
        """Whether it matters at the tool."""
        return self.tcp_mm >= FELT_MM


@dataclass(frozen=True, kw_only=True, eq=False)
class _Case:
    """Inputs of a rule; K targets."""

    row: JointMetrics
    healthy: JointMetrics | None
    levers: Array
    """(K,) [m/rad] of the TCP"""
    loads: Array
    """(K,) [N m] of gravity"""
    errors: Array
    """(K,) [rad] settled following error"""
    encoder_step: float
    """[rad]"""
    common_lag: float
    """[s] delay of all joints"""
    bad_mm: float
    """of a bad finding"""

    @property
    def lever(self) -> float:
        """[m/rad] mean."""
        return float(self.levers.mean())

    @property
    def moves(self) -> bool:
        return self.row.lag_s is not None and self.row.saturated_share <= SATURATED

    @property
    def hunts(self) -> bool:
        swing = self.row.hunting_rad
        return swing is not None and (swing.low or 0.0) > QUIET_COUNTS * self.encoder_step

    def finding(self, kind: str, quantity: str, tcp: float, sentence: str, measured: Estimate | None = None) -> Finding:
        cost = f"{tcp * 1e3:.1f} mm at the tool." if tcp * 1e3 >= FELT_MM else "nothing that the tip of the tool feels."
        return Finding(
            joint=self.row.joint,
            kind=kind,
            severity="bad" if tcp * 1e3 >= self.bad_mm else "worn",
            quantity=quantity,
            measured=measured or getattr(self.row, quantity),
            healthy=getattr(self.healthy, quantity, None),
            tcp_mm=tcp * 1e3,
            sentence=f"{self.row.joint} {sentence} {cost}",
        )

    def beyond(self, quantity: str) -> bool:
        """Whether the whole interval lies above the healthy range."""
        measured, reference = self._pair(quantity)
        return bool(measured and reference and measured.low is not None and measured.low > (reference.high or np.inf))

    def below(self, quantity: str) -> bool:
        measured, reference = self._pair(quantity)
        return bool(measured and reference and measured.high is not None and measured.high < (reference.low or -np.inf))

    def _pair(self, quantity: str) -> tuple[Estimate | None, Estimate | None]:
        return getattr(self.row, quantity), getattr(self.healthy, quantity) if self.healthy is not None else None


def find(
    arm: Arm, measurement: Measurement, postures: Postures, healthy: HealthyReference | None
) -> tuple[Finding, ...]:
    """Name everything that is wrong, largest tool error first."""
    q, commands = postures.position, postures.command
    levers = np.linalg.norm(position_kinematics(arm, q)[1], axis=-2)
    loads, errors = np.abs(gravity_torque(arm, q)), np.abs(commands - q)
    common = _common_lag(measurement, healthy)
    found: list[Finding] = []
    for joint, row in enumerate(measurement.joints):
        case = _Case(
            row=row,
            healthy=None if healthy is None else healthy.joints[joint],
            levers=levers[:, joint],
            loads=loads[:, joint],
            errors=errors[:, joint],
            encoder_step=arm.encoder_step,
            common_lag=common,
            bad_mm=BAD_MM * length_size(arm),
        )
        found += [finding for rule in RULES if (finding := rule(case)) is not None]
    return tuple(sorted(found, key=lambda f: (f.severity != "bad", -f.tcp_mm)))


def stuck(case: _Case) -> Finding | None:
    """Report a joint that does not move when commanded, or is beyond measurement."""
    gain, far = case.row.sweep_gain, float(case.errors.max())
    if gain is not None:  # one that breaks loose on a long way may come near its targets, and stick elsewhere
        far = max(far, case.row.stuck_rad)
    if (gain is not None and gain > FOLLOWS) or far < STUCK_ERROR:
        return None
    return case.finding(
        "stuck",
        "following_error_rad",
        float((case.levers * case.errors).mean()),
        f"does not follow: it stood up to {np.degrees(far):.0f} deg off where it was sent, so it has "
        "no power, is blocked or too weak to lift the arm, or its reading is another joint's or turned round; at its "
        "targets this costs",
        mean_of(case.errors),
    )


def weak_gain(case: _Case) -> Finding | None:
    """Report a servo with too little torque per following error."""
    k = case.row.stiffness_nm_per_rad
    if k is None or not case.below("stiffness_nm_per_rad") or not case.moves:
        return None
    friction = case.row.coulomb_nm.value if case.row.coulomb_nm is not None else 0.0
    weight = float((case.levers * case.loads).mean())
    tcp = (weight + case.lever * friction) / k.value
    sags = f"sags under the arm's own weight: it hangs {np.degrees(case.loads.mean() / k.value):.1f} deg low"
    effect = sags if weight > case.lever * friction else "stops short of where it is sent"
    return case.finding("weak_gain", "stiffness_nm_per_rad", tcp, f"is soft and {effect},")


def friction(case: _Case) -> Finding | None:
    """Report a joint that is hard to move."""
    force = case.row.coulomb_nm
    if force is None or not case.beyond("coulomb_nm") or not case.moves or case.hunts:
        return None
    half = max(case.row.hysteresis_rad.value, 0.0) / 2 if case.row.hysteresis_rad is not None else 0.0
    return case.finding(
        "friction",
        "coulomb_nm",
        case.lever * half,
        f"is stiff to turn: it stops up to {np.degrees(half):.2f} deg short on either side,",
    )


def hysteresis(case: _Case) -> Finding | None:
    """Report a joint that stops short for an unclear reason."""
    width = case.row.hysteresis_rad
    explained = case.below("stiffness_nm_per_rad") or case.beyond("coulomb_nm")
    if width is None or not case.beyond("hysteresis_rad") or explained or not case.moves or case.hunts:
        return None
    return case.finding(
        "hysteresis",
        "hysteresis_rad",
        case.lever * width.value / 2,
        f"stops short: coming from below and from above it rests {np.degrees(width.value):.2f} deg apart"
        f"{_against(case, 'hysteresis_rad', '.2f', np.degrees(1.0))}; whether it is stiff to turn or soft, or both, "
        "cannot be told; on either side,",
    )


def play_in_loop(case: _Case) -> Finding | None:
    """Report a joint that does not come to rest."""
    swing = case.row.hunting_rad
    if swing is None or not case.hunts or (case.healthy is not None and not case.beyond("hunting_rad")):
        return None
    width = np.degrees(2 * 2**0.5 * swing.value)
    return case.finding(
        "play_in_loop",
        "hunting_rad",
        case.lever * swing.value * 2**0.5,
        f"hunts: it swings to and fro over {width:.1f} deg while it should hold still, as a servo does "
        "that has play between motor and encoder,",
    )


def torque_limit(case: _Case) -> Finding | None:
    """Report a motor at its limit that does not follow."""
    limit, k, width = case.row.torque_limit_nm, case.row.stiffness_nm_per_rad, case.row.hysteresis_rad
    if limit is None or k is None:
        return None
    explained = case.loads / k.value + (0.0 if width is None else max(width.value, 0.0) / 2)
    tcp = float((case.levers * np.maximum(case.errors - explained, 0.0)).mean())
    off = case.row.stuck_rad > STUCK_COUNTS * case.encoder_step
    stuck = f"; in some postures it stays {np.degrees(case.row.stuck_rad):.0f} deg off" if off else ""
    return case.finding(
        "torque_limit",
        "torque_limit_nm",
        tcp,
        f"runs out of torque: it spent {case.row.saturated_share * 100:.0f} % of the excitation at its limit{stuck}; "
        "at its targets this costs",
    )


def low_damping(case: _Case) -> Finding | None:
    """Report ringing after a move; at the torque limit, in every step."""
    ratio, overshoot = case.row.damping_ratio, case.row.overshoot
    if ratio is None or ratio.high is None or overshoot is None or not case.moves:
        return None
    if ratio.high >= RINGING_RATIO if case.healthy is None else not case.below("damping_ratio"):
        return None
    if ratio.high >= SWINGING_RATIO:
        return None
    over = overshoot.value
    if over < OVERSHOOT_ALLOWED:  # friction stops it: nothing that an owner would see
        return None
    if case.row.torque_limit_nm is not None and (overshoot.low is None or overshoot.low < OVERSHOOT_ALLOWED):
        return None
    return case.finding(
        "low_damping",
        "damping_ratio",
        case.lever * over * 0.2,
        f"rings: its damping ratio is {ratio.value:.2f}{_interval(ratio)}"
        f"{_against(case, 'damping_ratio', '.2f')}; after a step of 0.2 rad it shoots "
        f"{over * 100:.0f} % too far before it settles,",
    )


def lag(case: _Case) -> Finding | None:
    """Report a joint that is late, but not by a weak gain."""
    late, reference = case.row.lag_s, case.healthy.lag_s if case.healthy is not None else None
    if (
        late is None
        or late.low is None
        or reference is None
        or reference.high is None
        or case.below("stiffness_nm_per_rad")
    ):
        return None
    if late.low - case.common_lag <= reference.high:
        return None
    tcp = case.lever * WORKING_SPEED * (late.value - case.common_lag - reference.value)
    return case.finding(
        "lag",
        "lag_s",
        tcp,
        f"follows late: {late.value * 1e3:.0f} ms behind its command{_against(case, 'lag_s', '.0f', 1e3)}; "
        f"in motion at {WORKING_SPEED} rad/s that is",
    )


def offset(case: _Case) -> Finding | None:
    """Report the same offset everywhere, with or without load."""
    found, k, weight = case.row.offset_rad, case.row.stiffness_nm_per_rad, float(case.loads.mean())
    if found is None or not case.moves or (k is None and weight > UNLOADED):
        return None
    if not surely_offset(found, doubt=0.0 if k is None else GRAVITY_DOUBT * weight / k.value):
        return None
    return case.finding(
        "offset",
        "offset_rad",
        case.lever * abs(found.value),
        "has an offset: it rests beside its command by the same angle everywhere, also where nothing loads it,",
    )


def noise(case: _Case) -> Finding | None:
    """Report readings that jump though the joint is stationary."""
    level = case.row.noise_rad
    if level is None or not case.beyond("noise_rad") or case.hunts:
        return None
    return case.finding(
        "noise",
        "noise_rad",
        case.lever * level.value,
        f"has a restless encoder: readings scatter by {np.degrees(level.value):.2f} deg at rest,",
    )


RULES: tuple[Callable[[_Case], Finding | None], ...] = (
    stuck,
    weak_gain,
    friction,
    hysteresis,
    play_in_loop,
    torque_limit,
    low_damping,
    lag,
    offset,
    noise,
)
"""Rules for one joint"""


def _common_lag(measurement: Measurement, healthy: HealthyReference | None) -> float:
    """Return the common delay beyond the reference: bus or firmware, not wear."""
    if healthy is None:
        return 0.0
    pairs = [(row.lag_s, good.lag_s) for row, good in zip(measurement.joints, healthy.joints, strict=True)]
    excess = [late.value - usual.value for late, usual in pairs if late is not None and usual is not None]
    return max(float(np.median(excess)), 0.0) if excess else 0.0


def _interval(estimate: Estimate) -> str:
    return "" if estimate.low is None or estimate.high is None else f" ({estimate.low:.2f} to {estimate.high:.2f})"


def _against(case: _Case, quantity: str, digits: str, factor: float = 1.0) -> str:
    reference = getattr(case.healthy, quantity) if case.healthy is not None else None
    return "" if reference is None else f", a healthy one {factor * reference.value:{digits}}"
