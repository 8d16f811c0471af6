"""The diagnosis of an arm: measurements, findings and a verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rejoint.arms import Arm
from rejoint.arms.workspace import length_size
from rejoint.control.recording import OnCycle
from rejoint.control.robot import Robot
from rejoint.diagnosis.excitation import FULL, DiagnosisLogs, Plan, record
from rejoint.diagnosis.healthy import HealthyReference
from rejoint.diagnosis.measurement import JointMetrics, Measurement, measure
from rejoint.diagnosis.open_loop import OpenLoop, open_loop_errors, settled_postures
from rejoint.diagnosis.verdict import Finding, find
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.statistics import Estimate


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the logs of a diagnosis hold."""

    motions: int
    seconds: float
    free_seconds: float
    contact_seconds: float
    """with the tool on a table, recovery included"""
    stop_seconds: float
    """with a joint at a stop, recovery included"""
    dead_seconds: float
    """of frozen readings, recovery included"""
    table_height_m: float | None
    """in the base frame; None without contact"""
    rest_error_mm: Estimate | None
    """between target and rest, by encoders; None without rest"""


HIDDEN_MARGIN_MM = 1.0
"""Distance of tool and encoders, beyond the healthy range, by wear on a myCobot 280; goes with the reach; chosen"""

KINDS = {
    "stuck": "stuck or without power",
    "weak_gain": "soft, so that it sags or stops short",
    "friction": "stiff to turn",
    "hysteresis": "stopping short of where it is sent",
    "play_in_loop": "loose inside its servo loop, so that it hunts",
    "torque_limit": "out of torque",
    "low_damping": "badly damped, so that it rings",
    "lag": "late",
    "offset": "beside its commands everywhere",
    "noise": "restless in its readings",
}
"""What each kind of finding makes of a joint"""


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What is wrong with an arm."""

    arm: str
    robot: str
    condition: str
    """ok, worn, bad or unknown"""
    verdict: str
    """sentences for the user"""
    findings: tuple[Finding, ...]
    """largest tool error first"""
    unseen: tuple[str, ...]
    """what encoders cannot tell, in sentences"""
    open_loop: OpenLoop | None
    """None for logs of other motion"""
    measurement: Measurement
    healthy: HealthyReference | None
    evidence: Evidence | None = None
    """of a diagnosis from logs"""
    servo_gains: dict[str, tuple[int, ...]] | None = None
    """one per joint (`rejoint.control.servogains`)"""


def diagnose(
    robot: Robot,
    healthy: HealthyReference | None,
    *,
    seed: int,
    plan: Plan = FULL,
    on_progress: Progress = no_progress,
    on_cycle: OnCycle | None = None,
) -> tuple[Diagnosis, DiagnosisLogs]:
    """Drive one arm through ten targets and the excitation; judge the logs."""
    if robot.count != 1:
        raise InputError(f"a diagnosis is of one arm, {robot.address} has {robot.count}; use `record` for a batch")
    logs = record(robot, seed=seed, plan=plan, on_progress=on_progress, on_cycle=on_cycle)[0]
    return judge(robot.arm, logs, healthy), logs


def judge(arm: Arm, logs: DiagnosisLogs, healthy: HealthyReference | None) -> Diagnosis:
    """Judge an arm by its logs; InputError if unfit or too short."""
    if healthy is not None and healthy.arm != arm.name:
        raise InputError(f"the healthy reference is of arm {healthy.arm}, expected {arm.name}")
    measurement = measure(arm, logs.excitation, None if healthy is None else healthy.motors_kg_m2)
    open_loop = open_loop_errors(arm, logs.targets)
    findings = find(arm, measurement, settled_postures(logs.targets), healthy)
    return Diagnosis(
        arm=arm.name,
        robot=logs.targets.robot,
        condition="worn" if _unexplained(open_loop, findings, healthy) else condition_of(findings),
        verdict=_verdict(open_loop, findings, healthy),
        findings=findings,
        unseen=_unseen(open_loop, measurement, healthy, HIDDEN_MARGIN_MM * length_size(arm)),
        open_loop=open_loop,
        measurement=measurement,
        healthy=healthy,
    )


def condition_of(findings: tuple[Finding, ...]) -> str:
    """Return ``ok``, ``worn`` or ``bad``."""
    return "bad" if any(f.severity == "bad" for f in findings) else "worn" if findings else "ok"


def _verdict(open_loop: OpenLoop, findings: tuple[Finding, ...], healthy: HealthyReference | None) -> str:
    error = open_loop.error_mm
    reference = (
        "" if healthy is None else f"; a healthy arm of this kind{healthy.setting}: {healthy.error_mm.value:.1f} mm"
    )
    first = (
        f"This arm misses its targets by {error.value:.1f} mm (mean of {len(open_loop.targets)}, spread "
        f"{open_loop.spread_mm:.1f} mm, by its own encoders{reference})."
    )
    if _unexplained(open_loop, findings, healthy):
        return (
            f"{first} No joint shows why: look for a load at the tool, for something in its way, and for offsets too "
            "small to name (a twin fits them)."
        )
    if not findings:
        return f"{first} No joint shows wear that its encoder can see."
    felt = tuple(finding for finding in findings if finding.felt)
    ringing = ringing_most(findings)
    named, worst, more = causes(felt or findings, findings, ringing)
    lead = "Because" if error.value > (healthy.error_mm.high or 0.0 if healthy else 0.0) else "What is worn"
    return f"{first} {lead}: {named}.{'' if ringing in worst else _rings(ringing, findings)}{more}"


def causes(
    shown: tuple[Finding, ...], all_of_them: tuple[Finding, ...], told: Finding | None = None
) -> tuple[str, list[Finding], str]:
    """Name the worst findings of the three worst joints, count the others."""
    joints = {finding.joint: finding for finding in reversed(shown)}  # the worst finding of a joint wins
    worst = sorted(joints.values(), key=lambda f: -f.tcp_mm)[:3]
    named = "; ".join(f"{f.joint} is {KINDS[f.kind]} ({f.tcp_mm:.1f} mm)" for f in worst)
    others = len({f.joint for f in all_of_them} - {f.joint for f in (*worst, *([told] if told else []))})
    return named, worst, f" {others} more joint{'s show' if others > 1 else ' shows'} wear." if others else ""


def _unexplained(open_loop: OpenLoop, findings: tuple[Finding, ...], healthy: HealthyReference | None) -> bool:
    least, usual = open_loop.error_mm.low, None if healthy is None else healthy.error_mm.high
    return not findings and least is not None and usual is not None and least > usual


def ringing_most(findings: tuple[Finding, ...]) -> Finding | None:
    """Return the finding of the joint that rings most, if any."""
    return min((f for f in findings if f.kind == "low_damping"), key=lambda f: f.measured.value, default=None)


def _rings(ringing: Finding | None, findings: tuple[Finding, ...]) -> str:
    if ringing is None:
        return ""
    most = " most" if sum(f.kind == ringing.kind for f in findings) > 1 else ""
    usual = "" if ringing.healthy is None else f", a healthy one {ringing.healthy.value:.2f}"
    return f" {ringing.joint} rings{most} (damping ratio {ringing.measured.value:.2f}{usual})."


def _unseen(
    open_loop: OpenLoop, measurement: Measurement, healthy: HealthyReference | None, margin_mm: float
) -> tuple[str, ...]:
    return (
        _hidden(open_loop, healthy, margin_mm),
        "Play inside the servo loop shows only where the load on a joint changes its side; a joint that always "
        "carries weight rests on one flank.",
        *untold(measurement, QUESTIONS),
    )


QUESTIONS: dict[str, Callable[[JointMetrics], bool]] = {
    "The stiffness of {} cannot be told from this log.": lambda row: row.stiffness_source == "none",
    "{} moved too little for friction, lag and torque limit to show, as a joint does that sticks or is too weak.": (
        lambda row: row.lag_s is None
    ),
    "The torque limit of {} was not reached.": lambda row: row.torque_limit_nm is None and row.lag_s is not None,
}
"""What an excitation leaves open, and of which joints"""


def untold(measurement: Measurement, questions: Mapping[str, Callable[[JointMetrics], bool]]) -> tuple[str, ...]:
    """Sentences about what is not known, with the joints that they hold for."""
    named = {words: [row.joint for row in measurement.joints if asks(row)] for words, asks in questions.items()}
    whole = len(measurement.joints)
    return tuple(
        words.format("every joint" if len(joints) == whole else ", ".join(joints))
        for words, joints in named.items()
        if joints
    )


def _hidden(open_loop: OpenLoop, healthy: HealthyReference | None, margin_mm: float) -> str:
    if open_loop.hidden_mm is None or open_loop.true_error_mm is None:
        return (
            "Play and flex behind the encoders, and so the true error of the tool, cannot be seen. A few measured "
            "points of the tool would tell."
        )
    known = (
        f"The emulator knows where the tool really is: {open_loop.hidden_mm:.1f} mm from where the encoders put it, "
        f"and {open_loop.true_error_mm.value:.1f} mm from the targets"
    )
    usual = healthy.hidden_mm.high if healthy is not None and healthy.hidden_mm is not None else None
    if usual is not None and open_loop.hidden_mm > usual + margin_mm:
        return (
            f"{known}. There is play or flex behind the encoders; on a real arm nothing in these logs would show it, "
            "and no controller that relies on the encoders can remove it."
        )
    return f"{known}: about as much as in a healthy arm."
