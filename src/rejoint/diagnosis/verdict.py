"""Findings from numbers: what is worn, its error at the tool, and a sentence.

A finding's 95 % interval, of arms of one model without that model's doubt, lies outside the healthy range, on the bad
side. Without a reference only absolute faults count.
"""

from collections.abc import Callable

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, levers
from rejoint.arms.workspace import length_size
from rejoint.diagnosis.healthy import OVERSHOOT_ALLOWED, HealthyReference
from rejoint.diagnosis.measurement import NOT_KNOWN, OFFSET_ALLOWED, JointMetrics, Measurement
from rejoint.diagnosis.regression import mean_of
from rejoint.diagnosis.segments import Postures
from rejoint.system.records import entity, value_type
from rejoint.system.statistics import Estimate

BAD_MM = 3.0
"""Tool error of a bad finding: a healthy myCobot's (Park et al. 2024, section IV-B); goes with the reach"""

FELT_MM = 0.05
"""Tool error of a finding that counts; chosen"""

RINGING_RATIO = 0.4
"""Damping ratio of ringing without a reference: 25 % overshoot (second order)"""

SWINGING_RATIO = 0.5
"""Damping ratio without ringing: 16 % overshoot (second order)"""

SHOOTING = 0.25
"""Overshoot of ringing without a damping ratio: that of `RINGING_RATIO`"""

QUIET_COUNTS = 2.0
"""Encoder counts of rms motion at rest beyond flicker"""

SATURATED = 0.3
"""Share of time at the limit that hides stiffness and friction; chosen"""

FOLLOWS = 0.6
"""Least share of its commands that a joint follows, and over the largest; chosen: a worn one makes 0.7"""

STUCK_ERROR = 0.17
"""[rad] following error of a stuck joint without sweep; chosen: twice a worn joint's sag"""

GRAVITY_DOUBT = 0.2
"""Relative error of sag by wrong masses; chosen"""

UNLOADED = 1e-6
"""[N m] of gravity up to which a joint is unloaded: rounding"""

WORKING_SPEED = 0.5
"""[rad/s] at which a lag becomes millimetres; chosen"""


@value_type
class Finding:
    """One thing that is wrong with one joint."""

    joint: str
    kind: str
    """one of `RULES`"""
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


@entity
class _Case:
    row: JointMetrics
    healthy: JointMetrics | None
    levers: Array
    """(K,) [m/rad] of the TCP"""
    loads: Array
    """(K,) [N m] of gravity"""
    leads: Array
    """(K,) [rad] settled command minus reading"""
    encoder_step: float
    """[rad]"""
    common_lag: float
    """[s] delay of all joints"""

    @property
    def errors(self) -> Array:
        return np.abs(self.leads)

    @property
    def lever(self) -> float:
        """[m/rad] mean."""
        return self.levers.mean()

    @property
    def moves(self) -> bool:
        return self.row.lag_s is not None and self.row.saturated_share <= SATURATED

    @property
    def hunts(self) -> bool:
        return self.low("hunting_rad") > QUIET_COUNTS * self.encoder_step

    @property
    def soft(self) -> bool:
        return self.below("stiffness_nm_per_rad") or self.below("modelled_nm_per_rad")

    @property
    def rubs(self) -> bool:
        kept = self.low("modelled_nm_per_rad") > _end(self.usual("modelled_nm_per_rad").low)
        return self.beyond("coulomb_nm") or (kept and self.beyond("hysteresis_rad"))

    def value(self, quantity: str) -> float:
        return _known(self.row, quantity).value

    def low(self, quantity: str) -> float:
        return _end(_known(self.row, quantity).low)

    def high(self, quantity: str) -> float:
        return _end(_known(self.row, quantity).high)

    def usual(self, quantity: str) -> Estimate:
        """Healthy value and range."""
        return _known(self.healthy, quantity)

    def beyond(self, quantity: str) -> bool:
        """Whether the whole interval lies above the healthy range."""
        return self.low(quantity) > _end(self.usual(quantity).high)

    def below(self, quantity: str) -> bool:
        return self.high(quantity) < _end(self.usual(quantity).low)

    def against(self, quantity: str, digits: str, factor: float = 1.0) -> str:
        """Name the healthy value, if any."""
        value = factor * self.usual(quantity).value
        return "" if np.isnan(value) else f", a healthy one {value:{digits}}"


def _known(row: JointMetrics | None, quantity: str) -> Estimate:
    return getattr(row, quantity, None) or NOT_KNOWN


def _end(end: float | None) -> float:
    return np.nan if end is None else end


Found = tuple[float, str] | None
"""Error [m] at the tool, and words between joint and cost; None: nothing found"""


