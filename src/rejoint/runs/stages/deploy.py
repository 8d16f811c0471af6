"""Deployment: an arm driven to targets, and what became of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from rejoint.arms import Arm
from rejoint.control.controller import Controller
from rejoint.control.deployment import REACHED, Deployed, Deployment, deployed_of
from rejoint.control.deployment import deploy as deploy_to
from rejoint.control.recording import Cycle, recording_of
from rejoint.control.robot import Robot
from rejoint.control.servogains import limits_under, under_gains
from rejoint.runs.given import (
    ArmLike,
    CalibrationLike,
    Live,
    Period,
    RobotLike,
    RunLike,
    Targets,
    TwinLike,
    address_of,
    arm_of,
    as_run,
    as_targets,
    as_twin,
    opened,
    period_of,
    shown,
)
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.controllers import ControllerLike, make_factories, usual_controller
from rejoint.runs.stages.eyes import EyeLike, opened_eye, watched, with_sightings
from rejoint.runs.stages.keeping import start_journal
from rejoint.runs.stages.known import calibration_of, correction_of, guard_limits, stance_of
from rejoint.runs.stages.loads import PayloadLike, Say, say_heavy, say_noticed, silent, with_load
from rejoint.system.errors import InputError
from rejoint.system.files import require_space, saving
from rejoint.system.numbers import as_seed
from rejoint.system.progress import Progress, no_progress, paced
from rejoint.system.stopping import noted

if TYPE_CHECKING:
    from rejoint.control.correction import Modelled
    from rejoint.control.seeing import Eye, Seen
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.twin.twin import Twin


@paced
def deploy(
    robot: RobotLike,
    controller: ControllerLike | None = None,
    targets: Targets | None = None,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    twin: TwinLike | None = None,
    calibration: CalibrationLike | None = None,
    payload: PayloadLike | None = None,
    tool: ArrayLike | None = None,
    eye: EyeLike | None = None,
    dwell: float = 4.0,
    within: float = REACHED,
    period: Period | None = None,
    seed: int | None = None,
    on_progress: Progress = no_progress,
    on_end: Callable[[Deployed], object] | None = None,
    say: Say = silent,
    live: Live | None = None,
) -> Deployed:
    """Drive an arm to targets with a policy or another controller, under the guard.

    The arm is looked at first, goes slowly to its rest posture, and then to one target after the other. While it
    moves, Ctrl-C and SIGTERM bring it to a hold; then `Interrupted` is raised, which is a KeyboardInterrupt. In
    threads other than the main one Python hears no signal; there `rejoint.interrupt` does the same.

    Parameters
    ----------
    robot
        robot or its address
    controller
        policy, its file, the name of a baseline, ``shelf``, ``predictive``, or your own; by default the policy of
        ``run``, and where there is none that which comes with the package for any worn arm of this build
    targets
        (K, 3) [m], or `Pose` objects, or a CSV file in mm with the header ``x,y,z`` and perhaps columns of an
        orientation; by default ten points that are drawn
    run
        run, or its folder, with the policy and the twin; the run log is written there, without one nothing is
    arm
        arm, name or file; needed only without a run, where the address does not tell
    twin
        twin that says how far the arm should sag at rest, which is checked; by default that of the run
    calibration
        what lies behind the encoders, or its file: targets are aimed at by it; ``none`` for no correction. By default
        that of ``run``
    payload
        [kg] that the hand carries at its tool centre point, or a `Payload`; everything is computed with it
    tool
        (3,) [m] from the tool centre point of the arm's description to the tip of a tool, in the frame of the former
    eye
        sees the tool (`rejoint.control.seeing.Eye`), or makes such a one for the open robot; the number of the camera,
        as ``0``, that ``run`` was calibrated with; ``emulated`` for one that watches an emulated arm. The last
        millimetres are then corrected by what is seen
    dwell
        [s] per target
    within
        [m] of encoder error at the end within which a target counts as reached, at most 0.1
    period
        [s] interval of the control periods; by default what the robot suits
    seed
        of drawn targets and an emulated arm's noise; by default that of the run, else 0
    on_progress
        called with the share that is done and which target it is
    on_end
        called with what was done until then where an error ends the deployment early
    say
        told, in lines, which targets are too heavy, before the arm moves, and of a load that was not given, at the end
    live
        shows the arm meanwhile: a `LiveView`

    Returns
    -------
    Deployed
        ``visits``, one for each target: encoder error [m], true error and how it is known, reached or not, and why
        not; ``missed``; the run log

    Raises
    ------
    InputError, ContractError
        if controller, control period or targets do not fit; nothing has moved
    NotReadyError
        if the arm had better not be moved
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds
    UnsavedError
        if the log could not be written; the result is in the error

    Examples
    --------
    >>> done = rejoint.deploy("emulated:worn", policy, [[0.17, 0.0, 0.2], [0.18, 0.03, 0.21]])
    >>> for visit in done.visits:
    ...     print(visit.target, visit.error, visit.reached, visit.remark)
    """
    about = None if run is None else as_run(run).seeded(seed)
    chosen = with_load(arm_of(robot, arm) if about is None else about.arm, robot, payload, tool)
    seed = as_seed(seed) if about is None else about.seed
    with exclusive(about):
        points, turns = as_targets(targets, chosen, sets=1, seed=seed)
        if len(points) != 1:
            raise InputError(f"deployment: {len(points)} sets of targets, expected one: (targets, 3) in metres")
        known = as_twin(twin) if twin is not None else None if about is None else about.twin
        if turns is not None and eye is not None:
            raise InputError("deploy: what a camera sees corrects places only; leave it out, or give points")
        say_heavy(chosen, known, points, say, turns)
        correct = correction_of(calibration, about, chosen, address_of(robot), points)
        usual = period_of(robot, period)
        posed = turns is not None
        wanted = usual_controller(about, posed=posed) if controller is None else controller
        ((name, make),) = make_factories([wanted], chosen, usual, run=about, twin=known, posed=posed).items()
        job = Deployment(
            controller=name, targets=points[0], dwell=dwell, within=within, turns=None if turns is None else turns[0]
        )
        if about is not None:
            require_space(about.path)
        rows = 0 if usual is None else int(len(job.targets) * dwell / min(usual))
        with (
            noted(),
            opened(robot, chosen, seed, period) as connection,
            opened_eye(eye, connection, about, seed) as sees,
        ):
            drive = _Drive(
                robot=shown(live, connection, twin=known, within=within),
                controller=make(chosen),
                job=job,
                run=about,
                twin=known,
                correct=correct,
                model=calibration_of(calibration, about, chosen, address_of(robot)),
                eye=sees,
            )
            done = drive.to_targets(rows, on_progress, on_end or (lambda _: None))
        say_noticed(chosen, known, done.log, say)
        return done


@dataclass(frozen=True, kw_only=True, eq=False)
class _Drive:
    """A deployment on an open robot."""

    robot: Robot
    controller: Controller
    job: Deployment
    run: Run | None
    twin: Twin | None
    correct: Callable[[Arm], Modelled] | None
    model: Calibration | None
    eye: Eye | None

    def to_targets(self, rows: int, on_progress: Progress, on_end: Callable[[Deployed], object]) -> Deployed:
        """Drive; in a run, what is recorded is kept as it comes, also where ``kill -9`` ends it."""
        arm, job, label = self.robot.arm, self.job, f"deploy/{self.job.controller}"
        journal = None if self.run is None else start_journal(self.run, "deploy", self.robot, label, rows)

        controller, correction, seen = self._corrected()

        def watch(cycle: Cycle) -> None:
            if journal is not None:
                journal.see(cycle)
            target, share = int(cycle.target_index[0]), float(cycle.since_target[0]) / job.dwell
            total = len(job.targets)
            on_progress((target + min(share, 1.0)) / total, f"target {target + 1} of {total}")

        try:
            limits = limits_under(guard_limits(self.run, arm, self.robot.address), self.robot, self.controller)
            with under_gains(self.robot, self.controller):
                recording, found = deploy_to(
                    self.robot, controller, job, limits=limits, stance=stance_of(self.twin, self.run),
                    correction=correction, model=self.model, on_cycle=watch,
                )  # fmt: skip
        except BaseException as error:
            partial, done = recording_of(error), deployed_of(error, arm, job, self.model)
            if journal is not None and partial is not None and len(partial.time):
                error.add_note(journal.keep(partial.log(0, f"{label}/stopped")))
            elif journal is not None:
                journal.discard()
            if done is not None:
                on_end(with_sightings(done, seen))
            raise
        asked = "; ".join(visit.orientation for visit in found.visits)
        log = recording.log(0, label, {"orientations": asked} if job.turns is not None else None)
        found = replace(with_sightings(found, seen), log=log)
        if journal is not None:
            with saving(found):
                journal.finish(log)
        return found

    def _corrected(self) -> tuple[Controller, Modelled | None, Seen | None]:
        """Return what drives, what corrects the aims, and the latter where it goes by what is seen."""
        model = self.correct and self.correct(self.robot.arm)
        if self.eye is None:
            return self.controller, model, None
        controller, seen = watched(self.robot, self.controller, model, self.eye)
        return controller, seen, seen
