"""Driving an arm for its diagnosis: ten targets open loop, then the excitation, through the one control loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.control.default import DefaultController
from rejoint.control.loop import Schedule, run
from rejoint.control.playback import move, play
from rejoint.control.recording import Cycle, OnCycle
from rejoint.control.robot import Robot
from rejoint.control.start import begin
from rejoint.diagnosis.excitation import FULL, Plan, plan_excitation
from rejoint.diagnosis.open_loop import DWELL, TARGETS
from rejoint.diagnosis.segments import attach_segments
from rejoint.logs.runlog import RunLog
from rejoint.system.progress import Progress, no_progress, part

TARGETS_LABEL, EXCITATION_LABEL = "diagnosis/targets", "diagnosis/excitation"
"""Labels of the run logs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DiagnosisLogs:
    """What one arm did for its diagnosis."""

    targets: RunLog
    """ten targets open loop"""
    excitation: RunLog
    """the excitation, with its segments in ``extra``"""


def record(
    robot: Robot, *, seed: int, plan: Plan = FULL, on_progress: Progress = no_progress,
    on_cycle: OnCycle | None = None,
) -> tuple[DiagnosisLogs, ...]:  # fmt: skip
    """Drive every arm of ``robot`` through the diagnosis; returns the logs of each.

    The arm is looked at first and brought slowly to its rest posture: NotReadyError before it moves if that is unwise.
    GuardTripError or RobotError if the motion had to be ended. ``seed`` draws the targets and the
    excitation; the arms of a batch get the same ones. ``on_cycle`` sees every cycle, also of the ways to rest, so that
    a log is left of one that ends early.
    """
    arm = robot.arm
    extra = {"seed": str(seed)}
    excitation = plan_excitation(arm, seed=seed, plan=plan)  # refused, if it is, before anything moves
    begin(robot, on_cycle=on_cycle)
    whole, first = TARGETS * DWELL + excitation.duration, TARGETS * DWELL
    targets = np.tile(arm.targets.sample(np.random.default_rng(seed), (TARGETS,)), (robot.count, 1, 1))
    open_loop = run(
        robot, DefaultController(arm), targets, Schedule(dwell=DWELL),
        on_cycle=_progress("ten targets", first, part(on_progress, 0.0, first / whole), on_cycle, robot),
    )  # fmt: skip
    move(robot, arm.rest, on_cycle=on_cycle)
    excited = play(
        robot, excitation.command, excitation.duration,
        on_cycle=_progress(
            "excitation", excitation.duration, part(on_progress, first / whole, 1.0), on_cycle, robot
        ),
    )  # fmt: skip
    return tuple(
        DiagnosisLogs(
            targets=open_loop.log(b, TARGETS_LABEL, extra),
            excitation=attach_segments(excited.log(b, EXCITATION_LABEL, extra), excitation.segments, excited.waits(b)),
        )
        for b in range(robot.count)
    )


def _progress(what: str, duration: float, on_progress: Progress, on_cycle: OnCycle | None, robot: Robot) -> OnCycle:
    since = float(robot.read().time[0])

    def report(cycle: Cycle) -> None:
        if on_cycle is not None:
            on_cycle(cycle)
        on_progress(min((float(cycle.time[0]) - since) / duration, 1.0), what)

    return report
