"""A drive to targets without a session: what the judgement of deployments is tried on."""

from rejoint.control.loop import Schedule, run
from rejoint.control.moving.drive import judge_targets
from rejoint.control.reference import TargetSequence
from rejoint.control.start import begin


def deploy(robot, controller, job, *, model=None, correction=None):
    """Bring an arm to its rest posture and then to the targets of ``job``."""
    start = begin(robot)
    targets = TargetSequence(robot.arm, job.targets[None], turns=job.turns and job.turns[None], correction=correction)
    recording = run(robot, controller, targets, Schedule(dwell=job.dwell, sent=start.command[-1]))
    return recording, judge_targets(robot.arm, recording, job, model)
