"""Motions of a session: to targets in turn, along paths and streams, and by the orders of other programs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path as FilePath
from typing import TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array, choose_postures, tcp_position
from rejoint.arms.rotations import tool_axis
from rejoint.control.guard import Reason, reason_names
from rejoint.control.loop import Schedule
from rejoint.control.moving.drive import (
    REACHED,
    Deployed,
    Deployment,
    Followed,
    Pass,
    corrected,
    judge,
    judge_targets,
    missed,
    next_aim,
)
from rejoint.control.moving.reference import LEAD_IN, Guide, Path, PathReference, Stream, read_path
from rejoint.control.moving.tracker import PathPostures, Tracker
from rejoint.control.recording import PIECE, Cycle, Observer, Recording, recording_of
from rejoint.control.reference import STUCK, TargetSequence, ToolAtGoals
from rejoint.control.robot import ControlInput, Controller, Relaying, Robot, part_of
from rejoint.control.seeing import Eye, Finishing, Seen, simulated
from rejoint.robots.serving import Clients, OrderLog, ServedArm
from rejoint.runs.run import Run
from rejoint.session.context import correction_of
from rejoint.session.driver import ArmMotion
from rejoint.session.inputs import ArmLike, EyeLike, RobotLike, RunLike, Settings, Targets, as_targets
from rejoint.session.session import Session
from rejoint.system.errors import LOGGER, FileError, InputError, NotReachedError
from rejoint.system.files import saving
from rejoint.system.numbers import as_floats, as_seconds, as_whole, as_within
from rejoint.system.records import Readable, as_options, value_type
from rejoint.system.shell import host_and_port, listen_tcp
from rejoint.system.stopping import Interrupted, noted
from rejoint.twin.twin import Twin


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

    The arm goes slowly to rest, then to each target. On Ctrl-C, SIGTERM and `rejoint.interrupt` it holds, and
    `Interrupted`, a KeyboardInterrupt, is raised.

    Parameters
    ----------
    robot
        robot or its address
    targets
        (K, 3) [m], `Pose` objects, or a CSV file in mm; default: ten random points
    run
        for controller, twin, calibration and log; without one the generic policy drives, and nothing is written
    arm
        needed where neither run nor address tells it
    settings
        controller, payload, time per target (``dwell``), accepted error (``within``) and so on
    observer
        receives messages, progress, ``partial`` results before an error

    Returns
    -------
    Deployed
        ``visits`` of the targets; ``missed``; the run log

    Raises
    ------
    InputError, ContractError
        if controller, period or targets do not fit; nothing has moved
    NotReadyError
        if it is unsafe to move the arm
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds
    UnsavedError
        if writing failed; the error holds the result

    Examples
    --------
    >>> done = rejoint.deploy("emulated:worn", [[0.17, 0.0, 0.2], [0.18, 0.03, 0.21]])
    >>> for visit in done.visits:
    ...     print(visit.target, visit.error, visit.reached, visit.remark)
    """
    with noted(), Session(robot, run=run, arm=arm, settings=settings, observer=observer) as session:
        return session.deploy(targets)


