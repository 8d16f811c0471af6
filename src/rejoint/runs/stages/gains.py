"""A search for better gains of the servos' own loops."""

from __future__ import annotations

from rejoint.control.recording import Observer, pacing
from rejoint.control.servogains import GEARED, RIVALS, GainsFound, ServoGains, search, tunable
from rejoint.control.targets import draw_targets
from rejoint.runs.run import Run
from rejoint.session.context import ControllerMaker, tuned_gains
from rejoint.session.inputs import RobotLike, RunLike, Settings
from rejoint.session.session import ArmSession
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import saving, set_aside, write_json
from rejoint.system.stopping import noted

TARGETS = 4
"""per round; chosen: two sides and two heights"""


def gains(
    robot: RobotLike, run: RunLike, *, settings: Settings | None = None, observer: Observer | None = None
) -> GainsFound:
    """Search for better gains of the servos' own position loops, on the arm itself (about three minutes).

    The arm repeats four targets with other P, dead zone, startup force and I; each joint keeps what brings it nearer
    without noise. Afterwards the gains are as before; `compare` tries the best.

    Parameters
    ----------
    robot
        robot or its address: an SO-101, or an emulated one
    run
        run, or its folder, for ``gains.json``
    settings
        control period
    observer
        receives progress and trials

    Returns
    -------
    GainsFound
        gains per joint, before and best, and errors

    Raises
    ------
    InputError
        if the robot reports no gains; nothing has moved
    NotReadyError
        if the motion is unsafe
    GuardTripError, RobotError
        if the motion was ended; the arm holds, gains as before
    UnsavedError
        if writing failed; the error holds the result

    Examples
    --------
    >>> found = rejoint.gains("feetech:///dev/ttyACM0", "runs/mine")
    >>> print(found.alone["p"], 1e3 * found.with_alone.tool)
    """
    with (
        pacing(observer) as update,
        noted(),
        ArmSession(robot, run=run, settings=settings, observer=observer) as session,
        session.metered("gains") as tried,
    ):
        points = draw_targets(session.arm, sets=1, count=TARGETS, seed=session.seed)[0]
        found = search(tried, points, limits=session.limits, on_progress=update)
        if session.run is not None:
            with saving(found):
                set_aside(session.run.folder.gains)
                write_json(session.run.folder.gains, found)
    return found


def gains_to_keep(run: Run) -> ServoGains:
    """Recommended controller's gains; without a comparison those for the servos alone.

    FileError without a search, InputError if nothing else is recommended.
    """
    found = tuned_gains(run)
    if found is None:
        raise FileError(run.folder.gains, "no such file", f"run `rejoint gains ROBOT {run.path}` first")
    best = ControllerMaker(run.arm, run=run).choice()[0] if run.folder.comparison.exists() else GEARED
    if best not in RIVALS:
        raise InputError(f"{run.path} recommends {best}, under the gains that the servos had; there is nothing to keep")
    return found.alone if best == GEARED else found.under


def keep_gains(robot: RobotLike, run: RunLike, wanted: ServoGains) -> ServoGains:
    """Write ``wanted`` to the servos' permanent memory; returns the gains before."""
    with noted(), ArmSession(robot, run=run) as session:
        servos, before = tunable(session.robot)
        servos.keep(wanted)
    return before
