"""Serving an arm to programs of the vendor's client."""

import threading
from collections.abc import Callable
from contextlib import ExitStack
from datetime import datetime

import numpy as np

from rejoint.arms import choose_postures, tcp_position
from rejoint.control.guard import Reason, reason_names
from rejoint.control.loop import Schedule
from rejoint.control.recording import PIECE, Cycle, Observer
from rejoint.control.reference import ToolAtGoals
from rejoint.control.robot import ControlInput, Relaying, part_of
from rejoint.robots.serving import Clients, OrderLog, ServedArm
from rejoint.session.inputs import RobotLike, RunLike, Settings
from rejoint.session.session import ArmSession
from rejoint.system.errors import FileError, InputError
from rejoint.system.records import Readable, value_type
from rejoint.system.shell import host_and_port, listen_tcp
from rejoint.system.stopping import Interrupted, noted

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
        ArmSession(robot, run=run, settings=settings, observer=observer, pace=pace) as session,
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
        session.beside.append(clients.relay)
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


def _drive(session: ArmSession, served: ServedArm, log: OrderLog, over: Callable[[], bool]) -> None:

    def watch(cycle: Cycle) -> None:
        served.held_back = " and ".join(reason_names(cycle.reasons[0] & OBSTACLES))

    def give_up(inputs: ControlInput) -> bool:
        lasted = inputs.state.time[0] - began
        rests = lasted > PIECE and not served.moving
        return rests or lasted > LONGEST_PIECE or over()

    asked = session.settings.controller is not None
    controller = session.driver()[1] if asked else session.posture_controller()
    reference = ToolAtGoals(session.arm, served) if asked else served
    while not over():
        before, moving, began = log.orders, served.moving, session.robot.read().time[0]
        session.drive(controller, Schedule(dwell=LONGEST_PIECE, give_up=give_up), reference, watch)
        idle = log.orders == before and not moving  # an arm without orders for days fills no disk
        session.recorder.turn(keep=not idle)