def to_targets(session: Session, targets: Targets | None) -> Callable[[ArmMotion], Deployed]:
    """Return what drives to ``targets``; InputError if impossible, before anything moves."""
    arm, settings = session.arm, session.settings
    points, turned = as_targets(targets, arm, sets=1, seed=session.seed, motors=session.motors)
    if len(points) != 1:
        raise InputError(f"deployment: {len(points)} sets of targets, expected one: (targets, 3) in metres")
    if turned is not None and settings.eye is not None:
        raise InputError("deploy: what a camera sees corrects places only; leave it out, or give points")
    turns = turned and turned[0]
    correction_of(session.calibration, arm, points)
    ways = session.ways(points[0], turns)
    name, controller = session.driver(posed=turns is not None)
    within = settings.within or REACHED
    job = Deployment(controller=name, targets=points[0], dwell=settings.dwell, within=within, turns=turns)

    def watch(cycle: Cycle) -> None:
        target, share = int(cycle.target_index[0]), float(cycle.since_target[0]) / job.dwell
        session.progress((target + min(share, 1.0)) / len(points[0]), f"target {target + 1} of {len(points[0])}")

    def work(motion: ArmMotion) -> Deployed:
        with opened_eye(settings.eye, session.robot, session.run, session.seed) as eye:
            correction, seen, driver = session.correction, None, controller
            session.begin("deploy", name, controller)
            if eye is not None:
                seen = Seen(arm, session.apparent.displacement, eye=eye)
                driver, correction = Finishing(arm, controller, seen), seen
            reference = TargetSequence(arm, points, ways=[ways], turns=turned, correction=correction)

            def judged(recording: Recording, *, ended: bool) -> Deployed:
                sightings, far = ((), None) if seen is None else (seen.visits, seen.shifted())
                if far is not None:
                    LOGGER.warning(
                        "the camera sees the tool %.1f mm to one side of where the calibration has it, at all targets "
                        "alike: were camera or board moved? Then calibrate with the camera again; "
                        "the arm went where it says",
                        1e3 * far,
                    )
                return judge_targets(
                    arm,
                    recording,
                    job,
                    session.calibration,
                    overloaded=session.overloaded,
                    sightings=sightings,
                    ended=ended,
                )

            try:
                recording = session.drive(driver, Schedule(dwell=job.dwell, give_up=motion.give_up), reference, watch)
            except BaseException as error:
                so_far = recording_of(error)
                if so_far is not None and np.isfinite(so_far.target).any():
                    session.observer.partial(judged(so_far, ended=True))
                raise
            found = judged(recording, ended=motion.ended.is_set())
            asked = {"orientations": "; ".join(visit.orientation for visit in found.visits)} if turns else None
            found = replace(found, log=recording.log(0, f"deploy/{name}", asked))
            with saving(found):
                session.recorder.end(extra=asked)
            session.progress(1.0, "done")
        session.say_noticed(found.log)
        return found

    return work


