"""Gains: what the servos' own loops can do, tried on the arm, and kept there if its owner wants that."""

from __future__ import annotations

from typing import cast

from rejoint.control.observer import Observer, pacing
from rejoint.control.servogains import GEARED, RIVALS, GainsFound, ServoGains, Tunable, gains_in_force, search
from rejoint.control.targets import draw_targets
from rejoint.runs.run import Run
from rejoint.session.controllers import recommended
from rejoint.session.inputs import RobotLike, RunLike
from rejoint.session.recorder import kept_if_stopped
from rejoint.session.session import ArmSession
from rejoint.session.settings import Settings
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_json, saving, set_aside, write_json
from rejoint.system.stopping import noted

TARGETS = 4
"""that each round goes to (chosen: two sides and two heights)"""


def gains(
    robot: RobotLike, run: RunLike, *, settings: Settings | None = None, observer: Observer | None = None
) -> GainsFound:
    """Search for better gains of the servos' own position loops, on the arm itself (about three minutes).

    The arm goes to four targets again and again, with one value more of P, dead zone, startup force and I each time;
    every joint keeps what brings it nearer to its command and leaves it quiet. Nothing is kept over a loss of power,
    and at the end, or at a signal, the gains are as they were. `compare` then tries them beside all others.

    Parameters
    ----------
    robot
        robot or its address: an SO-101 on its own bus, or an emulated one
    run
        run, or its folder, into which ``gains.json`` is written
    settings
        control period
    observer
        receives progress, and what is being tried

    Returns
    -------
    GainsFound
        gains by name, one of each joint, as they were and as they are best, and what is left of the errors

    Raises
    ------
    InputError
        if the robot tells no gains; nothing has moved
    NotReadyError
        if the arm had better not be moved
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds, its gains are as before
    UnsavedError
        if the result could not be written; it is in the error

    Examples
    --------
    >>> found = rejoint.gains("feetech:///dev/ttyACM0", "runs/mine")
    >>> print(found.alone["p"], 1e3 * found.with_alone.tool)
    """
    with (
        pacing(observer) as update, noted(),
        ArmSession(robot, run=run, settings=settings, observer=observer) as session,
        session.metered("gains") as tried,
    ):  # fmt: skip
        points = draw_targets(session.arm, sets=1, count=TARGETS, seed=session.seed)[0]
        with kept_if_stopped(session.run, "gains"):
            found = search(cast(Tunable, tried), points, limits=session.limits, on_progress=update)
        if session.run is not None:
            with saving(found):
                set_aside(session.run.folder.gains)
                write_json(session.run.folder.gains, found)
    return found


def gains_to_keep(run: Run) -> ServoGains:
    """Return the gains of the controller that ``run`` recommends; without a comparison the best for the servos alone.

    FileError where none were searched for, InputError where the comparison recommends a controller under those before.
    """
    if not run.folder.gains.exists():
        raise FileError(run.folder.gains, "no such file", f"run `rejoint gains ROBOT {run.path}` first")
    found = read_json(run.folder.gains, GainsFound)
    best = recommended(run) if run.folder.comparison.exists() else GEARED
    if best not in RIVALS:
        raise InputError(f"{run.path} recommends {best}, under the gains that the servos had; there is nothing to keep")
    return found.alone if best == GEARED else found.under


def keep_gains(robot: RobotLike, run: RunLike, wanted: ServoGains) -> ServoGains:
    """Have the servos keep the gains ``wanted`` without power; returns those before.

    Nothing else writes their memory.
    """
    with noted(), ArmSession(robot, run=run) as session:
        before = gains_in_force(session.robot)
        if before is None:
            raise InputError(f"{session.address} has no servo gains that could be kept")
        cast(Tunable, session.robot).keep(wanted)
    return before
