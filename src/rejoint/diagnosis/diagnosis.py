"""The diagnosis of an arm: everything measured, everything found, and a verdict that an owner understands."""

from __future__ import annotations

from dataclasses import dataclass

from rejoint.arms import Arm
from rejoint.arms.size import length_size
from rejoint.control.recording import OnCycle
from rejoint.control.robot import Robot
from rejoint.diagnosis.evidence import Evidence
from rejoint.diagnosis.excitation import FULL, Plan
from rejoint.diagnosis.healthy import HealthyReference
from rejoint.diagnosis.measurement import Measurement, measure
from rejoint.diagnosis.open_loop import OpenLoop, open_loop_errors
from rejoint.diagnosis.postures import settled_postures
from rejoint.diagnosis.record import DiagnosisLogs, record
from rejoint.diagnosis.verdict import Finding, find
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress

HIDDEN_MARGIN_MM = 1.0
"""Distance between tool and encoders, beyond the healthy range, from which it is called wear on a myCobot 280 (chosen);
goes with the reach."""

KINDS = {
    "stuck": "stuck",
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
"""What each kind of finding makes of a joint, in words"""


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What is wrong with an arm; plain data that `rejoint.system.files.write_json` can write."""

    arm: str
    robot: str
    """address"""
    condition: str
    """ok, worn or bad; unknown where logs of other motion do not tell"""
    verdict: str
    """for the owner, in sentences"""
    findings: tuple[Finding, ...]
    """the worst at the tool first"""
    unseen: tuple[str, ...]
    """what the encoders cannot tell, in sentences"""
    open_loop: OpenLoop | None
    """ten targets; None where there are only logs of other motion"""
    measurement: Measurement
    """every joint in numbers"""
    healthy: HealthyReference | None
    """what it was compared with"""
    evidence: Evidence | None = None
    """what the logs hold where there are only logs"""
    servo_gains: dict[str, tuple[int, ...]] | None = None
    """of the servos' own loops meanwhile, one of each joint (`rejoint.control.servogains`); None: not told"""


def diagnose(
    robot: Robot,
    healthy: HealthyReference | None,
    *,
    seed: int,
    plan: Plan = FULL,
    on_progress: Progress = no_progress,
    on_cycle: OnCycle | None = None,
) -> tuple[Diagnosis, DiagnosisLogs]:
    """Drive one arm through ten targets and the excitation, and judge what it did."""
    if robot.count != 1:
        raise InputError(f"a diagnosis is of one arm, {robot.address} has {robot.count}; use `record` for a batch")
    logs = record(robot, seed=seed, plan=plan, on_progress=on_progress, on_cycle=on_cycle)[0]
    return judge(robot.arm, logs, healthy), logs


def judge(arm: Arm, logs: DiagnosisLogs, healthy: HealthyReference | None) -> Diagnosis:
    """Judge an arm by its logs alone; InputError if they do not fit the arm or hold too little."""
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
    joints = {finding.joint: finding for finding in reversed(findings)}  # the worst finding of a joint wins
    felt = [finding for finding in joints.values() if finding.felt]
    causes = sorted(felt or joints.values(), key=lambda f: -f.tcp_mm)[:3]
    named = "; ".join(f"{f.joint} is {KINDS[f.kind]} ({f.tcp_mm:.1f} mm)" for f in causes)
    ringing = ringing_most(findings)
    others = len({*joints} - {f.joint for f in (*causes, *([ringing] if ringing else []))})
    more = f" {others} more joint{'s show' if others > 1 else ' shows'} wear." if others else ""
    lead = "Because" if error.value > (healthy.error_mm.high or 0.0 if healthy else 0.0) else "What is worn"
    return f"{first} {lead}: {named}.{'' if ringing in causes else _rings(ringing, findings)}{more}"


def _unexplained(open_loop: OpenLoop, findings: tuple[Finding, ...], healthy: HealthyReference | None) -> bool:
    """Whether an arm surely misses its targets by more than a healthy one, and no finding says why."""
    least, usual = open_loop.error_mm.low, None if healthy is None else healthy.error_mm.high
    return not findings and least is not None and usual is not None and least > usual


def ringing_most(findings: tuple[Finding, ...]) -> Finding | None:
    """Return the finding of the joint with the lowest damping ratio among those that ring, if any does.

    It costs little at rest, so the millimetres hide it, but it is what an owner sees.
    """
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
    lines = [_hidden(open_loop, healthy, margin_mm)]
    guessed = [row.joint for row in measurement.joints if row.stiffness_source == "inertia"]
    unknown = [row.joint for row in measurement.joints if row.stiffness_source == "none"]
    if guessed:
        lines.append(
            f"The weight on {', '.join(guessed)} is none or changes too little: their stiffness and friction follow "
            "from how they accelerate, given the motor inertia of a healthy arm or of the nearest joint whose weight "
            "changes."
        )
    if unknown:
        lines.append(f"The stiffness of {', '.join(unknown)} cannot be told from this log.")
    lines.append(
        "Play inside the servo loop shows only where the load on a joint changes its side; a joint that always "
        "carries weight rests on one flank."
    )
    blind = [row.joint for row in measurement.joints if row.lag_s is None]
    if blind:
        lines.append(
            f"In the slow sweeps {', '.join(blind)} moved too little for friction, lag and torque limit to show, as a "
            "joint does that sticks or is too weak."
        )
    free = [row.joint for row in measurement.joints if row.torque_limit_nm is None and row.lag_s is not None]
    if free:
        lines.append(f"The torque limit of {', '.join(free)} was not reached.")
    return tuple(lines)


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
