"""A drive to targets without a session: what the judgement of deployments is tried on."""

from dataclasses import replace

import numpy as np

from rejoint.control.controllers.classical import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.control.moving.drive import judge_targets
from rejoint.control.recording import recording_of
from rejoint.control.reference import TargetSequence
from rejoint.control.start import begin
from rejoint.system.errors import GuardTripError, RobotError
from rejoint_lab.emulated import EmulatedRobot


def deploy(robot, controller, job, *, model=None):
    """Bring an arm to its rest posture and then to the targets of ``job``."""
    start = begin(robot)
    targets = TargetSequence(robot.arm, job.targets[None], turns=job.turns and job.turns[None])
    recording = run(robot, controller, targets, Schedule(dwell=job.dwell, sent=start.command[-1]))
    return recording, judge_targets(robot.arm, recording, job, model)


def grow_hot(monkeypatch, at):
    """Let emulated arms of one tell 90 deg C in their step number ``at``."""
    step, steps = EmulatedRobot.step, []

    def hot(self, *arguments):
        steps.append(arguments)
        state = step(self, *arguments)
        return replace(state, temperature=np.full((1, 6), 90.0)) if len(steps) == at else state

    monkeypatch.setattr(EmulatedRobot, "step", hot)


def drive_until_error(robot, targets, dwell, limits=None):
    """Drive to targets with the integrator; returns the recording, and the error that ended it."""
    try:
        return run(robot, IntegratorController(robot.arm), targets, Schedule(dwell=dwell), limits=limits), None
    except (RobotError, GuardTripError) as error:
        return recording_of(error), error
