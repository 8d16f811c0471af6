"""The motion of a check: two to three minutes.

Every other joint sweeps slowly, then the rest; then the tool visits the poses of ISO 9283:1998, five times from below
and above.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.inverse import solve_position
from rejoint.arms.workspace import HOLD_OFFSET, is_safe, line_is_safe, unsafe
from rejoint.control.comparison.protocols import RISING_LEFT, iso_poses
from rejoint.control.recording import OnCycle
from rejoint.control.robot import Robot
from rejoint.control.start import begin, play
from rejoint.diagnosis.excitation import CommandPath, Excitation, reporting, swept
from rejoint.diagnosis.segments import attach_segments
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress

POSES = 5
"""ISO 9283:1998: P1 to P5"""
CYCLES = 5
"""Approaches to each pose from each side; chosen"""
SIDES = ("below", "above")

_SWEEP_SPEED = 0.12  # [rad/s] twice the usual Stribeck velocity, as the slow sweeps of a diagnosis
_SWEEP_SHARE = 0.2  # of the slowest joint's speed that sweeps may take (as in a diagnosis)
_SWEEP_CYCLES = 2  # back and forth
_AMPLITUDE = 0.18  # [rad] several times a worn joint's hysteresis, as the sweeps of a diagnosis
_TRAVEL_SPEED, _TRAVEL_SHARE = 0.8, 0.4  # [rad/s], and share of the slowest joint's speed (as in a diagnosis)
_APPROACH_SPEED = 0.3  # [rad/s] so slow that nothing overshoots (as the holds of a diagnosis)
_PAUSE = 0.3  # [s] before a turn (chosen)
_DWELL = 0.8  # [s] in a pose (chosen: a worn joint has come to rest after half of it)
_SMALLER = 0.8 ** np.arange(10)  # shares of amplitude and region that are tried where there is little room


def plan_check(arm: Arm) -> Excitation:
    """Plan the check of an arm at rest, within its space; InputError without space."""
    postures, offset = _poses(arm)
    amplitude = _amplitude(arm)
    slowest = float(arm.max_speed.min())
    travel = min(_TRAVEL_SPEED, _TRAVEL_SHARE * slowest)
    path = CommandPath(arm.rest)
    path.wait(0.5)
    path.sweep(arm, amplitude, travel, [(min(_SWEEP_SPEED, _SWEEP_SHARE * slowest), _SWEEP_CYCLES)])
    for cycle in range(CYCLES):
        for pose, posture in enumerate(postures):
            for sign, side in zip((-1.0, 1.0), SIDES, strict=True):
                path.travel(posture + sign * offset, travel)
                path.wait(_PAUSE)
                path.travel(posture, min(_APPROACH_SPEED, _SWEEP_SHARE * slowest))
                with path.segment(f"pose/{pose}/{side}/{cycle}", "pose", tuple(range(arm.joints))):
                    path.wait(_DWELL)
    path.travel(arm.rest, travel)
    time, position = path.knots()
    return Excitation(arm=arm, segments=path.segments, time=time, position=position)


def _poses(arm: Arm) -> tuple[Array, float]:
    """Postures (5, n) [rad], and the distance [rad] of approach."""
    for size in _SMALLER:
        q = solve_position(arm, iso_poses(arm, RISING_LEFT, float(size)), arm.rest).q
        for offset in HOLD_OFFSET * _SMALLER[:4]:
            ends = [q + sign * offset for sign in (-1.0, 1.0)]
            stops = np.concatenate([np.stack([ends[0][i], q[i], ends[1][i], q[i]]) for i in range(POSES)])
            chain = np.concatenate([arm.rest[None], stops, arm.rest[None]])
            back = line_is_safe(arm, q[-1], ends[0][0])  # the next cycle begins at the first pose
            if bool(line_is_safe(arm, chain[:-1], chain[1:]).all() and back):
                return q, float(offset)
    why = unsafe(arm, solve_position(arm, iso_poses(arm, RISING_LEFT), arm.rest).q[0])
    raise InputError(
        f"arm {arm.name}: the five poses of a check cannot be reached safely from its rest posture"
        f"{f': {why}' if why else ''}; give another rest_deg or other targets in the arm's TOML file"
    )


def _amplitude(arm: Arm) -> float:
    """[rad] of the sweeps about rest."""
    for share in _SMALLER:
        ends = np.array(
            [
                sign * share * _AMPLITUDE * swept(arm, tuple(range(first, arm.joints, 2)))
                for first in (0, 1)
                for sign in (-1.0, 1.0)
            ]
        )
        if is_safe(arm, arm.rest + ends).all():
            return float(share * _AMPLITUDE)
    raise InputError(f"arm {arm.name}: its rest posture leaves no room to move its joints: {unsafe(arm, arm.rest)}")


LABEL = "check"
"""Of the run log"""


def record_check(
    robot: Robot, *, on_progress: Progress = no_progress, on_cycle: OnCycle | None = None
) -> Sequence[tuple[RunLog, Array | None]]:
    """Drive every arm through the check; return logs and mean servo temperatures (n,) [deg C].

    NotReadyError before the motion, GuardTripError or RobotError in it.
    """
    plan = plan_check(robot.arm)  # refused, if it is, before anything moves
    begin(robot)
    before = robot.read().temperature
    see = reporting("check", plan.duration, on_progress, on_cycle, robot)
    done = play(robot, plan.command, plan.duration, on_cycle=see)
    after = robot.read().temperature
    warm = None if before is None or after is None else 0.5 * (np.array(before) + np.array(after))
    return [
        (attach_segments(done.log(b, LABEL), plan.segments, done.waits(b)), None if warm is None else warm[b])
        for b in range(robot.count)
    ]
