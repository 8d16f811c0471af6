"""A diagnosis from logs of any motion.

Stiffness needs a gravity load, friction motion in both directions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rejoint.arms import Arm, tcp_position
from rejoint.diagnosis.diagnosis import Diagnosis, Evidence, causes, condition_of, untold
from rejoint.diagnosis.healthy import HealthyReference
from rejoint.diagnosis.measurement import JointMetrics, Measurement, measure_joint
from rejoint.diagnosis.metrics import COARSEST
from rejoint.diagnosis.open_loop import Postures, joined, resting_postures
from rejoint.diagnosis.regression import mean_of
from rejoint.diagnosis.segments import join_logs
from rejoint.diagnosis.verdict import Finding, find
from rejoint.logs.consistency import forced_remarks, refuse_copies, require_commands, states_alone
from rejoint.logs.exclusions import Exclusions, answered, find_exclusions, table_height, unpowered_joints
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.statistics import Estimate

_MANY = 8
"""Logs from which each is one observation; chosen"""

SHORTEST = 10.0
"""[s] least free motion; chosen"""


def diagnose_logs(
    arm: Arm,
    logs: Sequence[RunLog],
    healthy: HealthyReference | None,
    *,
    source: str = "logs",
    on_progress: Progress = no_progress,
) -> Diagnosis:
    """Judge an arm by logs of any motion; InputError for another arm or too little free motion."""
    if healthy is not None and healthy.arm != arm.name:
        raise InputError(f"the healthy reference is of arm {healthy.arm}, expected {arm.name}")
    for log in logs:
        log.require(arm.name, arm.joint_names)
    refuse_copies(logs, "diagnosis")
    bare = states_alone(logs, "diagnosis")
    if any(log.torque is None and log.current is None for log in logs):
        require_commands(logs, "diagnosis")
    on_progress(0.0, "contacts and stops")
    height = None if bare else table_height(arm, logs)
    nowhere = [np.zeros(len(log), dtype=bool) for log in logs]
    excluded = (
        [Exclusions(contact=rows, stop=rows, stale=rows) for rows in nowhere]
        if bare
        else find_exclusions(arm, logs, height)
    )
    rest = joined([resting_postures(log, rows, stops=True) for log, rows in zip(logs, excluded, strict=True)])
    evidence = _evidence(arm, logs, excluded, height)
    if evidence.free_seconds < SHORTEST:
        raise InputError(
            f"diagnosis: {evidence.free_seconds:.0f} s of free motion, expected at least {SHORTEST:.0f} s"
            f"{left_out(evidence)}; record longer motions, off table and stops"
        )
    data = join_logs(arm, logs, excluded)
    rows = []
    for joint, name in enumerate(arm.joint_names):
        on_progress(0.1 + 0.9 * joint / arm.joints, name)
        rows.append(measure_joint(data, joint))
    measurement = Measurement(joints=tuple(rows), delay_s=None, period_s=float(np.median(np.diff(data.log.time))))
    rest = rest if len(rest.position) else _everywhere(logs, excluded)
    findings = () if bare else find(arm, measurement, rest, healthy)
    known = _by_effort(measurement, data.effort_unit or "") if bare else _verdict(measurement, findings, healthy)
    silent = {joint: log.label for log in logs for joint in unpowered_joints(log)}
    return Diagnosis(
        arm=arm.name,
        robot=source,
        condition=_condition(measurement, findings),
        verdict=f"{_rest(evidence, healthy)}{known} {_motions(evidence)}",
        findings=findings,
        unseen=(
            *(f"{joint} does not answer in {label}: without power, or stuck." for joint, label in silent.items()),
            *untold(measurement, QUESTIONS),
            *NEVER_TOLD,
            *(f"{remark}." for remark in forced_remarks(logs)),
        ),
        open_loop=None,
        measurement=measurement,
        healthy=healthy,
        evidence=evidence,
    )


def left_out(evidence: Evidence) -> str:
    """Describe the time without free arm, to end a sentence."""
    parts = (
        (evidence.contact_seconds, "with the tool on a table"),
        (evidence.stop_seconds, "at a stop"),
        (evidence.dead_seconds, "of dead readings"),
    )
    named = [f"{seconds:.0f} s {what}" for seconds, what in parts if seconds >= 0.5]
    return f"; left out: {', '.join(named)}" if named else ""


def _evidence(arm: Arm, logs: Sequence[RunLog], excluded: Sequence[Exclusions], height: float | None) -> Evidence:
    def seconds(kind: str) -> float:
        return sum(float(getattr(rows, kind)[1:] @ np.diff(log.time)) for log, rows in zip(logs, excluded, strict=True))

    return Evidence(
        motions=len(logs),
        seconds=sum(float(log.time[-1] - log.time[0]) for log in logs),
        free_seconds=seconds("free"),
        contact_seconds=seconds("contact"),
        stop_seconds=seconds("stop"),
        dead_seconds=seconds("stale"),
        table_height_m=height,
        rest_error_mm=_rest_error(arm, logs, excluded),
    )


def _rest_error(arm: Arm, logs: Sequence[RunLog], excluded: Sequence[Exclusions]) -> Estimate | None:
    means: list[float] = []
    for log, rows in zip(logs, excluded, strict=True):
        rest = resting_postures(answered(log), rows)
        if not len(rest.position):
            continue
        gap = tcp_position(arm, rest.command) - tcp_position(arm, rest.position)
        error = np.linalg.norm(gap, axis=-1) * 1e3
        place = np.unique(np.round(rest.command, 3), axis=0, return_inverse=True)[1].ravel()
        of_place = np.bincount(place, weights=error) / np.bincount(place)
        means += [float(error.mean())] if len(logs) >= _MANY else of_place.tolist()
    return mean_of(np.array(means)) if means else None


def _everywhere(logs: Sequence[RunLog], excluded: Sequence[Exclusions]) -> Postures:
    chosen = [np.flatnonzero(rows.free)[:: max(int(rows.free.sum()) // 20, 1)] for rows in excluded]  # some twenty
    position = np.concatenate([log.position[rows] for log, rows in zip(logs, chosen, strict=True)])
    return Postures(position=position, command=position)


def _rest(evidence: Evidence, healthy: HealthyReference | None) -> str:
    error = evidence.rest_error_mm
    if error is None:
        return ""
    usual = "" if healthy is None else f"; a healthy arm of this kind: {healthy.error_mm.value:.1f} mm"
    likely = "" if error.low is None or error.high is None else f" ({error.low:.1f} to {error.high:.1f})"
    return (
        f"Where it rests, the tool is {error.value:.1f} mm{likely} from where it was sent, by the arm's own "
        f"encoders{usual}. "
    )


def _motions(evidence: Evidence) -> str:
    motions = f"{evidence.motions} recorded motion{'s' * (evidence.motions != 1)}"
    return f"From {motions}, {evidence.free_seconds:.0f} s in free space{left_out(evidence)}."


def _unmeasured(measurement: Measurement) -> list[str]:
    return [row.joint for row in measurement.joints if row.hysteresis_rad is None]


def _condition(measurement: Measurement, findings: tuple[Finding, ...]) -> str:
    nothing = not findings and len(_unmeasured(measurement)) == len(measurement.joints)
    return "unknown" if nothing else condition_of(findings)


def _verdict(measurement: Measurement, findings: tuple[Finding, ...], healthy: HealthyReference | None) -> str:
    unmeasured = _unmeasured(measurement)
    if not findings and len(unmeasured) == len(measurement.joints):
        why = "no joint moves slowly and in both directions for long enough"
        if measurement.period_s > COARSEST:
            why = f"readings are {measurement.period_s:.2f} s apart, expected at most {COARSEST:g} s"
        return f"Whether the arm is worn cannot be told: {why}."
    if not findings:
        return (
            f"No joint shows wear in these logs{'; they do not tell about ' * bool(unmeasured)}{', '.join(unmeasured)}."
        )
    named, _, more = causes(findings, findings)
    against = "" if healthy is None else f" Compared with {healthy.source}."
    return f"What stands out: {named}.{more}{against}"


def _by_effort(measurement: Measurement, unit: str) -> str:

    def said(found: Estimate | None, unit: str) -> str:
        return "" if found is None else f"{found.value:.3g} {unit} ({found.low:.3g} to {found.high:.3g})"

    rows = [row for row in measurement.joints if row.coulomb_effort is not None]
    named = "; ".join(
        f"{row.joint} {said(row.coulomb_effort, unit)} and {said(row.viscous_effort, f'{unit} s/rad')}" for row in rows
    )
    return (
        f"These logs hold no commands: whether the arm is worn cannot be told. Dry friction, and friction by speed, by "
        f"what the motors give: {named or 'not known, as no joint moves in both directions for long enough'}."
    )


QUESTIONS: dict[str, Callable[[JointMetrics], bool]] = {
    "The stiffness of {}, and so the torque that friction takes, cannot be told: gravity does not load it enough in "
    "these motions, or they disagree too much.": lambda row: row.stiffness_nm_per_rad is None,
    "Lag and zero of {}, and friction by the following error, cannot be told: too little slow motion, in one direction "
    "only, with readings too far apart or without commands.": lambda row: row.hysteresis_rad is None,
    "Whether {} shoots over cannot be told: too few steps.": lambda row: row.overshoot is None,
    "Noise and unrest of {} cannot be told: the arm hardly rests while no command moves.": (
        lambda row: row.noise_rad is None
    ),
}
"""What logs leave open, and of which joints"""

NEVER_TOLD = (
    "Lag here holds the delay of commands and answers: only steps recorded on one clock would tell them apart.",
    "Logs of ordinary motion tell neither torque limits nor damping apart from lag; `rejoint diagnose ROBOT` does.",
    "Play and flex behind the encoders, and so the true error of the tool, cannot be seen.",
)