def find(
    arm: Arm, measurement: Measurement, postures: Postures, healthy: HealthyReference | None
) -> tuple[Finding, ...]:
    """Name everything that is wrong, largest tool error first."""
    position, command = postures
    moved, loads, leads = levers(arm, position), np.abs(gravity_torque(arm, position)), command - position
    common, bad = _common_lag(measurement, healthy), BAD_MM * length_size(arm)
    found = []
    for joint, row in enumerate(measurement.joints):
        case = _Case(
            row=row,
            healthy=None if healthy is None else healthy.joints[joint],
            levers=moved[:, joint],
            loads=loads[:, joint],
            leads=leads[:, joint],
            encoder_step=arm.encoder_step,
            common_lag=common,
        )
        for kind, (quantity, _, rule) in RULES.items():
            turned = (row.sweep_gain or 0.0) < 0.0 and kind != "stuck"  # then no number means anything
            told = None if (turned or kind in SEEMING) and stuck(case) else rule(case)
            if told is None:
                continue
            tcp = 1e3 * told[0]
            cost = f"{tcp:.1f} mm at the tool." if tcp >= FELT_MM else "nothing that the tip of the tool feels."
            found.append(
                Finding(
                    joint=row.joint,
                    kind=kind,
                    severity="bad" if tcp >= bad else "worn",
                    quantity=quantity,
                    measured=getattr(row, quantity, None) or mean_of(case.errors),
                    healthy=getattr(case.healthy, quantity, None),
                    tcp_mm=tcp,
                    sentence=f"{row.joint} {told[1]} {cost}",
                )
            )
    return tuple(sorted(found, key=lambda f: (f.severity != "bad", -f.tcp_mm)))


def chord(angle: Array) -> Array:
    """Distance per lever of an ``angle`` [rad]."""
    return 2.0 * np.sin(np.minimum(np.abs(angle), np.pi) / 2.0)


def stuck(case: _Case) -> Found:
    """Report a joint that does not move when commanded, or is beyond measurement."""
    gain, far = case.row.sweep_gain, case.errors.max()
    if gain is not None:  # one that breaks loose on a long way may come near its targets, and stick elsewhere
        far = max(far, case.row.stuck_rad)
    follows = gain is not None and FOLLOWS < gain < 1.0 / FOLLOWS and case.row.stuck_rad < 2.0 * STUCK_ERROR
    if follows or far < STUCK_ERROR:
        return None
    why = ", has no power, or its reading is another joint's, turned round, or has another zero or scale"
    if case.row.torque_limit_nm is not None:
        why = f", and spent {case.row.saturated_share * 100:.0f} % of the excitation at its torque limit"
    resting = case.errors.max() >= STUCK_ERROR  # else it rests where it has begun, or never
    return (case.levers * chord(case.errors if resting else far)).mean(), (
        f"does not follow: it stood up to {np.degrees(far):.0f} deg off where it was sent, so it is too weak for its "
        f"load or blocked{why}; this costs{'' if resting else ' up to'}"
    )


def weak_gain(case: _Case) -> Found:
    """Report a servo with too little torque per following error."""
    if not case.soft or not case.moves:
        return None
    k, weight = case.value("stiffness_nm_per_rad"), (case.levers * case.loads).mean()
    held = case.lever * np.nan_to_num(case.value("coulomb_nm"))
    sags = f"sags under the arm's own weight: it hangs {np.degrees(case.loads.mean() / k):.1f} deg low"
    cost = min((weight + held) / k, (case.levers * case.errors).mean() if case.errors.any() else np.inf)
    return cost, f"is soft and {sags if weight > held else 'stops short of where it is sent'},"


def friction(case: _Case) -> Found:
    """Report a joint that is hard to move."""
    if not case.rubs or not case.moves or case.hunts:
        return None
    half = case.value("hysteresis_rad") / 2
    return case.lever * half, f"is stiff to turn: it stops up to {np.degrees(half):.2f} deg short on either side,"


def hysteresis(case: _Case) -> Found:
    """Report a joint that stops short for an unclear reason."""
    explained = case.soft or case.rubs
    if not case.beyond("hysteresis_rad") or explained or not case.moves or case.hunts:
        return None
    width, rest = case.value("hysteresis_rad"), (case.levers * case.errors).mean()
    return max(case.lever * width / 2, rest), (
        f"stops short: coming from below and from above it rests {np.degrees(width):.2f} deg apart"
        f"{case.against('hysteresis_rad', '.2f', np.degrees(1.0))}; whether it is stiff to turn or soft, or both, "
        "cannot be told;"
    )


def play_in_loop(case: _Case) -> Found:
    """Report a joint that does not come to rest."""
    if not case.hunts or (case.healthy and not case.beyond("hunting_rad")):
        return None
    swing = 2**0.5 * case.value("hunting_rad")
    return case.lever * swing, (
        f"hunts: it swings to and fro over {np.degrees(2 * swing):.1f} deg while it should hold still, as a servo does "
        "that has play between motor and encoder,"
    )


