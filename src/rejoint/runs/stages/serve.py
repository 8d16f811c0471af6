"""Serving: the owner's programs drive an arm through the vendor's client, with a controller behind it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, cast

from numpy.typing import ArrayLike

from rejoint.arms import Arm
from rejoint.control.guard import GuardLimits
from rejoint.control.posture import PostureController
from rejoint.control.robot import Robot
from rejoint.control.start import begin
from rejoint.robots import place_of
from rejoint.robots.serving.answering import Answering
from rejoint.robots.serving.apparent import Apparent, Shift
from rejoint.robots.serving.drive import ServedDrive, ServedWay
from rejoint.robots.serving.orderlog import OrderLog
from rejoint.robots.serving.relay import Relay
from rejoint.robots.serving.served import ServedArm
from rejoint.robots.serving.server import WireServer, pty_wire, tcp_wire
from rejoint.robots.wallclock import WallClock
from rejoint.runs.given import (
    CalibrationLike,
    Live,
    Period,
    RobotLike,
    RunLike,
    TwinLike,
    address_of,
    as_run,
    as_twin,
    opened,
    shown,
)
from rejoint.runs.run import exclusive
from rejoint.runs.stages.keeping import kept_if_stopped
from rejoint.runs.stages.known import correction_of, guard_limits, stance_of
from rejoint.runs.stages.loads import PayloadLike, with_load
from rejoint.runs.stages.longlog import LongLog
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import require_space
from rejoint.system.listening import listen_tcp
from rejoint.system.stopping import Interrupted, noted

if TYPE_CHECKING:
    import socket

    from rejoint.runs.run import Run
    from rejoint.twin.twin import Twin

WIRE_JOINTS = 6
"""Joints of the only arm whose wire is spoken: a myCobot"""
LABEL = "serve/posture"


@dataclass(frozen=True, kw_only=True)
class Serving:
    """What an arm was served for."""

    address: str
    """where it was served"""
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
    twin: TwinLike | None = None,
    calibration: CalibrationLike | None = None,
    payload: PayloadLike | None = None,
    tool: ArrayLike | None = None,
    period: Period | None = None,
    pace: float = 1.0,
    stop: threading.Event | None = None,
    say: Callable[[str], object] = lambda _: None,
    on_address: Callable[[str], object] = lambda _: None,
    live: Live | None = None,
) -> Serving:
    """Speak the myCobot's own wire to programs and drive the arm behind it, until interrupted.

    The arm is looked at first and goes slowly to its rest posture; then programs drive it. One client at a time; where
    it goes, the arm holds. Ctrl-C and SIGTERM bring the arm to a hold, and end the serving.

    Parameters
    ----------
    robot
        robot or its address
    run
        run, or its folder, with the twin; orders and motion are logged there
    listen
        HOST:PORT of the TCP port, where port 0 is any free one
    pty
        serve a serial line (pseudo-terminal) instead
    twin
        twin or its file; by default that of the run
    calibration
        what lies behind the encoders, or its file: coordinates are then those of the tool itself; ``none`` for those
        by the encoders. By default that of ``run``
    payload
        [kg] that the hand carries at its tool centre point, or a `Payload`; everything is computed with it
    tool
        (3,) [m] from the tool centre point of the arm's description to the tip of a tool, in the frame of the former
    period
        [s] interval of the control periods; by default what the robot suits
    pace
        simulated seconds per second, for an emulated arm of this process
    stop
        ends the serving when it is set, for programs with threads
    say
        told, in lines, what a person should know: clients that come and go, refused orders
    on_address
        told where a client finds the arm, once it can be reached
    live
        shows the arm meanwhile: a `LiveView`

    Returns
    -------
    Serving
        where it was served, how many orders came, and the path of their log

    Raises
    ------
    InputError
        if the address cannot be used, or the arm is no myCobot; nothing has moved
    FileError
        if the run has no twin
    NotReadyError
        if the arm had better not be moved
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds

    Examples
    --------
    >>> rejoint.serve("tcp://192.168.1.20:9000", "runs/mine", listen="127.0.0.1:9001")
    >>> rejoint.serve("tcp://192.168.1.20:9000", "runs/mine", pty=True, on_address=print)
    """
    about = as_run(run)
    if about.arm.joints != WIRE_JOINTS:
        raise InputError(
            f"serve: the wire is that of a myCobot with {WIRE_JOINTS} joints, not of {about.arm.name}; for joint goals "
            "line by line take --stdio"
        )
    arm = with_load(about.arm, robot, payload, tool)
    over = threading.Event() if stop is None else stop
    with exclusive(about), ExitStack() as stack:
        known = _twin(about, twin)
        make = correction_of(calibration, about, arm, address_of(robot))
        require_space(about.path)
        listener = None if pty else stack.enter_context(listen_tcp(*_host_and_port(listen)))
        path = about.path / "logs" / f"serve-{datetime.now():%Y%m%d-%H%M%S}.jsonl"
        log = OrderLog(path, say=say)
        stack.callback(log.close)
        stack.enter_context(noted())
        connection = stack.enter_context(opened(robot, arm, about.seed, period))
        connection = shown(live, _in_wall_time(connection, robot, pace), twin=known, paced=False)
        limits = guard_limits(about, arm, connection.address)
        motion = LongLog(about, connection, "serve", LABEL, say)
        stack.callback(motion.end, None)
        with kept_if_stopped(about, "serve"):
            start = begin(connection, limits, stance_of(known, about))
        shift = None if make is None else make(arm).shift
        drive, server = _put_together(connection, arm, known, shift, limits, log, listener, over, say)
        log.write("begin", address=server.address, robot=connection.address)
        try:
            with server:
                on_address(server.address)
                drive.until_over(start.command[-1], motion)
        except Interrupted as asked:
            say(f"{asked}. {' '.join(asked.__notes__)}")
        if server.failure is not None:
            raise server.failure
        log.write("end", orders=log.orders)
        return Serving(address=server.address, orders=log.orders, log=str(path))


def _put_together(
    robot: Robot, arm: Arm, twin: Twin, shift: Shift | None, limits: GuardLimits, log: OrderLog,
    listener: socket.socket | None, over: threading.Event, say: Callable[[str], object],
) -> tuple[ServedDrive, WireServer]:  # fmt: skip
    """Put control loop and server together around one served arm."""
    relay = Relay(getattr(robot, "relay", None))
    served = ServedArm(arm, arm.rest, apparent=Apparent(arm=arm, shift=shift), limits=limits)
    answering = Answering(served, log, relay, say)
    served.on_arrival = answering.arrived
    server = pty_wire(answering, say) if listener is None else tcp_wire(answering, listener, say)
    way, parameters = ServedWay(served), twin.parameters
    controller = PostureController(arm, way, stiffness=parameters.stiffness, offset=parameters.offset)
    drive = ServedDrive(
        robot=robot, served=served, controller=controller, way=way, limits=limits, relay=relay,
        over=lambda: over.is_set() or server.ended, orders=lambda: log.orders,
    )  # fmt: skip
    return drive, server


def _twin(run: Run, given: TwinLike | None) -> Twin:
    """Return the twin given, or that of the run; FileError where there is none."""
    if given is None and not run.folder.twin.exists():
        raise FileError(run.folder.twin, "no such file", f"run `rejoint identify {run.path}` first")
    return as_twin(run.folder.twin if given is None else given)


def _host_and_port(text: str) -> tuple[str, int]:
    """Read HOST:PORT; InputError for anything else."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not (port.isascii() and port.isdecimal()):
        raise InputError(f"--listen {text!r}: expected HOST:PORT, such as 127.0.0.1:9000")
    return host, int(port)


def _in_wall_time(robot: Robot, given: RobotLike, pace: float) -> Robot:
    """Return a robot whose time is that of the clients."""
    virtual = isinstance(given, str) and place_of(given).virtual
    return cast(Robot, WallClock(robot, lambda: pace)) if virtual else robot
