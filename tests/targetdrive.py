"""A drive to targets without a session: what the judgement of deployments is tried on."""

from rejoint.control.contract import check_controller_period
from rejoint.control.controller import Controller
from rejoint.control.correction import Modelled, ToolModel
from rejoint.control.deployment import Deployed, Deployment, judge
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import Recording
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import Robot
from rejoint.control.start import Stance, begin


def deploy(
    robot: Robot,
    controller: Controller,
    job: Deployment,
    *,
    limits: GuardLimits | None = None,
    stance: Stance | None = None,
    model: ToolModel | None = None,
    correction: Modelled | None = None,
) -> tuple[Recording, Deployed]:
    """Bring an arm to its rest posture and then to the targets of ``job``."""
    start = begin(robot, limits, stance)
    check_controller_period(controller, start.usual_period())
    recording = run(
        robot,
        controller,
        TargetSequence(robot.arm, job.targets[None], turns=job.turns and job.turns[None], correction=correction),
        Schedule(dwell=job.dwell, sent=start.command[-1]),
        limits=limits,
    )
    return recording, judge(robot.arm, recording, job, model)