def torque_limit(case: _Case) -> Found:
    """Report a motor at its limit that does not follow."""
    if case.row.torque_limit_nm is None:  # which no joint of unknown stiffness has
        return None
    explained = case.loads / case.value("stiffness_nm_per_rad") + np.nan_to_num(case.value("hysteresis_rad")) / 2
    return (case.levers * np.maximum(case.errors - explained, 0.0)).mean(), (
        f"runs out of torque: it spent {case.row.saturated_share * 100:.0f} % of the excitation at its limit; at its "
        "targets this costs"
    )


def low_damping(case: _Case) -> Found:
    """Report ringing after a move; at the torque limit or without a damping ratio, in every step."""
    ratio, over, least = case.row.damping_ratio, case.value("overshoot"), OVERSHOOT_ALLOWED
    high, limited = case.high("damping_ratio"), case.row.torque_limit_nm is not None
    rings = high < SWINGING_RATIO and (high < RINGING_RATIO if case.healthy is None else case.below("damping_ratio"))
    if ratio is None:  # logs alone
        least = np.fmax(SHOOTING, _end(case.usual("overshoot").high))
        rings, limited = case.row.stuck_rad < STUCK_ERROR, True
    if not rings or not (case.low("overshoot") if limited else over) >= least or not case.moves:  # friction stops it
        return None
    told = ratio and f"its damping ratio is {ratio.value:.2f}{case.against('damping_ratio', '.2f')}; "
    return case.lever * over * 0.2, (
        f"rings: {told or ''}after a step of 0.2 rad it shoots {over * 100:.0f} % too far before it settles,"
    )


def lag(case: _Case) -> Found:
    """Report a joint that is late, but not by a weak gain, which widens its hysteresis as much."""
    usual, late = case.usual("lag_s"), case.value("lag_s")
    wider = case.value("hysteresis_rad") / case.usual("hysteresis_rad").value if hysteresis(case) else 1.0
    if case.soft or not case.low("lag_s") - case.common_lag > wider * _end(usual.high):
        return None
    return case.lever * WORKING_SPEED * (late - case.common_lag - usual.value), (
        f"follows late: {late * 1e3:.0f} ms behind its command{case.against('lag_s', '.0f', 1e3)}; "
        f"in motion at {WORKING_SPEED} rad/s that is"
    )


def offset(case: _Case) -> Found:
    """Report the same offset everywhere, with or without load."""
    k, weight = case.row.stiffness_nm_per_rad, case.loads.mean()
    if not case.moves or (k is None and weight > UNLOADED):
        return None
    doubt = 0.0 if k is None else GRAVITY_DOUBT * weight / k.value
    if not max(case.low("offset_rad"), -case.high("offset_rad")) > OFFSET_ALLOWED + doubt:
        return None
    cost = case.lever * abs(case.value("offset_rad"))
    if case.leads.any():  # a servo with an integral term rests nearer, one with friction on either side
        rest = case.lever * abs(case.leads.mean())
        if case.healthy is None and rest < 0.5 * cost:  # an unknown servo: the integral may be all of it
            return None
        cost = min(cost, rest)
    return cost, "has an offset or a dead band: it rests beside its command by about the same angle everywhere,"


def noise(case: _Case) -> Found:
    """Report readings that jump though the joint is stationary."""
    if not case.beyond("noise_rad") or case.hunts:
        return None
    level = case.value("noise_rad")
    return case.lever * level, f"has a restless encoder: readings scatter by {np.degrees(level):.2f} deg at rest,"


RULES: dict[str, tuple[str, str, Callable[[_Case], Found]]] = {
    "stuck": ("following_error_rad", "not following its commands", stuck),
    "weak_gain": ("stiffness_nm_per_rad", "soft, so that it sags or stops short", weak_gain),
    "friction": ("coulomb_nm", "stiff to turn", friction),
    "hysteresis": ("hysteresis_rad", "stopping short of where it is sent", hysteresis),
    "play_in_loop": ("hunting_rad", "loose inside its servo loop, so that it hunts", play_in_loop),
    "torque_limit": ("torque_limit_nm", "out of torque", torque_limit),
    "low_damping": ("overshoot", "badly damped, so that it rings", low_damping),
    "lag": ("lag_s", "late", lag),
    "offset": ("offset_rad", "beside its commands everywhere", offset),
    "noise": ("noise_rad", "restless in its readings", noise),
}
"""By kind of finding: judged quantity, what it makes of a joint, and rule"""
SEEMING = ("lag", "offset", "torque_limit", "hysteresis")
"""Kinds not named of joints that do not follow"""


def _common_lag(measurement: Measurement, healthy: HealthyReference | None) -> float:
    """Return the common delay [s] beyond the reference: bus or firmware, not wear."""
    rows = zip(measurement.joints, (healthy or measurement).joints, strict=True)
    excess = [late.value - usual.value for row, good in rows if (late := row.lag_s) and (usual := good.lag_s)]
    return max(np.median(excess), 0.0) if excess else 0.0
