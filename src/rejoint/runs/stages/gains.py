"""Gains: what the servos' own loops can do, tried on the arm, and kept there if its owner wants that."""

from __future__ import annotations

from typing import cast

from rejoint.control.comparison.targets import draw_targets
from rejoint.control.gainsearch import GainsFound, search
from rejoint.control.geared import GEARED, RIVALS
from rejoint.control.servogains import ServoGains, Tunable, gains_in_force
from rejoint.runs.given import (
    Live,
    Period,
    RobotLike,
    RunLike,
    address_of,
    as_run,
    opened,
    shown,
)
from rejoint.runs.metering import metered
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.controllers import recommended
from rejoint.runs.stages.keeping import kept_if_stopped
from rejoint.runs.stages.known import guard_limits
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_json, require_space, saving, set_aside, write_json
from rejoint.system.progress import Progress, no_progress, paced
from rejoint.system.stopping import noted

TARGETS = 4
"""that each round goes to (chosen: two sides and two heights, in ten seconds)"""


@paced
def gains(
    robot: RobotLike, run: RunLike, *, period: Period | None = None, on_progress: Progress = no_progress,
    live: Live | None = None,
) -> GainsFound:  # fmt: skip
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
    period
        [s] interval of the control periods; by default what the robot suits
    on_progress
        called with the share that is done and what is being tried
    live
        shows the arm meanwhile: a `LiveView`

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
    about = as_run(run)
    with (
        exclusive(about), noted(), metered(about.folder, "gains") as meter,
        opened(robot, about.arm, about.seed, period) as connection,
    ):  # fmt: skip
        require_space(about.path)
        points = draw_targets(about.arm, sets=1, count=TARGETS, seed=about.seed)[0]
        limits = guard_limits(about, about.arm, address_of(robot))
        with kept_if_stopped(about, "gains"):
            found = search(
                cast(Tunable, shown(live, meter.watch(connection))), points, limits=limits, on_progress=on_progress
            )
        with saving(found):
            set_aside(about.folder.gains)
            write_json(about.folder.gains, found)
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

    The only thing that writes the memory of an arm: each servo's lock is open for as long as it takes. Nothing moves
    but what other gains let sag or rise.
    """
    about = as_run(run)
    with exclusive(about), noted(), opened(robot, about.arm, about.seed, None) as connection:
        before = gains_in_force(connection)
        if before is None:
            raise InputError(f"{address_of(robot)} has no servo gains that could be kept")
        cast(Tunable, connection).keep(wanted)
    return before
