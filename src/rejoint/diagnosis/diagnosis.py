"""The diagnosis of an arm: measurements, findings and a verdict, from its excitation or from logs of any motion."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, levers, tcp_position
from rejoint.control.correction import tool_error
from rejoint.diagnosis.excitation import DiagnosisLogs
from rejoint.diagnosis.healthy import HealthyReference
from rejoint.diagnosis.measurement import Measurement, measure, measure_logs, sag_doubt
from rejoint.diagnosis.metrics import COARSEST
from rejoint.diagnosis.regression import mean_of
from rejoint.diagnosis.segments import (
    FREE,
    SHORTEST,
    OpenLoop,
    Postures,
    join_logs,
    open_loop_errors,
    resting_postures,
    settled_postures,
)
from rejoint.diagnosis.verdict import RULES, Finding, chord, find
from rejoint.logs.columns import ZEROS
from rejoint.logs.consistency import refuse_copies, remarks_on, require_commands, states_alone
from rejoint.logs.exclusions import (
    UNPOWERED,
    Exclusions,
    answered,
    find_exclusions,
    powered,
    table_height,
    unpowered_joints,
)
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.records import Readable, value_type
from rejoint.system.statistics import Estimate


@value_type
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

    @property
    def left_out(self) -> str:
        """Time without free arm, to end a sentence."""
        parts = {
            "with the tool on a table": self.contact_seconds,
            "at a stop": self.stop_seconds,
            "of dead readings": self.dead_seconds,
        }
        named = [f"{seconds:.0f} s {what}" for what, seconds in parts.items() if seconds >= 0.5]
        return f"; left out: {', '.join(named)}" if named else ""


MANY = 8
"""Logs from which each is one observation; chosen"""

EXPLAINED = 0.5
"""Share of the error above which findings are its cause; chosen"""

CAUSE = 3.0
"""Times the error above which a finding is of elsewhere; chosen: errors of joints may cancel"""

AGREE = 1.25
"""Ratio of torque and load not named; chosen"""

IN_MOTION = ("low_damping", "lag")
"""Kinds that move no joint from where it rests"""

UNKNOWN = {
    "stiffness_nm_per_rad": "The stiffness of {}, and so the torque that friction takes, cannot be told. Gravity does "
    "not load it enough in these motions, its controller may carry the weight, or they disagree too much. Where load "
    "or tool changed between them, diagnose those logs apart.",
    "lag_s": "Hysteresis, lag and zero of {} cannot be told: too little slow motion, as of a joint that sticks or is "
    "too weak, in one direction only, or with readings too far apart.",
    "overshoot": "Whether {} shoots over cannot be told: too few steps.",
    "noise_rad": "Noise and unrest of {} cannot be told: the arm hardly rests while no command moves.",
    "torque_limit_nm": "The torque limit of {} was not seen.",
}
"""What motions leave open where a quantity is unknown"""

BEHIND = "Encoders see no play and flex behind them, and so not the true error of the tool: measured points would tell."
BARE = "Stiffness, lag, zeros, overshoot and noise cannot be told without commands."
LAG_ALONE = (
    "Lag here holds the delay of commands and answers, and damping is part of it: `rejoint diagnose ROBOT` tells them "
    "apart."
)
FLANK = (
    "Play inside the servo loop shows only where the load on a joint changes its side; a joint that always carries "
    "weight rests on one flank."
)


@value_type
class Diagnosis(Readable):
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
    measurement: Measurement
    healthy: HealthyReference | None
    open_loop: OpenLoop | None = None
    """None for logs of other motion"""
    evidence: Evidence | None = None
    """of a diagnosis from logs"""
    servo_gains: dict[str, tuple[int, ...]] | None = None
    """one per joint (`rejoint.control.servogains`)"""
    doubt: str = ""
    """what explains the sag better than the model"""


def judge(arm: Arm, logs: DiagnosisLogs, healthy: HealthyReference | None) -> Diagnosis:
    """Judge an arm by its logs; InputError if unfit or too short."""
    measurement = measure(arm, logs.excitation, None if healthy is None else healthy.motors_kg_m2)
    loop = open_loop_errors(arm, logs.targets)
    rest = settled_postures(logs.targets)
    findings = find(arm, measurement, rest, healthy)
    most = (healthy and healthy.error_mm and healthy.error_mm.high) or np.inf
    condition = _condition(findings, measurement, healthy)
    nothing = _nothing(arm, measurement, rest, healthy)
    doubt = sag_doubt(join_logs(arm, find_exclusions(arm, [logs.targets, logs.excitation])))
    if condition == "ok" and (loop.error_mm.low or 0.0) > most:
        condition = "worn"
        nothing = (
            "No joint shows why: look for a load at the tool, for something in its way, and for offsets too small to "
            "name (a twin fits them)."
        )
    return Diagnosis(
        arm=arm.name,
        robot=logs.targets.robot,
        condition=condition,
        verdict=(
            f"This arm misses its targets by {loop.error_mm.value:.1f} mm (mean of {len(loop.targets)}, spread "
            f"{loop.spread_mm:.1f} mm, by its own encoders{_usual(healthy)}). "
            f"{_verdict_of(findings, loop.error_mm, healthy, nothing)}{doubt and f' But {doubt}.'}"
        ),
        findings=findings,
        unseen=(BEHIND, FLANK, *_untold(measurement)),
        open_loop=loop,
        measurement=measurement,
        healthy=healthy,
        doubt=doubt,
    )


def diagnose_logs(
    arm: Arm,
    logs: Sequence[RunLog],
    healthy: HealthyReference | None,
    *,
    source: str = "logs",
    on_progress: Progress = no_progress,
) -> Diagnosis:
    """Judge an arm by logs of any motion; InputError for another arm or too little free motion."""
    refuse_copies(logs, "diagnosis")
    off = set(arm.joint_names).intersection(*(log.extra.get(UNPOWERED, "").split(",") for log in logs))  # as declared
    logs = powered(arm, logs)
    bare = states_alone(logs, "diagnosis")
    if any(log.torque is None and log.current is None for log in logs):
        require_commands(logs, "diagnosis")
    on_progress(0.0, "contacts and stops")
    height = table_height(arm, list(map(answered, logs)))
    excluded = find_exclusions(arm, logs, height)
    evidence = _evidence(arm, excluded, height)
    data = join_logs(arm, excluded)
    if not data.of_kind(FREE):
        raise InputError(
            f"diagnosis: no {SHORTEST:g} s of free motion in one piece{evidence.left_out}; record longer motions, off "
            "table and stops, or give the right zeros of the joints, which look like a table too"
        )
    on_progress(0.1, "joints")
    measurement = measure_logs(data)
    rest = _rest(excluded)
    findings = () if bare else tuple(one for one in find(arm, measurement, rest, healthy) if one.joint not in off)
    grown = _grown(measurement, healthy) if bare else None
    told = _by_effort(measurement, grown)
    if not bare:
        told = _verdict_of(findings, evidence.rest_error_mm, healthy, _nothing(arm, measurement, rest, healthy))
    silent = Counter(joint for log in logs for joint in unpowered_joints(log))
    doubt = data.log.extra.get(ZEROS) or sag_doubt(data)
    return Diagnosis(
        arm=arm.name,
        robot=source,
        condition="worn" if grown else _condition(findings, measurement, healthy),
        verdict=(
            f"{_resting(evidence, healthy, [*silent])}{told} {doubt and f'But {doubt}. '}"
            f"Recorded motions: {evidence.motions}, {evidence.free_seconds:.0f} s in free space{evidence.left_out}."
        ),
        findings=findings,
        unseen=(
            *(
                f"{joint} does not answer in {n} of {len(logs)} logs: unpowered, too weak or stuck."
                for joint, n in silent.items()
            ),
            *((BARE,) if bare else (*_untold(measurement), LAG_ALONE)),
            *_doubted(measurement),
            BEHIND,
            *(f"{remark}." for remark in remarks_on(logs)),
        ),
        measurement=measurement,
        healthy=healthy,
        evidence=evidence,
        doubt=doubt,
    )


def _condition(findings: tuple[Finding, ...], measurement: Measurement, healthy: HealthyReference | None) -> str:
    if findings:
        return "bad" if any(f.severity == "bad" for f in findings) else "worn"
    told = healthy is not None and any(row.lag_s is not None for row in measurement.joints)
    return "ok" if told else "unknown"


def _verdict_of(
    findings: tuple[Finding, ...], error: Estimate | None, healthy: HealthyReference | None, nothing: str
) -> str:
    """Name the worst findings of the three worst joints, and the others; ``nothing`` without findings."""
    if not findings:
        return nothing
    felt = [finding for finding in findings if finding.felt] or findings
    value = error.value if error else 0.0
    missed = value > ((healthy and healthy.error_mm and healthy.error_mm.high) or 0.0)
    standing = [one for one in felt if missed and one.kind not in IN_MOTION and one.tcp_mm < CAUSE * value]
    felt = standing or felt
    joints = {finding.joint: finding for finding in reversed(felt)}  # the worst finding of a joint wins
    worst = sorted(joints.values(), key=lambda f: -f.tcp_mm)[:3]
    named = "; ".join(f"{f.joint} is {RULES[f.kind][1]} ({f.tcp_mm:.1f} mm)" for f in worst)
    others = ", ".join(sorted({f.joint for f in findings} - {f.joint for f in worst}))
    enough = standing and sum(f.tcp_mm for f in standing) > EXPLAINED * value
    return f"{'Because' if enough else 'What is worn'}: {named}.{others and f' Wear shows at {others} too.'}"


def _usual(healthy: HealthyReference | None) -> str:
    if not (healthy and healthy.error_mm):
        return ""
    setting = healthy.setting and f" with {healthy.setting}"
    return f"; a healthy arm of this kind{setting}: {healthy.error_mm.value:.1f} mm"


def _untold(measurement: Measurement) -> tuple[str, ...]:
    rows, told = measurement.joints, []
    for quantity, words in UNKNOWN.items():
        joints = [row.joint for row in rows if getattr(row, quantity) is None]
        if joints:
            told.append(words.format("every joint" if len(joints) == len(rows) else ", ".join(joints)))
    return tuple(told)


def _doubted(measurement: Measurement) -> tuple[str, ...]:
    over = measurement.torque_over_load or 1.0
    if 1.0 / AGREE < over < AGREE:
        return ()
    return (
        f"Logged torque is {over:.4g} times what carries the weight of the model: check its sign and unit, the masses "
        "and load of the arm, and how its base is mounted.",
    )


def _evidence(arm: Arm, excluded: Sequence[Exclusions], height: float | None) -> Evidence:
    def seconds(kind: str) -> float:
        return sum(getattr(rows, kind)[1:] @ np.diff(rows.log.time) for rows in excluded)

    return Evidence(
        motions=len(excluded),
        seconds=sum(rows.log.duration for rows in excluded),
        **{f"{kind}_seconds": seconds(kind) for kind in ("free", "contact", "stop")},
        dead_seconds=seconds("stale"),
        table_height_m=height,
        rest_error_mm=_rest_error(arm, excluded),
    )


def _rest_error(arm: Arm, excluded: Sequence[Exclusions]) -> Estimate | None:
    means: list[float] = []
    for rows in excluded:
        position, command = resting_postures(replace(rows, log=answered(rows.log)))
        moot = ZEROS in rows.log.extra or len(unpowered_joints(rows.log)) == arm.joints
        if moot or not len(position):
            continue
        error = 1e3 * tool_error(arm, position, tcp_position(arm, command))
        _, place, count = np.unique(np.round(command, 3), axis=0, return_inverse=True, return_counts=True)
        means += [error.mean()] if len(excluded) >= MANY else (np.bincount(place.ravel(), error) / count).tolist()
    return mean_of(np.array(means)) if means else None


def _rest(excluded: Sequence[Exclusions]) -> Postures:
    """Postures at rest; without any, some twenty of each log, without error."""
    rest = np.concatenate([resting_postures(rows, stops=True) for rows in excluded], axis=1)
    if rest.shape[1]:
        return rest
    passed = np.concatenate([rows.log.position[rows.free][:: rows.free.sum() // 20 or 1] for rows in excluded])
    return np.stack([passed, passed])


def _resting(evidence: Evidence, healthy: HealthyReference | None, silent: Sequence[str]) -> str:
    error = evidence.rest_error_mm
    if error is None:
        return ""
    likely = "" if error.low is None else f" ({error.low:.1f} to {error.high:.1f})"
    without = silent and f" without {', '.join(silent)} (no answer)"
    return (
        f"Where it rests, the tool is {error.value:.1f} mm{likely} from where it was sent, by the arm's own "
        f"encoders{without or ''}{_usual(healthy)}. "
    )


def _nothing(arm: Arm, measurement: Measurement, rest: Postures, healthy: HealthyReference | None) -> str:
    if any(row.lag_s is not None for row in measurement.joints):
        if healthy is None:
            known = "Wear shows only beside a healthy arm of this kind, and none is known (--healthy)."
            return f"No joint is seen to be at fault.{_farthest(arm, rest)} {known}"
        return "No joint shows wear that its encoder can see."
    why = "no joint moves slowly and in both directions for long enough, or as that motion tells"
    if measurement.period_s > COARSEST:
        why = f"readings are {measurement.period_s:.3g} s apart, expected at most {COARSEST:g} s"
    return f"Whether the arm is worn cannot be told: {why}."


def _farthest(arm: Arm, rest: Postures) -> str:
    """Name the joint that takes the tool farthest from where it was sent."""
    position, command = rest
    off = np.abs(command - position)
    at_tool = (levers(arm, position) * chord(off)).mean(axis=0)
    joint, degrees = at_tool.argmax(), np.degrees(off.mean(axis=0))
    if not at_tool[joint] > 0.0:
        return ""
    return (
        f" {arm.joint_names[joint]} is farthest off: it rests {degrees[joint]:.1f} deg from its commands, "
        f"{1e3 * at_tool[joint]:.1f} mm at the tool."
    )


def _grown(measurement: Measurement, healthy: HealthyReference | None) -> list[str] | None:
    """Joints with more friction than the healthy arm, by torque or current; None: unknown."""
    if healthy is None or healthy.effort_unit != measurement.effort_unit:
        return None
    rows = zip(measurement.joints, healthy.joints, strict=True)
    pairs = [
        (row.joint, now, usual) for row, good in rows if (now := row.coulomb_effort) and (usual := good.coulomb_effort)
    ]
    return [joint for joint, now, usual in pairs if (now.low or 0.0) > (usual.high or np.inf)] if pairs else None


def _by_effort(measurement: Measurement, grown: list[str] | None) -> str:
    def said(found: Estimate | None, unit: str) -> str:
        return f"{found.value:.3g}{unit} ({found.low:.3g} to {found.high:.3g})" if found else "none seen by speed"

    unit = f" {measurement.effort_unit}" if measurement.effort_unit else ""
    rows = measurement.joints
    named = [
        f"{row.joint} {said(row.coulomb_effort, unit)} and {said(row.viscous_effort, f'{unit} s/rad')}"
        for row in rows
        if row.coulomb_effort
    ]
    if others := [row.joint for row in rows if not row.coulomb_effort]:
        named.append(
            f"not known at {', '.join(others)}: too little motion to and fro, or the sign of the column is turned or "
            "missing (a minus in --map turns one), or the base is not mounted as in the model"
        )
    than = "" if grown is None else f" Beside the healthy arm it grew at {', '.join(grown) or 'no joint'}."
    return (
        f"These logs hold no commands{'' if grown else ': whether the arm is worn cannot be told'}. Dry friction, and "
        f"friction by speed, by what the motors give{'' if unit else ', in the unit of the column'}: "
        f"{'; '.join(named)}.{than}"
    )
