"""How every drive of an arm begins: it is looked at first, and then moved slowly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.control.guard import GuardLimits
from rejoint.control.playback import move
from rejoint.control.recording import OnCycle, Recording
from rejoint.control.robot import JointState, Robot
from rejoint.control.trips import say_faulty, say_hot
from rejoint.system.errors import NotReadyError
from rejoint.system.stopping import pause

BEYOND = np.radians(3.0)
"""[rad] that a joint may stand beyond its limit at the start (chosen: sag and play of a worn arm left there)"""
WARMTH = 5.0
"""[deg C] below what trips the guard that every servo must be at the start (chosen: a drive of minutes warms it)"""
COLDEST, HOTTEST = -20.0, 120.0
"""[deg C] outside of which a temperature is no temperature (chosen: what servos of this class survive)"""
LOOK = 0.3
"""[s] for which an arm is looked at before it is moved (chosen: longer than a worn joint rings)"""
STILL = np.radians(5.0)
"""[rad] that a joint may be away after it (chosen: a joint that hunts in its play stays within)"""
STANCE = np.radians(15.0)
"""[rad] that a joint may stand off from where its twin expects it (chosen: what friction, and a weak motor that starts
late, leave on worn arms, is two thirds of it)"""
FARTHER = np.radians(5.0)
"""[rad] by which it may stand farther off than in its own diagnosis (chosen: a third of that)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stance:
    """Where a twin expects arms that have come to rest: each servo gives way by the weight that it carries."""

    stiffness: Array
    """(n,) [N m/rad] of the servos"""
    offset: Array
    """(n,) [rad] where a servo brings its joint without load, minus the command"""
    off: Array | float = 0.0
    """(n,) [rad] how far from there joints came to rest in their own diagnosis: one too weak to lift the arm stays
    where it once stops"""

    def away(self, arm: Arm, position: Array, command: Array) -> Array:
        """How far (..., n) [rad] off joints at ``position`` (..., n) [rad] are, under the ``command`` in force."""
        expected = command + self.offset - gravity_torque(arm, position) / self.stiffness
        away: Array = np.abs(position - expected)
        return away

    def check(self, arm: Arm, state: JointState, command: Array) -> None:
        """Raise NotReadyError unless the arms of ``state`` stand there, under the ``command`` (B, n) [rad] in force."""
        away, most = self.away(arm, state.position, command), np.maximum(STANCE, self.off + FARTHER)
        most = np.broadcast_to(most, away.shape)
        b, j = np.unravel_index(np.argmax(away - most), away.shape)
        if away[b, j] > most[b, j]:
            raise NotReadyError(
                f"{arm.joint_names[j]} stands {np.degrees(away[b, j]):.0f} deg from where the twin of this run expects "
                f"it, {np.degrees(most[b, j]):.0f} at most were expected: another arm or load, or something in its "
                "way? If it is the same arm and free, run `rejoint diagnose` and `rejoint identify` again"
            )


def begin(
    robot: Robot, limits: GuardLimits | None = None, stance: Stance | None = None, on_cycle: OnCycle | None = None
) -> Recording:
    """Look at the robot, bring it slowly to its rest posture, and look whether it stands as its ``stance`` says.

    NotReadyError where it had better not be driven: before it moves, or at rest where the twin expects it elsewhere.
    """
    check_ready(robot)
    motion = move(robot, robot.arm.rest, limits=limits, on_cycle=on_cycle)
    if stance is not None:
        stance.check(robot.arm, robot.read(), motion.command[-1])
    return motion


def check_ready(robot: Robot) -> None:
    """Raise NotReadyError unless the arms rest inside their limits, cool and without faults."""
    first = robot.read()
    state = robot.read()
    if (state.time > first.time).any():  # virtual time stands still
        pause(LOOK)
        state = robot.read()
    for problem in (_moving(robot.arm, first, state), _outside(robot.arm, state), _unwell(robot.arm, state)):
        if problem:
            raise NotReadyError(f"{robot.address}: {problem}; nothing was moved")


def _moving(arm: Arm, first: JointState, state: JointState) -> str:
    away = np.abs(state.position - first.position)
    j = int(np.argmax(away.max(axis=0)))
    if away[:, j].max() <= STILL:
        return ""
    return f"{arm.joint_names[j]} is moving by itself; wait until the arm rests, and end what else drives it"


def _outside(arm: Arm, state: JointState) -> str:
    believed = GuardLimits.of(arm, margin=-BEYOND)
    beyond = (state.position < believed.lower) | (state.position > believed.upper)
    if not beyond.any():
        return ""
    b, j = np.argwhere(beyond)[0]
    low, angle, high = np.degrees([arm.lower[j], state.position[b, j], arm.upper[j]])
    return (
        f"{arm.joint_names[j]} stands at {angle:.1f} deg, outside its limits of {low:.0f} to {high:.0f} deg; bring it "
        "inside by hand, or correct the arm's zero"
    )


def _unwell(arm: Arm, state: JointState) -> str:
    if state.fault is not None and state.fault.any():
        return say_faulty(arm.joint_names, np.asarray(state.fault.any(axis=0)), state.trouble)
    if state.temperature is None:
        return ""
    if not ((state.temperature > COLDEST) & (state.temperature < HOTTEST)).all():
        return f"temperatures of {np.round(state.temperature).tolist()} deg C are not believed; check the servo bus"
    hottest, limit = state.temperature.max(axis=0), GuardLimits.max_temperature - WARMTH
    return f"{say_hot(arm.joint_names, hottest, limit)} before the start" if (hottest > limit).any() else ""
