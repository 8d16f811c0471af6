"""Deployment: targets, and what became of each."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rejoint.arms import JointTrajectory
from rejoint.control.deployment import REACHED, Deployed, Deployment, deployed_of, judge
from rejoint.control.loop import Schedule
from rejoint.control.observer import Observer
from rejoint.control.recording import Cycle
from rejoint.control.reference import TargetSequence
from rejoint.session.context import require_correctable
from rejoint.session.eyes import opened_eye, watched, with_sightings
from rejoint.session.inputs import ArmLike, RobotLike, RunLike, Targets, as_targets
from rejoint.session.payload import say_noticed
from rejoint.session.session import ArmSession
from rejoint.session.settings import Settings
from rejoint.system.errors import InputError
from rejoint.system.files import saving
from rejoint.system.stopping import noted

if TYPE_CHECKING:
    from rejoint.control.controller import Controller
    from rejoint.control.correction import Modelled
    from rejoint.control.seeing import Eye, Seen


def deploy(
    robot: RobotLike,
    targets: Targets | None = None,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Deployed:
    """Drive an arm to targets, under the guard.

    The arm goes slowly to its rest posture, and then to one target after the other. Ctrl-C and SIGTERM bring it to a
    hold; then `Interrupted` is raised, a KeyboardInterrupt. In other threads `rejoint.interrupt` does the same.

    Parameters
    ----------
    robot
        robot or its address
    targets
        (K, 3) [m], `Pose` objects, or a CSV file in mm; default: ten random points
    run
        its controller, twin and calibration drive the arm, and it keeps the log; without one the generic policy drives,
        and nothing is written
    arm
        needed where neither run nor address tells it
    settings
        controller, payload, time per target (``dwell``), accepted error (``within``) and the like
    observer
        receives messages, progress, and as ``partial`` what was done until an error

    Returns
    -------
    Deployed
        ``visits``, one for each target; ``missed``; the run log

    Raises
    ------
    InputError, ContractError
        if controller, control period or targets do not fit; nothing has moved
    NotReadyError
        if it is unsafe to move the arm
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds
    UnsavedError
        if the log could not be written; the error has the result

    Examples
    --------
    >>> done = rejoint.deploy("emulated:worn", [[0.17, 0.0, 0.2], [0.18, 0.03, 0.21]])
    >>> for visit in done.visits:
    ...     print(visit.target, visit.error, visit.reached, visit.remark)
    """
    with noted(), ArmSession(robot, run=run, arm=arm, settings=settings, observer=observer) as session:
        return session.deploy(targets)


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetDrive:
    """A deployment in a session."""

    session: ArmSession
    job: Deployment
    controller: Controller
    ways: Sequence[JointTrajectory]

    @classmethod
    def of(cls, session: ArmSession, targets: Targets | None) -> TargetDrive:
        """Check the request before anything moves; InputError if impossible."""
        arm, settings = session.arm, session.settings
        points, turns = as_targets(targets, arm, sets=1, seed=session.seed, reachable=False)
        if len(points) != 1:
            raise InputError(f"deployment: {len(points)} sets of targets, expected one: (targets, 3) in metres")
        if turns is not None and settings.eye is not None:
            raise InputError("deploy: what a camera sees corrects places only; leave it out, or give points")
        turns = None if turns is None else turns[0]
        require_correctable(session.calibration, arm, points)
        ways = session.ways(points[0], turns)
        name, controller = session.driver(posed=turns is not None)
        job = Deployment(
            controller=name,
            targets=points[0],
            dwell=settings.dwell,
            within=REACHED if settings.within is None else settings.within,
            turns=turns,
        )
        return cls(session=session, job=job, controller=controller, ways=ways)

    def work(self) -> Deployed:
        """Drive; a run keeps what is recorded also after ``kill -9``."""
        session, job = self.session, self.job
        period = session.period
        seconds = len(job.targets) * job.dwell + sum(way.duration for way in self.ways)
        rows = 0 if period is None else int(seconds / min(period))
        given = session.settings.eye
        eyes = nullcontext() if given is None else opened_eye(given, session.robot, session.run, session.seed)
        with eyes as eye:
            session.recorder.begin(session.robot, "deploy", f"deploy/{job.controller}", rows)
            done = self._drive(eye)
        say_noticed(session.arm, session.twin, done.log, session.observer.message)
        return done

    def _drive(self, eye: Eye | None) -> Deployed:
        session, job = self.session, self.job
        total = len(job.targets)

        def watch(cycle: Cycle) -> None:
            target, share = int(cycle.target_index[0]), float(cycle.since_target[0]) / job.dwell
            session.progress((target + min(share, 1.0)) / total, f"target {target + 1} of {total}")

        controller, correction, seen = self._corrected(eye)
        try:
            session.begin(self.controller)
            reference = TargetSequence(
                session.arm,
                job.targets[None],
                ways=[self.ways],
                turns=job.turns and job.turns[None],
                correction=correction,
            )
            recording = session.drive(controller, Schedule(dwell=job.dwell), reference, watch)
        except BaseException as error:
            done = deployed_of(error, session.arm, job, session.calibration)
            if done is not None:
                session.observer.partial(with_sightings(done, seen))
            raise
        found = judge(session.arm, recording, job, session.calibration)
        asked = {"orientations": "; ".join(visit.orientation for visit in found.visits)} if job.turns else None
        found = replace(with_sightings(found, seen), log=recording.log(0, f"deploy/{job.controller}", asked))
        with saving(found):
            session.recorder.end(extra=asked)
        session.progress(1.0, "done")
        return found

    def _corrected(self, eye: Eye | None) -> tuple[Controller, Modelled | None, Seen | None]:
        session = self.session
        if eye is None:
            return self.controller, session.correction, None
        controller, seen = watched(session.robot, self.controller, session.correction, eye)
        return controller, seen, seen