@contextmanager
def opened_eye(given: EyeLike | None, robot: Robot, run: Run | None, seed: int) -> Iterator[Eye | None]:
    """Open the eye for ``robot``; InputError without one. A camera needs the ``camera.toml`` of ``run``."""
    if given is None:
        yield None
    elif given == "emulated":
        yield simulated(robot).eye(seed)
    elif not isinstance(given, str | int):
        yield given if hasattr(given, "sighting") else given(robot)
    elif str(given).isdecimal():
        if np.isfinite(robot.true_tcp()).all():
            raise InputError(f"camera {given} cannot see {robot.address}; watch an emulated arm with --camera emulated")
        from rejoint.camera.tracker import opened_camera

        with opened_camera(int(given), None if run is None else run.folder.camera, robot.arm) as eye:
            yield eye
    else:
        raise InputError(f"no camera is called {given!r}; expected the number of a camera, or emulated")


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

    The arm goes slowly to rest and to the start of the path, waits two seconds, and moves. On Ctrl-C and SIGTERM it
    holds, and `Interrupted` is raised. `Session.follow` follows a `Stream`.

    Parameters
    ----------
    robot
        robot or its address
    path
        `Path`, CSV file ``time,x,y,z`` [s, mm], (T, 4) [s, m], or a standard path such as ``circle-8s``
    run
        run with the twin; keeps the log
    arm
        needed where neither run nor address tells it
    repeat
        how often; each pass corrects earlier errors
    settings
        twin, payload, accepted error (``within``); ``controller``: by default ``tracker`` with a twin, else as for
        points
    observer
        receives messages and progress

    Returns
    -------
    Followed
        for each of the ``passes``: encoder errors [m], true error, run log; ``followed``

    Raises
    ------
    InputError, FileError
        if the path is out of reach or too fast, or without a twin; nothing has moved
    NotReadyError
        if it is unsafe to move the arm
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds

    Examples
    --------
    >>> done = rejoint.follow("emulated:worn", "circle-8s", run="runs/mine")
    >>> print(done.passes[-1].encoder.rms)
    """
    chosen = as_options(settings, Settings)
    chosen = replace(chosen, within=chosen.within or WITHIN)
    with noted(), Session(robot, run=run, arm=arm, settings=chosen, observer=observer) as session:
        return cast(Followed, session.follow(path, repeat=repeat))


def along(
    session: Session, path: PathLike | Stream, *, repeat: int, duration: float | None, within: float | None
) -> Callable[[ArmMotion], Followed | None]:
    """Return what follows a path or stream, None where it is asked to end; InputError before anything moves.

    ``duration`` [s] is of a stream. ``within`` [m] is the accepted rms.
    """
    arm, settings = session.arm, session.settings
    accepted = as_within("follow", (settings.within or WITHIN) if within is None else within)
    if as_whole("repeat", repeat, 1) > 1 and isinstance(path, Stream):
        raise InputError("follow: a stream cannot be repeated, since its path is not known ahead; take repeat=1")
    told = guide_of(path, arm, session.seed, duration)
    told.home(arm, session.motors)
    posed = told.ahead(0.0, np.zeros(1))[1] is not None
    controller = settings.controller or TRACKER
    if settings.controller is None and session.twin is None:
        controller = session.driver(posed=posed)[0]

    def follower(twin: Twin | None) -> tuple[str, Callable[[], Controller]]:
        """Return the name of what follows, and what makes it for each pass."""
        if controller != TRACKER:
            name, make = session.maker(controller, twin, posed=posed)
            return name, partial(make, arm)
        if twin is None:
            raise InputError("follow: the tracker needs a twin; run `rejoint identify` first")
        servos = twin.parameters.repeat(1)
        return TRACKER, lambda: Tracker(arm, servos, period=session.usual)

    follower(session.twin)
    lasts = duration or 0.0
    if isinstance(told, Path):
        lasts = LEAD_IN + told.duration
        correction_of(session.calibration, arm, told.at(told.time[:: max(1, len(told.time) // LOOKED_AT)]))

    def show(number: int, cycle: Cycle) -> None:
        share = min(float(cycle.since_target[0]) / lasts, 1.0)
        session.progress((number + share) / repeat, f"time {number + 1} of {repeat}" if repeat > 1 else "")

    def work(motion: ArmMotion) -> Followed | None:
        session.take_up(None)
        (name, make), guide = follower(session.twin_now), told
        home = guide.home(arm, session.motors)
        if settings.controller is not None or name == TRACKER:
            session.announce(name, "for paths, by the twin" if settings.controller is None else "as asked for")
        label = f"follow/{name}/{guide.name}"
        session.begin("follow", f"{name}/{guide.name}")
        if session.correction is not None:
            guide = corrected(arm, guide, session.correction, home)
        aimed, passes, lesson = guide, list[Pass](), list[Array]()
        for number in range(repeat):
            start = PathPostures(arm, *guide.ahead(0.0, np.zeros(1)), home).last[0]
            session.go(start, motion.give_up)
            away = np.abs(session.robot.read().position[0] - start)
            if away.max() > STUCK[0] and not motion.ended.is_set():
                far = f"{arm.joint_names[away.argmax()]} is {np.degrees(away.max()):.0f} deg from the start of its path"
                raise NotReachedError(
                    f"{far}, and the arm holds: it is blocked or too weak; clear its way, or give other places"
                )
            if repeat > 1:
                session.recorder.begin(session.robot, f"follow-{number + 1:02d}", label)
            schedule = Schedule(dwell=lasts, give_up=motion.give_up)
            reference = PathReference(arm, [aimed], home, motors=session.motors, message=session.observer.message)
            last = session.drive(make(), schedule, reference, partial(show, number))
            if motion.ended.is_set():
                return None
            passes.append(replace(judge(arm, last, guide, model=session.calibration), log=last.log(0, label)))
            if isinstance(guide, Path) and isinstance(aimed, Path):
                aimed = replace(guide, aim=next_aim(guide.aimed, lesson, aimed.aimed, *missed(arm, last, guide)))
        session.followed = Followed(
            path=guide.name, controller=name, within=accepted, passes=tuple(passes), **last.timing()
        )
        session.say_noticed(passes[-1].log)
        return session.followed

    return work


def guide_of(given: PathLike | Stream, arm: Arm, seed: int, duration: float | None) -> Guide:
    """Stream or path from an object, a file, numbers or a standard name; InputError."""
    if isinstance(given, Stream):
        as_seconds("follow: a stream", duration)
        if given.followed:
            raise InputError(
                "follow: this stream was followed already, up to its last target; put targets into another"
            )
        given.axis = tool_axis(arm)
        return given
    if duration is not None:
        raise InputError("follow: a duration is of a stream; a path takes as long as its times say")
    if isinstance(given, Path):
        return given
    if isinstance(given, str | FilePath):
        return read_path(given, arm, seed)
    points = as_floats("path", given, "a Path, a file, or points (K, 4) of time [s] and x, y, z [m]")
    if points.ndim != 2 or points.shape[-1] != 4:
        raise InputError(f"path: an array of shape {points.shape}, expected (points, 4): time [s] and x, y, z [m]")
    return Path(time=points[:, 0], place=points[:, 1:])


WIRE_JOINTS = 6
"""Joints of the only arm whose wire is spoken: a myCobot"""
LONGEST_PIECE = 3.0 * PIECE
"""[s] longest run log of a served arm (chosen)"""
OBSTACLES = np.uint16(Reason.FLOOR | Reason.COLLISION | Reason.POSITION)
"""What the guard prevents for good"""


@value_type
class Serving(Readable):
    """What an arm was served for."""

    address: str
    orders: int
    """of clients, carried out or refused"""
    log: str
    """path of the log of orders"""


def serve(
    robot: RobotLike,
    run: RunLike,
    *,
    listen: str = "127.0.0.1:9000",
    pty: bool = False,
    pace: float = 1.0,
    stop: threading.Event | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Serving:
    """Drive an arm for programs that speak the myCobot's own protocol, until interrupted.

    The arm goes slowly to rest; one client at a time drives it, and it holds in between. Ctrl-C and SIGTERM end the
    serving in a hold.

    Parameters
    ----------
    robot
        robot or its address
    run
        run with the twin; keeps the log of orders and motion
    listen
        HOST:PORT; port 0 is any free one
    pty
        a serial line (pseudo-terminal) instead
    pace
        of an emulated arm: simulated seconds per second
    stop
        ends the serving
    settings
        twin, payload, control period; with a calibration coordinates are the tool's own. ``controller``: by default the
        posture controller, which brings every joint; others bring the tool
    observer
        receives the address for clients, and messages

    Returns
    -------
    Serving
        address, number of orders, path of their log

    Raises
    ------
    InputError
        for an unusable address, or if the arm is no myCobot; nothing has moved
    FileError
        if the run has no twin
    NotReadyError
        if it is unsafe to move the arm
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds

    Examples
    --------
    >>> rejoint.serve("tcp://192.168.1.20:9000", "runs/mine", listen="127.0.0.1:9001")
    >>> rejoint.serve("tcp://192.168.1.20:9000", "runs/mine", pty=True)
    """
    over = stop or threading.Event()
    with (
        noted(),
        ExitStack() as stack,
        Session(robot, run=run, settings=settings, observer=observer, pace=pace) as session,
    ):
        arm, about, say = session.arm, session.run, session.observer.message
        assert about is not None  # noqa: S101 - for the type checker; it was given
        if arm.joints != WIRE_JOINTS:
            raise InputError(
                f"serve: the wire is that of a myCobot with {WIRE_JOINTS} joints, not of {arm.name}; for joint goals "
                "line by line take --stdio"
            )
        if session.twin is None:
            raise FileError(about.folder.twin, "no such file", f"run `rejoint identify {about.path}` first")
        session.correction  # noqa: B018 - what does not fit is refused now
        listener = None if pty else stack.enter_context(listen_tcp(*host_and_port("--listen", listen)))
        path = about.path / "logs" / f"serve-{datetime.now():%Y%m%d-%H%M%S}.jsonl"
        log = OrderLog(path, say=say)
        stack.callback(log.close)
        session.begin("serve", "posture")
        wire = part_of(session.robot, Relaying)
        choose_postures(arm, tcp_position(arm, arm.rest)[None], arm.rest)  # compiled now: no client waits for it
        served = ServedArm(arm, arm.rest, apparent=session.apparent, limits=session.limits, motors=session.motors)
        clients = Clients(served, log, None if wire is None else wire.relay, say, listener)
        served.on_arrival = clients.arrived
        server = clients.server()
        session.watching.append(lambda _: clients.relay())
        log.write("begin", address=server.address, robot=session.address)
        try:
            with server:
                session.observer.served(server.address)
                _drive(session, served, log, lambda: over.is_set() or server.failure is not None)
        except Interrupted as asked:
            say(f"{asked}. {' '.join(asked.__notes__)}")
        if server.failure is not None:
            raise server.failure
        log.write("end", orders=log.orders)
        return Serving(address=server.address, orders=log.orders, log=str(path))


def _drive(session: Session, served: ServedArm, log: OrderLog, over: Callable[[], bool]) -> None:

    def watch(cycle: Cycle) -> None:
        served.held_back = " and ".join(reason_names(cycle.reasons[0] & OBSTACLES))

    def give_up(inputs: ControlInput) -> bool:
        lasted = inputs.state.time[0] - began
        return (lasted > PIECE and not served.moving) or lasted > LONGEST_PIECE or over()

    asked = session.settings.controller is not None
    controller = session.driver()[1] if asked else session.posture_controller()
    reference = ToolAtGoals(session.arm, served) if asked else served
    while not over():
        before, moving, began = log.orders, served.moving, session.robot.read().time[0]
        session.drive(controller, Schedule(dwell=LONGEST_PIECE, give_up=give_up), reference, watch)
        idle = log.orders == before and not moving  # an arm without orders for days fills no disk
        session.recorder.turn(keep=not idle)
