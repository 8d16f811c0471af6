"""Motions of a session: to targets in turn, perhaps seen by an eye, and along paths and streams."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.rotations import tool_axis
from rejoint.control.correction import TrueError
from rejoint.control.deployment import REACHED, Deployed, Deployment, Visit, deployed_of, judge
from rejoint.control.loop import Schedule
from rejoint.control.moving.drive import Followed, Pass, Repetition, corrected_path, corrector, missed
from rejoint.control.moving.drive import judge as judge_pass
from rejoint.control.moving.posture import PathPostures, Servos, home_of
from rejoint.control.moving.reference import (
    LEAD_IN,
    Ahead,
    Guide,
    Path,
    PathReference,
    Stream,
    is_standard,
    read_path,
    standard_path,
)
from rejoint.control.moving.tracker import Tracker
from rejoint.control.recording import Cycle, Observer, Recording
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import Controller, Robot
from rejoint.control.seeing import Finishing, Seen
from rejoint.control.targets import require_reachable
from rejoint.runs.run import Run
from rejoint.session.context import ControllerLike, correction_of, make_factories, name_of, say_heavy, say_noticed
from rejoint.session.driver import ArmMotion, EndedError
from rejoint.session.inputs import ArmLike, EyeLike, RobotLike, RunLike, Settings, Targets, as_targets
from rejoint.session.session import ArmSession
from rejoint.system.errors import InputError
from rejoint.system.files import saving
from rejoint.system.numbers import as_floats, as_seconds, as_within
from rejoint.system.stopping import noted

if TYPE_CHECKING:
    from rejoint.arms.rotations import Orientation
    from rejoint.control.seeing import Eye
    from rejoint.twin.twin import Twin

_LOGGER = logging.getLogger("rejoint")


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


class TargetDrive:
    """A deployment in a session."""

    def __init__(self, session: ArmSession, targets: Targets | None) -> None:
        """Check the request before anything moves; InputError if impossible."""
        arm, settings = session.arm, session.settings
        points, turned = as_targets(targets, arm, sets=1, seed=session.seed, reachable=False)
        if len(points) != 1:
            raise InputError(f"deployment: {len(points)} sets of targets, expected one: (targets, 3) in metres")
        if turned is not None and settings.eye is not None:
            raise InputError("deploy: what a camera sees corrects places only; leave it out, or give points")
        turns = None if turned is None else turned[0]
        correction_of(session.calibration, arm, points)
        self.session, self.ways = session, session.ways(points[0], turns)
        name, self.controller = session.driver(posed=turns is not None)
        within = REACHED if settings.within is None else settings.within
        self.job = Deployment(controller=name, targets=points[0], dwell=settings.dwell, within=within, turns=turns)

    def work(self) -> Deployed:
        """Drive; a run keeps what is recorded also after ``kill -9``."""
        session, job = self.session, self.job
        with opened_eye(session.settings.eye, session.robot, session.run, session.seed) as eye:
            session.recorder.begin(session.robot, "deploy", f"deploy/{job.controller}")
            done = self._drive(eye)
        say_noticed(session.arm, session.twin, done.log, session.observer.message)
        return done

    def _drive(self, eye: Eye | None) -> Deployed:
        session, job = self.session, self.job
        total = len(job.targets)

        def watch(cycle: Cycle) -> None:
            target, share = int(cycle.target_index[0]), float(cycle.since_target[0]) / job.dwell
            session.progress((target + min(share, 1.0)) / total, f"target {target + 1} of {total}")

        arm, controller, correction = session.robot.arm, self.controller, session.correction
        seen: Seen | None = None
        if eye is not None:
            seen = Seen(arm, Displacement.none(arm) if correction is None else correction.displacement, eye=eye)
            controller = Finishing(arm, controller, seen)
        try:
            session.begin(self.controller)
            reference = TargetSequence(
                session.arm,
                job.targets[None],
                ways=[self.ways],
                turns=job.turns and job.turns[None],
                correction=seen or correction,
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


@contextmanager
def opened_eye(given: EyeLike | None, robot: Robot, run: Run | None, seed: int) -> Iterator[Eye | None]:
    """Open the eye for ``robot``; InputError without one. A camera needs the ``camera.toml`` of ``run``."""
    if given is None:
        yield None
    elif given == "emulated":
        from rejoint.robots.cameras import simulated

        yield simulated(robot).eye(seed)
    elif not isinstance(given, str):
        yield given if hasattr(given, "sighting") else given(robot)
    elif given.isdecimal():
        if np.isfinite(robot.true_tcp()).all():
            raise InputError(f"camera {given} cannot see {robot.address}; watch an emulated arm with --camera emulated")
        from rejoint.camera.tracker import opened_camera

        with opened_camera(int(given), None if run is None else run.folder.camera, robot.arm) as eye:
            yield eye
    else:
        raise InputError(f"no camera is called {given!r}; expected the number of a camera, or emulated")


def with_sightings(done: Deployed, seen: Seen | None) -> Deployed:
    """Add what was seen at each target."""
    if seen is None:
        return done
    far = seen.shifted() if seen.displacement.play.any() else None  # without a calibration all of the sag is seen
    if far is not None:
        _LOGGER.warning(
            "the camera sees the tool %.1f mm to one side of where the calibration has it, at all targets alike: were "
            "camera or board moved? Then calibrate with the camera again, the arm went where it says",
            1e3 * far,
        )
    seen_at = [*seen.visits, *[(0, None)] * len(done.visits)]
    visits = [
        replace(visit, sightings=count, seen_error=error, true_error=_measured(visit, error))
        for visit, (count, error) in zip(done.visits, seen_at, strict=False)
    ]
    return replace(done, visits=tuple(visits))


def _measured(visit: Visit, seen: float | None) -> TrueError:
    """Take what was ``seen`` [m] as true error, unless it is known better."""
    if seen is None or visit.true_error.how == "known":
        return visit.true_error
    return TrueError(how="measured", value=seen)


PathLike: TypeAlias = "Path | FilePath | ArrayLike"
"""A path, its file or standard name, or (T, 4) times [s] and places [m]"""

TRACKER = "tracker"
"""Name of the controller by the twin"""

WITHIN = 5e-3
"""[m] accepted rms after the best lag (chosen)"""

LOOKED_AT = 50
"""Places of a path judged before it is driven (chosen)"""


def follow(
    robot: RobotLike,
    path: PathLike,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    repeat: int = 1,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Followed:
    """Drive an arm along a path, under the guard, and say how well it followed.

    The arm goes slowly to its rest posture and to the start of the path, waits two seconds, and moves. Ctrl-C and
    SIGTERM bring it to a hold; then `Interrupted` is raised. `Session.follow` follows a `Stream`.

    Parameters
    ----------
    robot
        robot or its address
    path
        `Path`, CSV file ``time,x,y,z`` in seconds and millimetres, (T, 4) numbers in seconds and metres, or a standard
        path such as ``circle-8s`` and ``random-0.2hz``
    run
        run with the twin; keeps the log
    arm
        needed where neither run nor address tells it
    repeat
        how often; each pass corrects the errors of those before
    settings
        twin, payload, accepted error (``within``) and the like; ``controller``: by default ``tracker`` with a twin,
        else what drives to points
    observer
        receives messages and progress

    Returns
    -------
    Followed
        for each of the ``passes``: encoder errors [m], true error, run log; ``followed``

    Raises
    ------
    InputError, FileError
        if the path is out of reach or too fast, or no twin is known; nothing has moved
    NotReadyError
        if it is unsafe to move the arm
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds

    Examples
    --------
    >>> done = rejoint.follow("emulated:worn", "circle-8s", run="runs/mine")
    >>> print(done.passes[-1].encoder.rms)
    """
    with noted(), ArmSession(robot, run=run, arm=arm, settings=settings, observer=observer) as session:
        return cast(Followed, session.follow(path, repeat=repeat))


@dataclass(frozen=True, kw_only=True, eq=False)
class Follower:
    """What follows a path."""

    name: str
    """of the controller"""
    make: Callable[[float], Controller]
    """for a usual period [s], for each pass"""
    home: Array | None = None
    """(n,) [rad] preferred posture; None: rest"""


class PathDrive:
    """A path or stream to be followed by a session."""

    def __init__(
        self,
        session: ArmSession,
        path: PathLike | Stream,
        *,
        repeat: int,
        duration: float | None,
        within: float | None,
    ) -> None:
        """Check the request before anything moves; InputError if impossible.

        ``duration`` [s] is of a stream. ``within`` [m] is the accepted rms.
        """
        arm, settings = session.arm, session.settings
        self.session, self.repeat, self.duration = session, repeat, duration or 0.0
        self.within = within if within is not None else WITHIN if settings.within is None else settings.within
        as_within("follow", self.within)
        if not isinstance(repeat, int | np.integer) or repeat < 1 or (repeat > 1 and isinstance(path, Stream)):
            raise InputError("follow: to be repeated at least once, and more often only where the path is known ahead")
        self.path = followable(path, arm, session.seed, duration)
        if isinstance(self.path, Stream):
            self.posed = self.path.poses(0.0, np.zeros(1))[1] is not None
        else:
            self.posed = self.path.turn is not None
            places, turns = self.path.poses(self.path.time[:: max(1, len(self.path.time) // LOOKED_AT)])
            say_heavy(arm, session.twin, places, session.observer.message, turns)
            correction_of(session.calibration, arm, places)
        wanted = settings.controller
        if wanted is None:
            wanted = TRACKER if session.twin is not None else session.driver(posed=self.posed)[0]
        self.controller = wanted
        follower_of(wanted, session, session.twin, posed=self.posed)

    def work(self, motion: ArmMotion) -> Followed:
        """Drive; `EndedError` where the motion is asked to end."""
        session = self.session
        session.take_up(None)
        self._motion = motion
        if session.settings.controller is not None:
            session.announce(name_of(self.controller), "as asked for")
        elif self.controller == TRACKER:
            session.instead(TRACKER, "for paths, by the twin")
        self._follower = follower_of(self.controller, session, session.twin_now, posed=self.posed)
        name = self.path.name if isinstance(self.path, Path) else "stream"
        self._label = f"follow/{self._follower.name}/{name}"
        session.recorder.begin(session.robot, "follow", self._label)
        _, self._usual = session.begin()
        done = self._behind(self.path) if isinstance(self.path, Stream) else self._along(self.path)
        session.followed = done
        say_noticed(session.arm, session.twin_now, done.passes[-1].log, session.observer.message)
        return done

    def _along(self, path: Path) -> Followed:
        session, arm, home = self.session, self.session.arm, self._follower.home
        wanted = path if session.correction is None else corrected_path(arm, path, session.correction, home)
        aim, passes, repetition = wanted, list[Pass](), Repetition(wanted)
        for number in range(self.repeat):
            self._approach(*wanted.poses(0.0))
            guide = Ahead(path=path, aim=aim)
            last = self._carry(guide, LEAD_IN + path.duration, number)
            passes.append(self._judged(last, Ahead(path=path, aim=wanted)))
            aim = repetition.learn(aim, *missed(arm, last, guide, wanted))
        return self._followed(path.name, passes, last)

    def _behind(self, stream: Stream) -> Followed:
        session, start = self.session, stream.poses(0.0, np.zeros(1))
        if session.correction is not None and stream.corrected is None:
            place, turn = stream.place(0.0), start[1] and start[1][0]
            stream.corrected = corrector(session.arm, session.correction, place, turn, self._follower.home)
            start = stream.place(0.0)[None], stream.poses(0.0, np.zeros(1))[1]
        self._approach(start[0][0], start[1] and start[1][0])
        last = self._carry(stream, self.duration, 0)
        return self._followed("stream", [self._judged(last, stream)], last)

    def _judged(self, last: Recording, guide: Guide) -> Pass:
        done = judge_pass(self.session.arm, last, guide, model=self.session.calibration)
        return replace(done, log=last.log(0, self._label))

    def _approach(self, start: Array, turn: Orientation | None) -> None:
        """Bring the arm to the place ``start`` (3,) [m] and ``turn`` ()."""
        session = self.session
        posture = PathPostures(session.arm, start[None], turn and turn[None], self._follower.home).last[0]
        session.go(posture, self._motion.give_up)
        if self._motion.ended.is_set():
            raise EndedError

    def _carry(self, guide: Guide, duration: float, number: int) -> Recording:
        """Drive behind a guide for ``duration`` [s]."""
        session, total = self.session, self.repeat

        def watch(cycle: Cycle) -> None:
            share = min(float(cycle.since_target[0]) / duration, 1.0)
            session.progress((number + share) / total, f"time {number + 1} of {total}" if total > 1 else "")

        if total > 1:
            session.recorder.begin(session.robot, f"follow-{number + 1:02d}", self._label)
        controller = self._follower.make(self._usual)
        schedule = Schedule(dwell=duration, give_up=self._motion.give_up)
        recording = session.drive(controller, schedule, PathReference(session.arm, [guide], self._follower.home), watch)
        if self._motion.ended.is_set():
            raise EndedError
        return recording

    def _followed(self, path: str, passes: list[Pass], last: Recording) -> Followed:
        period = last.usual_period()
        return Followed(
            path=path,
            controller=self._follower.name,
            within=self.within,
            passes=tuple(passes),
            period=period if np.isfinite(period) else None,
            gaps=tuple(float(gap) for gap in last.gaps() if gap > 0.0),
        )


def as_path(given: PathLike, arm: Arm, seed: int) -> Path:
    """Path from an object, a file, numbers or a standard name."""
    if isinstance(given, Path):
        return given
    if isinstance(given, str) and is_standard(given):
        return standard_path(given, arm, seed)
    if isinstance(given, str | FilePath):
        return read_path(FilePath(given), arm)
    expected = "a Path, a file, or points (K, 4) of time [s] and x, y, z [m]"
    points = as_floats("path", given, expected)
    if points.ndim != 2 or points.shape[-1] != 4:
        raise InputError(f"path: an array of shape {points.shape}, expected (points, 4): time [s] and x, y, z [m]")
    return Path(time=points[:, 0], place=points[:, 1:])


def followable(given: PathLike | Stream, arm: Arm, seed: int, duration: float | None) -> Path | Stream:
    """Stream or path that ``arm`` can follow; else InputError."""
    if isinstance(given, Stream):
        as_seconds("follow: a stream", duration)
        if given.followed:
            raise InputError(
                "follow: this stream was followed already, up to its last target; put targets into another"
            )
        given.axis = tool_axis(arm)
        places, turns = given.poses(0.0, np.zeros(1))
        require_reachable(arm, places[None], turns and turns[None])
        return given
    if duration is not None:
        raise InputError("follow: a duration is of a stream; a path takes as long as its times say")
    path = as_path(given, arm, seed)
    path.require_followable(arm)
    return path


def servos_of(twin: Twin) -> Servos:
    """Return what a tracker takes from the twin of one arm."""
    own = twin.parameters.repeat(1)
    return Servos(**{item.name: getattr(own, item.name) for item in fields(Servos)})


def follower_of(given: ControllerLike, session: ArmSession, twin: Twin | None, *, posed: bool) -> Follower:
    """Return what follows under a name, or is given; else InputError."""
    arm = session.arm
    if given == TRACKER:
        if twin is None:
            raise InputError("follow: the tracker needs a twin; run `rejoint identify` first")
        servos = servos_of(twin)
        home = home_of(arm, servos)
        return Follower(name=TRACKER, make=lambda period: Tracker(arm, servos, period=period), home=home[0])
    ((name, make),) = make_factories([given], arm, session.period, run=session.run, twin=twin, posed=posed).items()
    return Follower(name=name, make=lambda _: make(arm))
