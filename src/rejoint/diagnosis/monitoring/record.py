"""Driving arms through the check, by the one control loop and under the guard."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rejoint.arms import Array
from rejoint.control.playback import play
from rejoint.control.recording import Cycle, OnCycle
from rejoint.control.robot import Robot
from rejoint.control.start import begin
from rejoint.diagnosis.monitoring.routine import plan_check
from rejoint.diagnosis.segments import attach_segments
from rejoint.logs.runlog import RunLog
from rejoint.system.progress import Progress, no_progress

LABEL = "check"
"""Of the run log"""


def record_check(
    robot: Robot, *, on_progress: Progress = no_progress, on_cycle: OnCycle | None = None
) -> Sequence[tuple[RunLog, Array | None]]:  # fmt: skip
    """Drive every arm of ``robot`` through the check; returns its log and the servos' temperatures (n,) [deg C].

    Errors as those of a diagnosis: NotReadyError before anything moves, GuardTripError or RobotError on the way.
    Temperatures are the mean of those at the start and at the end, None where the servos do not tell.
    """
    plan = plan_check(robot.arm)  # refused, if it is, before anything moves
    begin(robot)
    since, before = float(robot.read().time[0]), robot.read().temperature

    def see(cycle: Cycle) -> None:
        if on_cycle is not None:
            on_cycle(cycle)
        on_progress(min((float(cycle.time[0]) - since) / plan.duration, 1.0), "check")

    done = play(robot, plan.command, plan.duration, on_cycle=see)
    after = robot.read().temperature
    warm = None if before is None or after is None else 0.5 * (np.array(before) + np.array(after))
    return [
        (attach_segments(done.log(b, LABEL), plan.segments, done.waits(b)), None if warm is None else warm[b])
        for b in range(robot.count)
    ]
