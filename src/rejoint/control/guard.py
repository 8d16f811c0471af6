"""The guard between controller and robot.

Limits change a command; trips (`TRIPS`) return the last one, and the loop stops the robot. Limits apply in the order
lead, position, step, acceleration, floor, contacts. All but the first two only shorten the step, so a hold is always
allowed. The guard judges the commanded posture, and what a step does to the measured one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from enum import IntFlag
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Mask
from rejoint.arms.arm import freeze, frozen
from rejoint.arms.collision import JOINT_CLEARANCE, CollisionShape, clearances_of, collision_shape, usual_distances
from rejoint.arms.kinematics import chain_of
from rejoint.arms.workspace import length_size
from rejoint.control.monitor import Bands
from rejoint.control.robot import JointState
from rejoint.system.errors import InputError
from rejoint.system.records import entity
from rejoint.system.shell import Late

compiled, kinematics = Late("rejoint.control.compiled"), Late("rejoint.arms.compiled")

Reasons = NDArray[np.uint16]

NEAR = 0.007
"""[m] between measured bodies (chosen: links that are 5 mm thicker touch nothing)"""
MARGIN = np.radians(0.5)
"""[rad] inside the joint limits (chosen)"""
RAMP = 0.018
"""[s] to full speed (chosen: the shortest trained period)"""
MAX_LEAD = np.radians(20.0)
"""[rad] largest following error (chosen: twice a worn arm's sag)"""
MAX_PERIOD, MAX_AGE = 0.1, 0.5
"""[s] longest counted cycle (chosen), and age of a reading (chosen: ten periods of the slowest wire)"""
MAX_TEMPERATURE = 65.0
"""[deg C] (chosen: 5 below the usual 70)"""
RANGE_MARGIN = np.radians(10.0)
"""[rad] of readings outside the limits (chosen)"""


class Reason(IntFlag):
    """Why the guard changed a command or tripped."""

    NONE = 0
    POSITION = 1
    STEP = 2
    """too fast"""
    LEAD = 4
    """too far from the measured position, or from where a joint stands that has not moved yet"""
    FLOOR = 8
    """too low"""
    NOT_FINITE = 16
    STALE = 32
    OUT_OF_RANGE = 64
    """far outside the joint limits"""
    TEMPERATURE = 128
    SERVO_FAULT = 256
    GAP = 512
    """pause in the answers, or a flagged joint broke loose"""
    NOT_FOLLOWING = 1024
    """reading constant and not trusted, see `rejoint.control.monitor`"""
    ACCELERATION = 2048
    COLLISION = 4096
    """of links, ground or boxes"""


TRIPS = (
    Reason.NOT_FINITE
    | Reason.STALE
    | Reason.OUT_OF_RANGE
    | Reason.TEMPERATURE
    | Reason.SERVO_FAULT
    | Reason.NOT_FOLLOWING
)
"""Reasons that end the motion"""


class Rules(NamedTuple):
    """`GuardLimits` in compiled loops."""

    lower: Array
    upper: Array
    max_speed: Array
    max_acceleration: Array
    near: Array
    parts: int


@entity
class GuardLimits:
    """Limits of an arm."""

    arm: Arm
    lower: Array
    """(n,) [rad]"""
    upper: Array
    """(n,) [rad]"""
    max_speed: Array
    """(n,) [rad/s]"""
    max_acceleration: Array
    """(n,) [rad/s^2] away from rest"""
    floors: Array
    """(n,) [m] of joint frames but the first, and TCP"""
    collisions: bool = True
    """prevent contacts"""
    parts: int = 16
    """tried parts of a step (chosen)"""
    bands: Bands | None = None
    gains: Mapping[str, tuple[int, ...]] | None = None
    """of `bands`; None: any"""

    def __post_init__(self) -> None:
        freeze(self)
        positive = (self.lower < self.upper) & (self.max_speed > 0.0) & (self.max_acceleration > 0.0)
        positive &= self.floors < np.inf  # and no NaN anywhere
        if not (positive & np.isfinite(self.lower + self.upper + self.max_speed)).all():
            raise InputError("guard limits: lower must be below upper, speeds and accelerations positive; all numbers")

    @cached_property
    def shape(self) -> CollisionShape:
        """Bodies that must not touch, and floors."""
        shape = collision_shape(self.arm)._replace(floors=self.floors)
        none = shape._replace(pairs=shape.pairs[:0], places=shape.places[:0], moving=shape.moving[:0])
        return shape if self.collisions else none

    @cached_property
    def near(self) -> Array:
        """(c,) [m] below which no command brings measured bodies nearer; heights above floors are not looked at."""
        usual = 0.5 * np.median(usual_distances(self.arm), axis=0) if self.collisions else np.zeros(0)
        return frozen(np.append(np.full(self.arm.joints, -np.inf), np.minimum(NEAR, usual)))

    @cached_property
    def rules(self) -> Rules:
        """The same numbers."""
        return Rules(*(getattr(self, name) for name in Rules._fields))

    @classmethod
    def of(cls, arm: Arm) -> GuardLimits:
        """Limits of an arm."""
        joint_floor = arm.floor + JOINT_CLEARANCE * length_size(arm)
        return cls(
            arm=arm,
            lower=arm.lower + MARGIN,
            upper=arm.upper - MARGIN,
            max_speed=arm.max_speed,
            max_acceleration=arm.max_speed / RAMP,
            floors=np.append(np.full(arm.joints - 1, joint_floor), arm.floor),
        )

    def of_simulation(self) -> GuardLimits:
        """Limits for training: no acceleration limit, no contacts."""
        return replace(self, max_acceleration=np.full(self.arm.joints, np.inf), collisions=False, parts=32)


def reason_names(reasons: int) -> tuple[str, ...]:
    """Names of the flags."""
    return tuple(reason.name.lower().replace("_", " ") for reason in Reason(int(reasons)) if reason.name)


class Guarded(NamedTuple):
    """Answer of the guard."""

    command: Array
    """(B, n) [rad]"""
    reasons: Reasons
    """(B,) `Reason` flags"""
    speed: Array
    """(B, n) [rad/s] for the next call"""


def guard(
    limits: GuardLimits,
    command: Array,
    sent: Array,
    speed: Array,
    state: JointState,
    period: float | Array,
    way: tuple[Array, Mask] | None = None,
) -> Guarded:
    """Limit a ``command`` (B, n) [rad] after ``sent`` (B, n) at ``speed`` (B, n) [rad/s].

    ``period`` [s], a number or (B,): time since ``sent``. The result is finite, within a step of ``sent``, and inside
    the limits if ``sent`` is. ``way``: goals (B, n) [rad] on a clear way, and where (B,) they move; in a contact, only
    the clear part of the command's difference from them remains.
    """
    count, joints = command.shape
    asked = np.stack([command, sent, speed, state.position], axis=1)
    times, out = np.empty((2, count)), np.empty((2, count, joints))
    times[0], times[1] = state.age, period
    reasons, about = servo_trips(state), (chain_of(limits.arm), limits.shape, limits.rules)
    compiled.guard(*about, asked, times, reasons, out)
    touched = reasons & np.uint16(Reason.COLLISION.value)
    if way is not None and (cut := way[1] & (touched != 0)).any():
        clear, nearer = clear_by(limits, command), command.copy()
        for b in np.flatnonzero(cut):
            compiled.shorten(*about, way[0][b], clear[b], nearer[b])
        again = guard(limits, nearer, sent, speed, state, period)
        return again._replace(reasons=again.reasons | touched)
    return Guarded(out[0], reasons, out[1])


def warm_up(limits: GuardLimits) -> None:
    """Compile the loops of guard, joint monitor and kinematics."""
    rest = limits.arm.rest[None]
    state = JointState(time=np.zeros(1), position=rest, age=np.zeros(1))
    guard(limits, rest, rest, 0.0 * rest, state, 0.0)
    kinematics.compile_all()


def servo_trips(state: JointState) -> Reasons:
    """Flag hot and faulty servos, (B,)."""
    trips = np.zeros(len(state.position), dtype=np.uint16)
    if state.temperature is not None:
        trips[(state.temperature > MAX_TEMPERATURE).any(axis=-1)] |= Reason.TEMPERATURE.value
    if state.fault is not None:
        trips[state.fault.any(axis=-1)] |= Reason.SERVO_FAULT.value
    return trips


def clear_by(limits: GuardLimits, q: Array) -> Array:
    """Clearances (..., n or more) [m] at ``q`` (..., n) [rad].

    Heights of the joint frames but the first, and TCP, above floors; then distances between bodies.
    """
    return clearances_of(limits.arm, limits.shape, q)
