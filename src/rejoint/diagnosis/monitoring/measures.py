"""The motion of a check, and what it measures by encoders.

Every other joint sweeps slowly, then the rest; the tool visits the poses of ISO 9283:1998, five times from both sides.

ISO 9283: *accuracy* AP is the distance of the mean position from the command, *repeatability* RP the scatter about it,
vAP the distance between directions of approach. ISO 230-2: *reversal value* B, a joint's difference between directions.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, levers, tcp_position
from rejoint.arms.kinematics import solve_position
from rejoint.arms.workspace import torque_size
from rejoint.control.comparison.protocols import iso_poses, reversal
from rejoint.control.comparison.result import position_repeatability
from rejoint.control.robot import Robot
from rejoint.control.start import begin
from rejoint.diagnosis.excitation import Excitation, Plan, fitted, played
from rejoint.diagnosis.segments import SETTLED_LAST, ExcitationLog
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError, RobotError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.records import value_type

POSES = 5
"""ISO 9283:1998: P1 to P5"""
CYCLES = 5
"""Approaches to each pose from each side; chosen"""
SIDES = ("below", "above")

CHECK = Plan(sweep_speeds=(0.12,), sweep_cycles=(2,), hold_dwell=0.8)
"""Slow sweeps, and approaches to poses, as in a diagnosis; chosen: a worn joint rests after half the time"""


def plan_check(arm: Arm) -> Excitation:
    """Plan the check of an arm at rest, within its space; InputError without space."""

    def build(plan: Plan) -> Excitation:
        path = Excitation(arm)
        path.wait(0.5)
        path.sweep(plan, plan.travel_speed)
        postures = solve_position(arm, iso_poses(arm, plan.region), arm.rest).q
        for cycle, (pose, posture), (sign, side) in product(
            range(CYCLES), enumerate(postures), zip((-1.0, 1.0), SIDES, strict=True)
        ):
            path.approach(posture + sign * plan.hold_offset, posture, plan)
            with path.segment(f"pose/{pose}/{side}/{cycle}", "pose", tuple(range(arm.joints))):
                path.wait(plan.hold_dwell)
        path.travel(arm.rest, plan.travel_speed)
        return path

    return fitted(arm, CHECK, build)


LABEL = "check"
"""Of the run log"""


def record_check(robot: Robot, *, on_progress: Progress = no_progress) -> Sequence[tuple[RunLog, Array | None]]:
    """Drive every arm through the check; return logs and mean servo temperatures (n,) [deg C].

    NotReadyError before the motion, GuardTripError or RobotError in it.
    """
    plan = plan_check(robot.arm)  # refused, if it is, before anything moves
    begin(robot)
    before = robot.read().temperature
    logs = played(robot, plan, LABEL, on_progress)
    after = robot.read().temperature
    if before is None or after is None:
        return [(log, None) for log in logs]
    return list(zip(logs, 0.5 * (np.array(before) + np.array(after)), strict=True))


LEAST_LEVER = 0.02
"""[m]; chosen"""

_LEAST_RANGE = 0.1
"""[N m] of a myCobot 280, least range of load for sag; chosen"""

LEAST_APPROACHES = 3
"""Approaches from one side that a check needs; chosen"""

_SWEEP_MIDDLE = 0.6  # share of a sweep, about its middle, in which a joint moves steadily (chosen)


DEAD_TIME, DEAD_WAY = 15.0, np.radians(10.0)
"""[s] and [rad] of commands with frozen readings of a dead joint; chosen"""


@value_type
class JointCheck:
    """One joint, in millimetres at the tool: angle times mean lever."""

    joint: str
    hysteresis_mm: float
    """in slow motion, one way minus the other"""
    reversal_mm: float
    """ISO 230-2 B: rest from above minus from below"""
    deviation_mm: float
    """command minus rest, mean of both sides: sag, offset"""
    sag_mm: float | None
    """change of `deviation_mm` with the load; None for a constant load"""
    lever_mm: float
    """[mm/rad]"""
    temperature_c: float | None
    """of the servo"""


@value_type
class CheckMeasures:
    """Results of one check."""

    joints: tuple[JointCheck, ...]
    error_mm: float
    """AP by encoders, mean over poses and sides"""
    repeatability_mm: float
    """largest RP from one side, of `CYCLES` approaches (standard: 30)"""
    approach_mm: float
    """largest vAP of a pose by encoders"""
    true_error_mm: float | None
    """as `error_mm`, of the tool itself"""
    temperature_c: float | None
    """mean of the servos"""


def measure_check(arm: Arm, log: RunLog, temperature: Array | None) -> CheckMeasures:
    """Measure an arm by its check; ``temperature`` (n,) [deg C] of its servos.

    InputError for no whole check of this arm.
    """
    data = ExcitationLog.of(arm, log)
    command, position, tool = _settled(data)
    lever = np.maximum(levers(arm, position).mean(axis=(0, 1, 2)), LEAST_LEVER)
    off = 1e3 * lever * (command - position)  # (poses, sides, cycles, n) [mm]
    torque, least = gravity_torque(arm, position), _LEAST_RANGE * torque_size(arm)
    turned = (off[:, 0] - off[:, 1]).mean(axis=(0, 1))
    rows = tuple(
        JointCheck(
            joint=name,
            hysteresis_mm=1e3 * lever[j] * _hysteresis(data, j),
            reversal_mm=float(turned[j]),
            deviation_mm=float(off[..., j].mean()),
            sag_mm=_sag(off[..., j].mean(axis=(1, 2)), torque[..., j].mean(axis=(1, 2)), least),
            lever_mm=1e3 * float(lever[j]),
            temperature_c=None if temperature is None else float(temperature[j]),
        )
        for j, name in enumerate(arm.joint_names)
    )
    goal, seen = tcp_position(arm, command), tcp_position(arm, position)
    return CheckMeasures(
        joints=rows,
        error_mm=1e3 * float(reversal(seen, goal).mean()),
        repeatability_mm=1e3 * float(position_repeatability(seen).max()),
        approach_mm=1e3 * float(reversal(seen[:, 0], seen[:, 1]).max()),
        true_error_mm=1e3 * float(reversal(tool, goal).mean()) if np.isfinite(tool).all() else None,
        temperature_c=None if temperature is None else float(np.mean(temperature)),
    )


def require_followed(arm: Arm, log: RunLog) -> None:
    """Raise RobotError for a reading that froze during motion."""
    for j, name in enumerate(arm.joint_names):
        away = np.abs(log.position[:, j] - log.position[-1, j]) > 1.5 * arm.encoder_step
        since = np.flatnonzero(away)[-1] + 1 if away.any() else 0
        stood, way = log.time[-1] - log.time[since], np.ptp(log.command[since:, j])
        if stood > DEAD_TIME and way > DEAD_WAY:
            raise RobotError(
                f"{name} did not follow: in the last {stood:.0f} s its commands moved by {np.degrees(way):.0f} deg and "
                "its reading not at all, so that it is stuck, or its encoder is dead; support the arm, switch it off, "
                f"turn {name} by hand and see whether its reading changes. The check does not count"
            )


def _settled(data: ExcitationLog) -> tuple[Array, Array, Array]:
    """Means at rest: command, position (poses, sides, cycles, n) [rad] and tool (poses, sides, cycles, 3) [m]."""
    log, n = data.log, data.arm.joints
    values = np.column_stack([log.command, log.position, log.true_tcp])
    found = np.full((POSES, len(SIDES), CYCLES, values.shape[1]), np.nan)
    for segment in data.of_kind("pose"):
        rows = data.rows(segment, last=SETTLED_LAST)
        _, pose, side, cycle = segment.name.split("/")
        if len(rows):
            found[int(pose), SIDES.index(side), int(cycle)] = values[rows].mean(axis=0)
    seen = np.isfinite(found[..., :n]).all(axis=-1, keepdims=True)
    if seen.sum(axis=2).min() < LEAST_APPROACHES:
        raise InputError(
            f"run log {log.label} is not of a whole check: of {POSES} x {CYCLES} approaches from two sides it has "
            f"fewer than {LEAST_APPROACHES} to some pose; check the arm again"
        )
    whole = np.where(seen, found, found.mean(axis=2, where=seen, keepdims=True))
    return whole[..., :n], whole[..., n : 2 * n], whole[..., 2 * n :]


def _hysteresis(data: ExcitationLog, joint: int) -> float:
    """[rad] following error of slow sweeps upwards minus downwards."""
    sides: tuple[list[float], list[float]] = ([], [])
    for segment in data.of_kind("sweep", joint):
        cut = 0.5 * (1.0 - _SWEEP_MIDDLE) * (segment.stop - segment.start)
        rows = data.rows(replace(segment, start=segment.start + cut, stop=segment.stop - cut))
        command = data.log.command[rows, joint]
        if len(rows) > 1:
            sides[int(command[-1] < command[0])].append((command - data.log.position[rows, joint]).mean())
    data.require(bool(sides[0] and sides[1]), "sweeps", joint)
    return float(np.mean(sides[0]) - np.mean(sides[1]))


def _sag(deviation: Array, torque: Array, least: float) -> float | None:
    """[mm] slope of deviations (poses,) [mm] over torques (poses,) [N m], times the size of the mean torque."""
    if np.ptp(torque) < least:
        return None
    return float(np.polyfit(torque - torque.mean(), deviation, 1)[0] * abs(torque.mean()))
