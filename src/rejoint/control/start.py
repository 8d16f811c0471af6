"""How every drive of an arm begins: it is looked at first, and then moved slowly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.control.guard import GuardLimits, Reason
from rejoint.control.playback import move
from rejoint.control.recording import Cycle, OnCycle, Recording
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
FALL = GuardLimits.max_lead + np.radians(5.0)
"""[rad] by which a joint may fall off the way on which it is first sent (chosen: an arm that sags by more than the
guard lets commands lead cannot be driven; of 180 emulated ones, some with 0.25 kg, none fell farther than 21 deg)"""
ASTRAY = np.radians(8.0)
"""[rad] by which it may leave that way without or against its weight (chosen: more than a joint that hunts, see
`STILL`; those arms stayed within 0.5 deg)"""
STRIKES = 2
"""Readings in a row that must say so (chosen: one wrong byte is no news)"""
LIGHT = 1e-3
"""[N m] of weight below which a joint does not fall (chosen: axes that stand upright have less)"""


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

    NotReadyError where it had better not be driven: before it moves, as soon as a joint goes where it is not sent, or
    at rest where the twin expects it elsewhere.
    """
    check_ready(robot)
    motion = move(robot, robot.arm.rest, limits=limits, on_cycle=_FirstWay(robot, on_cycle))
    if stance is not None:
        stance.check(robot.arm, robot.read(), motion.command[-1])
    return motion


class _FirstWay:
    """Looks on at the first motion, and raises NotReadyError as soon as a joint leaves the way on which it is sent.

    An arm whose joint turns the other way than its readings, or whose readings are exchanged, leaves at once the place
    that it is told to keep; nothing else is known of an arm that has not moved yet.
    """

    def __init__(self, robot: Robot, on_cycle: OnCycle | None) -> None:
        self._arm, self._address, self._on_cycle = robot.arm, robot.address, on_cycle
        self._low = self._high = robot.read().position.copy()
        self._strikes = 0

    def __call__(self, cycle: Cycle) -> None:
        if self._on_cycle is not None:
            self._on_cycle(cycle)
        gap = ((cycle.reasons & np.uint16(Reason.GAP.value)) != 0)[:, None]  # somebody may have moved it meanwhile
        self._low = np.where(gap, cycle.position, self._low)
        self._high = np.where(gap, cycle.position, self._high)
        weight = gravity_torque(self._arm, cycle.position)
        below, above = self._low - cycle.position, cycle.position - self._high
        beyond = np.maximum(
            below - np.where(weight > LIGHT, FALL, ASTRAY), above - np.where(weight < -LIGHT, FALL, ASTRAY)
        )
        astray = np.where(cycle.active[:, None], beyond, -np.inf)
        self._strikes = self._strikes + 1 if astray.max() > 0.0 else 0
        if self._strikes >= STRIKES:
            raise NotReadyError(self._describe(cycle.position, astray))
        self._low, self._high = np.minimum(self._low, cycle.command), np.maximum(self._high, cycle.command)

    def _describe(self, position: Array, astray: Array) -> str:
        b, j = np.unravel_index(np.argmax(astray), astray.shape)
        low, found, high = np.degrees([self._low[b, j], position[b, j], self._high[b, j]])
        return (
            f"{self._address}: {self._arm.joint_names[j]} was sent no farther than {low:.0f} to {high:.0f} deg, and "
            f"reads {found:.0f} deg: it turns the other way than it reads, its reading is another joint's, it is "
            "pushed, or it cannot carry its load. Compare directions and cables with the arm's description"
        )


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
