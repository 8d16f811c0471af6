"""What the hand of an arm carries: told by its owner, judged before the arm tries, and noticed where nobody told."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rejoint.arms import Arm, Array, gravity_torque, position_kinematics
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.loaded import LoadedArm, Payload, loaded
from rejoint.arms.orientation import Orientation
from rejoint.arms.posing import find_postures
from rejoint.control.moving.posture import joint_weights
from rejoint.logs.runlog import RunLog
from rejoint.runs.given import RobotLike
from rejoint.system.errors import InputError

if TYPE_CHECKING:
    from rejoint.twin.twin import Twin

PayloadLike: TypeAlias = "float | Payload"
"""A mass at the tool centre point [kg], or with its centre of mass"""

Say: TypeAlias = Callable[[str], object]
"""Told, in lines, what a person should know"""

STILL = 0.4
"""[s] for which a joint stands before its torque counts as that of its load (chosen: longer than a worn joint rings)"""
SURE = 3.0
"""Standard errors from which a load counts as noticed (chosen on eight worn arms, see docs/daily-use.md)"""
ALONE = 0.08
"""[kg] standard error of what one posture tells, and its share of what several do (measured on three worn arms, their
hands empty: one posture seemed to carry -0.14 to 0.12, three -0.06 to 0.07, five -0.03 to 0.02, ten -0.02 to 0.01)"""
LEAST = 0.04
"""[kg] that counts as a load at least (chosen: four times what eight worn arms with empty hands seemed to carry)"""
RUBBING, BELIEVED = 0.1, 0.85
"""Share of its load that a joint rubs with, and share of a twin's torque limit that a motor has (chosen on eight worn
arms of family 4, see docs/daily-use.md: twins take motors for 10 to 20 % stronger)"""
_NAMED = 5  # targets that a line names


def silent(line: str) -> None:
    """Tell nobody."""


def with_load(arm: Arm, robot: RobotLike, payload: PayloadLike | None, tool: ArrayLike | None) -> Arm:
    """Return the arm as its owner says that it is loaded; InputError for an open robot, which has its own."""
    found = loaded(arm, payload, tool)
    if found is not arm and not isinstance(robot, str):
        raise InputError("a payload or a tool is told with the address of a robot, not with one that is open already")
    return found


def say_heavy(arm: Arm, twin: Twin | None, targets: Array, say: Say, turns: Orientation | None = None) -> None:
    """Say at which ``targets`` (..., 3) [m] a told load is too heavy, as far as the twin knows the motors.

    The tools are turned there as in ``turns`` (...).
    """
    if twin is None or not isinstance(arm, LoadedArm):
        return
    points = targets.reshape(-1, 3)
    sure = heavy(arm, twin, points, turns and turns.flat)
    perhaps = heavy(arm, twin, points, turns and turns.flat, seen=False) & ~sure.any(axis=1, keepdims=True)
    if sure.any():
        say(f"Too heavy for {_named(arm, points, sure)}. The arm tries, but may not come there.")
    if perhaps.any():
        say(f"Perhaps too heavy for {_named(arm, points, perhaps)}: what that can lift was never seen. The arm tries.")


def _named(arm: Arm, points: Array, over: NDArray[Any]) -> str:
    """Name the motors that are too weak, and at which ``points`` (K, 3) [m], where ``over`` (K, n) says so."""
    which = np.flatnonzero(over.any(axis=1))
    joints = ", ".join(arm.joint_names[j] for j in range(arm.joints) if over[:, j].any())
    places = "; ".join(f"({', '.join(f'{1e3 * value:.0f}' for value in points[k])}) mm" for k in which[:_NAMED])
    more = f" and {len(which) - _NAMED} more" if len(which) > _NAMED else ""
    return f"the motor of {joints} by the twin: {places}{more}"


def heavy(arm: Arm, twin: Twin, targets: Array, turns: Orientation | None = None, *, seen: bool = True) -> NDArray[Any]:
    """Return which joints (K, n) are too weak to lift the arm at ``targets`` (K, 3) [m], against friction.

    Joints count whose torque limit the twin has ``seen``; or those alone of which it has not, and only believes one.
    Light joints do not count: the others make up for them.
    """
    from rejoint.twin.parameters import Layout

    known = twin.identified[Layout(arm.joints).at("torque_limit")]
    start = np.broadcast_to(arm.rest, (len(targets), arm.joints))
    load = np.abs(gravity_torque(arm, find_postures(arm, targets, start, turns)))
    own = twin.parameters
    over = (1.0 + RUBBING) * load + 2.0 * own.coulomb > BELIEVED * own.torque_limit
    return over & (joint_weights(arm) <= 1.0) & (known == seen)


def noticed_load(arm: Arm, twin: Twin, log: RunLog) -> tuple[float, float]:
    """Estimate the mass [kg] at the tool that nobody told, and its standard error, where joints of a log stand.

    What a servo gives while it stands, by its stiffness, is what it carries, plus or minus friction. Joints at their
    torque limit are left out, so that it is rather too small. NaN where nothing stands still.
    """
    rows = _standing(log)
    if not len(rows):
        return float("nan"), float("nan")
    position, own = log.position[rows], twin.parameters
    torque = own.stiffness * (log.command[rows] + own.offset - position)
    missing = torque - gravity_torque(arm, position)
    lever = -position_kinematics(arm, position)[1].swapaxes(-1, -2) @ GRAVITY  # [m^2/s^2]: torque per mass
    free = np.abs(torque) < 0.9 * own.torque_limit  # at its limit a motor gives less than its stiffness says
    # Friction holds anything between plus and minus its size, all equally likely.
    least = 0.02 * np.abs(gravity_torque(arm, position)).max()
    doubt = np.broadcast_to(np.maximum(own.coulomb, least) / np.sqrt(3.0), missing.shape)
    weight = np.where(free, 1.0 / doubt, 0.0)
    total = float(((lever * weight) ** 2).sum())
    if total <= 0.0:
        return float("nan"), float("nan")
    doubtful = max(1.0 / np.sqrt(total), ALONE / len(rows))  # joints stick to one side, and share it in a posture
    return float((lever * weight**2 * missing).sum() / total), float(doubtful)


def say_folded(arm: Arm, home: Array | None, say: Say) -> None:
    """Say that the arm keeps a joint turned on its way, where its ``home`` (n,) [rad] is not rest."""
    away = np.zeros(arm.joints) if home is None else home - arm.rest
    joint = int(np.abs(away).argmax())
    if away[joint] != 0.0:
        say(
            f"A motor of this arm hardly lifts what hangs on it: {arm.joint_names[joint]} is kept about "
            f"{np.degrees(away[joint]):+.0f} deg from rest on the way, so that less does."
        )


def say_noticed(arm: Arm, twin: Twin | None, log: RunLog | None, say: Say) -> None:
    """Say that the arm carries something else than it was told, where the sag of a ``log`` shows it."""
    if twin is None or log is None:
        return
    mass, doubt = noticed_load(arm, twin, log)
    if not mass > max(LEAST, SURE * doubt):
        return
    more = " more than was told" if isinstance(arm, LoadedArm) else ""
    say(
        f"The joints sag as if the hand carried about {1e3 * mass:.0f} g{more}: tell it with --payload, or identify "
        "again if the arm itself has changed."
    )


def _standing(log: RunLog) -> NDArray[Any]:
    """Rows of a log, one for each time that all joints have stood for `STILL`."""
    moved = np.abs(np.diff(log.position, axis=0)).max(axis=1) > 1.5 * _step(log)
    sent = np.abs(np.diff(log.command, axis=0)).max(axis=1) > np.radians(0.5)
    last, found, posture = log.time[0], [], None
    for k in range(1, len(log.time)):
        if moved[k - 1] or sent[k - 1]:
            last = log.time[k]
        elif log.time[k] - last >= STILL:
            if posture is None or np.abs(log.position[k] - posture).max() > np.radians(2.0):
                found.append(k)
                posture = log.position[k]
            else:
                found[-1] = k  # the later one has settled more
    return np.array(found, dtype=int)


def _step(log: RunLog) -> float:
    """Smallest motion [rad] that the encoders of a log show."""
    steps = np.abs(np.diff(log.position, axis=0))
    return float(steps[steps > 1e-9].min(initial=np.radians(0.1)))
