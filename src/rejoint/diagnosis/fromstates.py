"""What logs of states alone tell of an arm: how it moves and reads, and not how it answers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rejoint.arms import Arm
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.evidence import Evidence
from rejoint.diagnosis.healthy import HealthyReference
from rejoint.diagnosis.measurement import JointMetrics, Measurement
from rejoint.diagnosis.regression import mean_of
from rejoint.logs.exclusions import free_runs, joint_speed
from rejoint.logs.runlog import RunLog
from rejoint.system.statistics import Estimate

STILL = 0.02
"""[rad/s] of the fastest joint below which an arm rests (chosen: a step of a 12-bit encoder in 80 ms)"""
REST = 1.0
"""[s] of rest from which its readings tell their noise (chosen)"""
FEWEST_RESTS = 4
"""Rests below which nothing is said about noise, as for logs with commands"""
MOVES = np.radians(0.5)
"""[rad] of travel below which a joint does not move (chosen: six steps of a 12-bit encoder)"""

IMPOSSIBLE = (
    "Without commands it cannot be told how far joints stop from where they are sent, nor stiffness, friction, lag, "
    "overshoot, zeros and torque limits of any joint: record what is sent as well.",
    "A twin cannot be fitted to these logs, and none can be judged by them.",
)


def diagnose_states(
    arm: Arm, logs: Sequence[RunLog], healthy: HealthyReference | None, source: str, remarks: Sequence[str]
) -> Diagnosis:
    """Say what logs without commands show; whether the arm is worn stays unknown."""
    seconds = sum(float(log.time[-1] - log.time[0]) for log in logs)
    rows = tuple(_joint(name, noise) for name, noise in zip(arm.joint_names, _noise(arm, logs), strict=True))
    period = float(np.median(np.concatenate([np.diff(log.time) for log in logs])))
    motions = f"{len(logs)} recorded motion{'s' * (len(logs) != 1)}, {seconds:.0f} s"
    return Diagnosis(
        arm=arm.name, robot=source, condition="unknown",
        verdict=f"Whether the arm is worn cannot be told: {motions}, hold no commands. States alone show that "
        f"{_travel(arm, logs)}.",
        findings=(), unseen=(*IMPOSSIBLE, *remarks), open_loop=None,
        measurement=Measurement(joints=rows, delay_s=None, period_s=period), healthy=healthy,
        evidence=Evidence(
            motions=len(logs), seconds=seconds, free_seconds=seconds, contact_seconds=0.0, stop_seconds=0.0,
            dead_seconds=0.0, table_height_m=None, rest_error_mm=None,
        ),
    )  # fmt: skip


def _travel(arm: Arm, logs: Sequence[RunLog]) -> str:
    """Say how far and how fast each joint moves."""
    moving, still = [], []
    for joint, name in enumerate(arm.joint_names):
        lowest = min(float(log.position[:, joint].min()) for log in logs)
        highest = max(float(log.position[:, joint].max()) for log in logs)
        fastest = max(float(joint_speed(log.time, log.position[:, [joint]]).max()) for log in logs)
        if highest - lowest > MOVES:
            moving.append(f"{name} travels {np.degrees(highest - lowest):.0f} deg at up to {fastest:.2g} rad/s")
        else:
            still.append(name)
    return "; ".join([*moving, *([f"{', '.join(still)} never move{'s' * (len(still) == 1)}"] if still else [])])


def _noise(arm: Arm, logs: Sequence[RunLog]) -> list[Estimate | None]:
    """Rms [rad] of a single reading of each joint at rest, from the differences of neighbouring ones."""
    found = []
    for log in logs:
        still = joint_speed(log.time, log.position) < STILL
        for first, last in free_runs(still, log.time, REST):
            found.append(np.sqrt(np.mean(np.diff(log.position[first:last], axis=0) ** 2, axis=0) / 2))
    if len(found) < FEWEST_RESTS:
        return [None] * arm.joints
    return [mean_of(np.array(found)[:, joint]) for joint in range(arm.joints)]


def _joint(name: str, noise: Estimate | None) -> JointMetrics:
    return JointMetrics(
        joint=name, stiffness_nm_per_rad=None, stiffness_source="none", hysteresis_rad=None, coulomb_nm=None,
        lag_s=None, damping_ratio=None, overshoot=None, hunting_rad=None, noise_rad=noise, torque_limit_nm=None,
        torque_seen_nm=0.0, saturated_share=0.0, motor_inertia_kg_m2=None, sweep_gain=None, stuck_rad=0.0,
    )  # fmt: skip
