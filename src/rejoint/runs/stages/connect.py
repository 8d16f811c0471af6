"""Connecting to a robot: to its bare joints, or, with a run, to an arm that hits what it is sent to."""

from __future__ import annotations

from typing import overload

from numpy.typing import ArrayLike

from rejoint.control.robot import Robot
from rejoint.robots import open_robot
from rejoint.runs.given import ArmLike, CalibrationLike, Period, RunLike, as_arm, as_run
from rejoint.runs.stages.controllers import ControllerLike
from rejoint.runs.stages.driven import DrivenArm
from rejoint.runs.stages.loads import PayloadLike, Say, silent, with_load
from rejoint.system.errors import InputError


@overload
def connect(
    address: str, *, arm: ArmLike | None = None, seed: int = 0, count: int = 1, period: Period | None = None
) -> Robot: ...
@overload
def connect(
    address: str, *, run: RunLike, controller: ControllerLike | None = None,
    calibration: CalibrationLike | None = None, payload: PayloadLike | None = None, tool: ArrayLike | None = None,
    seed: int = 0, period: Period | None = None, say: Say = silent,
) -> DrivenArm: ...  # fmt: skip
def connect(
    address: str, *, run: RunLike | None = None, controller: ControllerLike | None = None,
    calibration: CalibrationLike | None = None, payload: PayloadLike | None = None, tool: ArrayLike | None = None,
    arm: ArmLike | None = None, seed: int = 0, count: int = 1, period: Period | None = None, say: Say = silent,
) -> Robot | DrivenArm:  # fmt: skip
    """Connect to a robot; nothing moves. With a run, the arm is then driven to points, under the guard.

    Parameters
    ----------
    address
        ``emulated:worn`` (in this process, virtual time), ``tcp://HOST:PORT`` or ``serial:///dev/DEVICE``
    run
        run, or its folder: its controller drives the arm, and what it does is logged there
    controller
        policy, its file, or the name of a baseline; by default what the run recommends
    calibration
        what lies behind the encoders, or its file, or ``none``; by default that of ``run``
    payload
        [kg] that the hand carries at its tool centre point, or a `Payload`; everything is computed with it
    tool
        (3,) [m] from the tool centre point of the arm's description to the tip of a tool, in the frame of the former
    arm
        arm, name or file; by default that of the run, or the one that the address names, else a myCobot 280
    seed
        of everything random in an emulated arm, and of the lengths of the control cycles
    count
        number of emulated arms that move side by side as one batch; one with a run
    period
        [s] interval from which the length of every control cycle is drawn; by default the robot's own
    say
        with a run: told, in lines, before the arm moves to a place that is too heavy for its motors

    Returns
    -------
    Robot or DrivenArm
        Without a run a robot: read it with ``read()``, command it with ``step(command)``, (count, n) [rad], and end
        with ``close()``. Nothing between the two guards the arm. With a run a `DrivenArm`.

    Raises
    ------
    AddressError
        if nothing usable is there
    MissingExtraError
        for an emulated arm without the simulator
    InputError, ContractError
        if run, controller and arm do not fit

    Examples
    --------
    >>> robot = rejoint.connect("emulated:worn")
    >>> state = robot.step(robot.read().position + 0.01)
    >>> robot.close()
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.move_to([0.2, 0.05, 0.18])
    """
    if run is None:
        if any(given is not None for given in (controller, calibration, payload, tool)):
            raise InputError("connect: controller, calibration, payload, tool need a run: connect(address, run=...)")
        return open_robot(address, arm=None if arm is None else as_arm(arm), seed=seed, count=count, period=period)
    if arm is not None or count != 1:
        raise InputError("connect: with a run there is one arm, that of the run; leave arm and count out")
    about = as_run(run)
    loaded = with_load(about.arm, address, payload, tool)
    return DrivenArm(
        address, about, arm=loaded, controller=controller, calibration=calibration, seed=seed, period=period, say=say
    )
