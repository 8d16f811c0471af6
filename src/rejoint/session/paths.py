"""Following paths and streams with an arm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array
from rejoint.arms.rotations import tool_axis
from rejoint.control.controller import Controller
from rejoint.control.loop import Schedule
from rejoint.control.moving.drive import Followed, Pass, Repetition, corrected_path, corrector, judge, missed
from rejoint.control.moving.posture import PathPostures, Servos, home_of
from rejoint.control.moving.reference import (
    LAG,
    LEAD_IN,
    Ahead,
    Path,
    PathReference,
    Stream,
    is_standard,
    played,
    read_path,
    require_rate,
    standard_path,
)
from rejoint.control.moving.tracker import Tracker
from rejoint.control.observer import Observer
from rejoint.control.recording import Cycle, Recording
from rejoint.control.targets import require_reachable
from rejoint.session.context import require_correctable
from rejoint.session.controllers import ControllerLike, make_factories, name_of
from rejoint.session.inputs import ArmLike, RobotLike, RunLike
from rejoint.session.motions import ArmMotion, EndedError
from rejoint.session.payload import say_folded, say_heavy, say_noticed
from rejoint.session.session import ArmSession
from rejoint.session.settings import Settings
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_floats, as_seconds, as_within
from rejoint.system.stopping import noted

if TYPE_CHECKING:
    from rejoint.arms.rotations import Orientation
    from rejoint.twin.twin import Twin

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
    rate_hz: float | None = None,
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
    rate_hz
        sends the path as a stream at this rate, not known ahead
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
        return cast(Followed, session.follow(path, repeat=repeat, rate_hz=rate_hz))


@dataclass(frozen=True, kw_only=True, eq=False)
class Follower:
    """What follows a path."""

    name: str
    """of the controller"""
    make: Callable[[float], Controller]
    """for a usual period [s], for each pass"""
    home: Array | None = None
    """(n,) [rad] preferred posture; None: rest"""


@dataclass(kw_only=True, eq=False)
class PathDrive:
    """A path or stream to be followed by a session."""

    session: ArmSession
    path: Path | Stream
    repeat: int
    rate: float | None
    """[Hz] of a stream; None: known ahead"""
    duration: float
    """[s] of a stream"""
    within: float
    """[m] accepted rms"""
    controller: ControllerLike

    @classmethod
    def of(
        cls,
        session: ArmSession,
        path: PathLike | Stream,
        *,
        repeat: int,
        rate: float | None,
        duration: float | None,
        within: float | None,
    ) -> PathDrive:
        """Check the request before anything moves; InputError if impossible."""
        arm, settings = session.arm, session.settings
        accepted = within if within is not None else WITHIN if settings.within is None else settings.within
        require_repeatable(path, repeat, rate, accepted)
        given = followable(path, arm, session.seed, duration)
        if isinstance(given, Path):
            few = slice(None, None, max(1, len(given.place) // LOOKED_AT))
            places, turns = given.place[few], given.turn_at(given.time[few])
            say_heavy(arm, session.twin, places, session.observer.message, turns)
            require_correctable(session.calibration, arm, places)
        wanted, posed = settings.controller, turned(given)
        if wanted is None:
            wanted = TRACKER if session.twin is not None else session.driver(posed=posed)[0]
        follower_of(wanted, session, session.twin, posed=posed)
        return cls(
            session=session,
            path=given,
            repeat=repeat,
            rate=rate,
            duration=duration or 0.0,
            within=accepted,
            controller=wanted,
        )

    def work(self, motion: ArmMotion) -> Followed:
        """Drive; `EndedError` where the motion is asked to end."""
        session = self.session
        session.take_up(None)
        self._motion = motion
        if session.settings.controller is not None:
            session.announce(name_of(self.controller), "as asked for")
        elif self.controller == TRACKER:
            session.instead(TRACKER, "for paths, by the twin")
        self._follower = follower_of(self.controller, session, session.twin_now, posed=turned(self.path))
        if not turned(self.path):
            say_folded(session.arm, self._follower.home, session.observer.message)
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
        duration = LEAD_IN + path.duration + (0.0 if self.rate is None else LAG)
        aim, passes, repetition = wanted, list[Pass](), Repetition(wanted)
        last: Recording | None = None
        for number in range(self.repeat):
            self._approach(wanted.at(0.0), wanted.turn_at(0.0))
            guide = Ahead(path=path, aim=aim)
            told = guide if self.rate is None else played(wanted, self.rate)
            last = self._carry(told, duration, number)
            done = judge(arm, last, Ahead(path=path, aim=wanted), model=session.calibration)
            passes.append(replace(done, log=last.log(0, self._label)))
            aim = repetition.learn(aim, *missed(arm, last, guide, wanted))
        return self._followed(path.name, passes, last)

    def _behind(self, stream: Stream) -> Followed:
        session, arm, home = self.session, self.session.arm, self._follower.home
        at_once = np.zeros(1)
        start, turns = stream.place(0.0), stream.poses(0.0, at_once)[1]
        turn = None if turns is None else turns[0]
        if session.correction is not None and stream.corrected is None:
            stream.corrected = corrector(arm, session.correction, start, turn, home)
            turns = stream.poses(0.0, at_once)[1]
            turn = None if turns is None else turns[0]
        self._approach(start, turn)
        last = self._carry(stream, self.duration, 0)
        done = replace(judge(arm, last, stream, model=session.calibration), log=last.log(0, self._label))
        return self._followed("stream", [done], last)

    def _approach(self, start: Array, turn: Orientation | None) -> None:
        """Bring the arm to the place ``start`` (3,) [m] and ``turn`` ()."""
        session = self.session
        posture = PathPostures(session.arm, start[None], turn and turn[None], self._follower.home).last[0]
        session.go(posture, self._motion.give_up)
        if self._motion.ended.is_set():
            raise EndedError

    def _carry(self, guide: Ahead | Stream, duration: float, number: int) -> Recording:
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

    def _followed(self, path: str, passes: list[Pass], last: Recording | None) -> Followed:
        period = float("nan") if last is None else last.usual_period()
        gaps = () if last is None else tuple(float(gap) for gap in last.gaps() if gap > 0.0)
        return Followed(
            path=path,
            controller=self._follower.name,
            within=self.within,
            passes=tuple(passes),
            period=period if np.isfinite(period) else None,
            gaps=gaps,
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
    if isinstance(given, Iterator):
        raise InputError(
            f"path: expected {expected}, found a generator; make an array of all its points, or put them into a "
            "rejoint.Stream as they come"
        )
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
        turns = given.poses(0.0, np.zeros(1))[1]
        require_reachable(arm, given.place(0.0)[None, None], turns and turns[None])
        return given
    if duration is not None:
        raise InputError("follow: a duration is of a stream; a path takes as long as its times say")
    path = as_path(given, arm, seed)
    path.require_followable(arm)
    return path


def turned(given: Path | Stream) -> bool:
    """Whether a path, or a stream's first target, has an orientation."""
    start = np.zeros(1)
    return (given.turn_at(start) if isinstance(given, Path) else given.poses(0.0, start)[1]) is not None


def require_repeatable(path: PathLike | Stream, repeat: int, rate: float | None, within: float = WITHIN) -> None:
    """Raise InputError for a bad number of repetitions, ``rate`` or ``within``."""
    if rate is not None:
        require_rate(rate)
    as_within("follow", within)
    if (
        not isinstance(repeat, int | np.integer)
        or repeat < 1
        or (repeat > 1 and (rate is not None or isinstance(path, Stream)))
    ):
        raise InputError("follow: to be repeated at least once, and more often only where the path is known ahead")
    if rate is not None and isinstance(path, Stream):
        raise InputError("follow: a rate is for a path that is played as a stream; a stream has its own")


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
