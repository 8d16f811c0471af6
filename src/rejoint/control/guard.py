"""The guard between controller and robot.

Limits change a command; trips (`TRIPS`) return the last one, and the loop stops the robot. Limits apply in the order
lead, position, step, acceleration, floor, contacts; the later one wins. All but the first two only shorten the step, so
a hold is always allowed. The guard judges the commanded posture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntFlag
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, clearances, heights
from rejoint.arms.collision import JOINT_CLEARANCE
from rejoint.arms.workspace import length_size
from rejoint.control.controllers.law import between, limit_lead
from rejoint.control.monitor import Bands, Following, Knowledge
from rejoint.control.robot import JointState, Mask
from rejoint.system.errors import InputError

Reasons = NDArray[np.uint16]

RAMP = 0.018
"""[s] to full speed (chosen: the shortest trained period)"""


class Reason(IntFlag):
    """Why the guard changed a command or tripped."""

    NONE = 0
    POSITION = 1
    STEP = 2
    """too fast"""
    LEAD = 4
    """too far from the measured position"""
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


@dataclass(frozen=True, kw_only=True, eq=False)
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
    collisions: bool = True
    """prevent contacts"""
    parts: int = 16
    """tried parts of a step (chosen)"""
    max_lead: float = np.radians(20.0)
    """[rad] largest following error (chosen: twice a worn arm's sag)"""
    max_period: float = 0.1
    """[s] (chosen)"""
    tcp_floor: float = 0.0
    """[m]"""
    joint_floor: float = 0.03
    """[m] of joint frames, for a myCobot 280"""
    max_age: float = 0.5
    """[s] (chosen: ten periods of the slowest wire)"""
    max_temperature: float = 65.0
    """[deg C] (chosen: 5 below the usual 70)"""
    range_margin: float = np.radians(10.0)
    """[rad] of readings outside the limits (chosen)"""
    servos: Knowledge | None = None
    bands: Bands | None = None
    gains: Mapping[str, tuple[int, ...]] | None = None
    """of `servos` and `bands`; None: any"""

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "max_speed", "max_acceleration"):
            array = np.array(getattr(self, name), dtype=float)
            endless = name == "max_acceleration" and not np.isnan(array).any()
            if array.shape != (self.arm.joints,) or not (endless or np.isfinite(array).all()):
                raise InputError(f"guard limits: {name} needs {self.arm.joints} finite numbers, got {array}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if (self.lower >= self.upper).any() or (self.max_speed <= 0).any() or (self.max_acceleration <= 0).any():
            raise InputError("guard limits: lower must be below upper, speeds and accelerations must be positive")
        for name in ("parts", "max_lead", "max_period", "max_age"):
            if not getattr(self, name) > 0:
                raise InputError(f"guard limits: {name} must be positive, got {getattr(self, name)}")

    @cached_property
    def floors(self) -> Array:
        """(n,) [m] of joint frames but the first, and TCP."""
        return np.append(np.full(self.arm.joints - 1, self.joint_floor), self.tcp_floor)

    @cached_property
    def shares(self) -> Array:
        """(parts + 1, 1)."""
        return np.arange(self.parts + 1)[:, None] / self.parts

    @cached_property
    def believed(self) -> tuple[Array, Array]:
        """(n,), (n,) [rad] lowest and highest trusted positions."""
        return self.arm.lower - self.range_margin, self.arm.upper + self.range_margin

    @classmethod
    def of(cls, arm: Arm, *, margin: float = np.radians(0.5)) -> GuardLimits:
        """Limits of an arm, ``margin`` [rad] inside the joint limits (chosen)."""
        return cls(
            arm=arm,
            lower=arm.lower + margin,
            upper=arm.upper - margin,
            max_speed=arm.max_speed,
            max_acceleration=arm.max_speed / RAMP,
            tcp_floor=arm.floor,
            joint_floor=arm.floor + JOINT_CLEARANCE * length_size(arm),
        )

    def of_simulation(self) -> GuardLimits:
        """Limits for training: no acceleration limit, no contacts."""
        return replace(self, max_acceleration=np.full(self.arm.joints, np.inf), collisions=False, parts=32)


def reason_names(reasons: int) -> tuple[str, ...]:
    """Names of the flags."""
    return tuple(reason.name.lower().replace("_", " ") for reason in Reason(int(reasons)) if reason.name)


_TOLERANCE = 1e-9  # [m] rounding of the kinematics: a joint that cannot move must not look sinking
_TRIP_BITS = np.uint16(TRIPS.value)
_LIMIT_BITS = np.array(  # as applied
    [Reason.LEAD, Reason.POSITION, Reason.STEP, Reason.ACCELERATION, Reason.FLOOR, Reason.COLLISION], dtype=np.uint16
)


class Guarded(NamedTuple):
    """Answer of the guard."""

    command: Array
    """(B, n) [rad]"""
    reasons: Reasons
    """(B,) `Reason` flags"""
    speed: Array
    """(B, n) [rad/s] for the next call"""

    @property
    def tripped(self) -> Mask:
        """(B,)."""
        return (self.reasons & _TRIP_BITS) != 0


def guard(
    limits: GuardLimits, command: Array, sent: Array, speed: Array, state: JointState, period: float | Array
) -> Guarded:
    """Limit a ``command`` (B, n) [rad] after ``sent`` (B, n) at ``speed`` (B, n) [rad/s].

    ``period`` [s], a number or (B,): time since ``sent``. The result is finite, within a step of ``sent``, and inside
    the limits if ``sent`` is. InputError for different shapes.
    """
    _check_shapes(limits.arm.joints, command, sent, speed, state, period)
    last, trips = _check(limits, command, sent, speed, state)
    measured, wanted, hold = state.position, command, (trips != 0)[:, None]
    if np.count_nonzero(trips):
        measured, wanted, speed = (
            np.where(hold, held, array) for held, array in ((last, measured), (last, command), (0.0, speed))
        )
    elapsed = np.minimum(np.fmax(period, 0.0), limits.max_period).reshape(-1, 1)  # NaN counts as no time
    stages = _limited(limits, wanted, measured, last, speed, elapsed)
    stepped = np.where(hold, last, stages[-1])  # whatever the limits say of the posture
    allowed, shortened = _keep_clear(limits, stepped, last)
    now = np.divide(allowed - last, elapsed, out=np.zeros_like(allowed), where=elapsed > 0.0)
    now = between(now, -limits.max_speed, limits.max_speed)
    changed = np.logical_or.reduce(allowed != wanted, axis=-1)
    if not np.count_nonzero(changed):
        return Guarded(allowed, trips, now)
    limited = [np.logical_or.reduce(after != before, axis=-1) for before, after in pairwise((wanted, *stages))]
    reasons: Reasons = _LIMIT_BITS @ np.array([*limited, *shortened])
    return Guarded(allowed, trips + reasons * changed, now)


def _limited(
    limits: GuardLimits, wanted: Array, measured: Array, last: Array, speed: Array, elapsed: Array
) -> tuple[Array, ...]:
    """Commands (B, n) [rad] limited by lead, then also by position, step and acceleration; ``elapsed`` (1 or B, 1)."""
    near = limit_lead(wanted, measured, limits.max_lead)
    legal = between(near, limits.lower, limits.upper)
    reach, way = limits.max_speed * elapsed, speed * elapsed
    stepped = between(legal, last - reach, last + reach)
    some = np.where(elapsed > 0.0, elapsed, 1.0)  # an endless acceleration in no time is no number
    gain = np.where(elapsed > 0.0, limits.max_acceleration * some * some, 0.0)
    smooth = between(stepped, last + np.minimum(way - gain, 0.0), last + np.maximum(way + gain, 0.0))
    return near, legal, stepped, smooth


def guard_along(
    limits: GuardLimits,
    goal: Array,
    moving: NDArray[np.bool_],
    command: Array,
    sent: Array,
    speed: Array,
    state: JointState,
    period: float | Array,
) -> Guarded:
    """`guard` a ``command`` (B, n) [rad] whose ``goal`` (B, n) [rad] is ``moving`` (B,) along a clear way.

    Where the command would touch something, only the clear part of its difference from the goal remains.
    """
    guarded = guard(limits, command, sent, speed, state, period)
    touched = guarded.reasons & np.uint16(Reason.COLLISION.value)
    cut = moving & (touched != 0)
    if not cut.any():
        return guarded
    on_way = clear_by(limits, goal[:, None] + limits.shares * (command - goal)[:, None])
    clear = (on_way >= np.minimum(on_way[:, :1], 0.0)).all(axis=-1)
    last = np.logical_and.accumulate(clear, axis=1).sum(axis=1) - 1
    nearer = np.where(cut[:, None], goal + limits.shares[last] * (command - goal), command)
    again = guard(limits, nearer, sent, speed, state, period)
    return again._replace(reasons=again.reasons | touched)


def warm_up(limits: GuardLimits) -> None:
    """Compile the loops of guard and joint monitor."""
    rest = limits.arm.rest[None]
    state = JointState(time=np.zeros(1), position=rest, age=np.zeros(1))
    guard(limits, rest, rest, 0.0 * rest, state, 0.0)
    Following(limits.arm, state, rest)


def _check_shapes(
    joints: int, command: Array, sent: Array, speed: Array, state: JointState, period: float | Array
) -> None:
    shape = len(command), joints
    per_arm = np.shape(period) in ((), (1,), shape[:1]) and np.shape(state.age) == shape[:1]
    if not (per_arm and command.shape == sent.shape == speed.shape == state.position.shape == shape):
        raise InputError(
            f"guard: command {command.shape}, last command {sent.shape}, its speed {speed.shape}, positions "
            f"{state.position.shape}, ages {np.shape(state.age)}, periods {np.shape(period)}; expected {shape} and "
            f"{shape[:1]} each"
        )


def _check(limits: GuardLimits, command: Array, sent: Array, speed: Array, state: JointState) -> tuple[Array, Reasons]:
    """Posture to hold (B, n) and trips (B,)."""
    lowest, highest = limits.believed
    finite = np.isfinite((command, sent, speed, state.position))
    beyond = (state.position < lowest) | (state.position > highest)
    trips = (
        _flag(~np.logical_and.reduce(finite), Reason.NOT_FINITE)
        + _flag(~(state.age <= limits.max_age)[:, None], Reason.STALE)  # NaN counts as stale
        + _flag(beyond & finite[3], Reason.OUT_OF_RANGE)
        + _servo_trips(limits, state)
    )
    if not np.count_nonzero(trips):
        return sent, trips
    known = np.where(finite[3], np.clip(state.position, limits.lower, limits.upper), limits.arm.rest)
    return np.where(finite[1], sent, known), trips


def suffers(limits: GuardLimits, state: JointState) -> NDArray[np.bool_]:
    """Arms (B,) with a hot or faulty servo."""
    return _servo_trips(limits, state) != 0


def _servo_trips(limits: GuardLimits, state: JointState) -> Reasons:
    trips = np.zeros(len(state.position), dtype=np.uint16)
    if state.temperature is not None:
        trips = trips + _flag(state.temperature > limits.max_temperature, Reason.TEMPERATURE)
    if state.fault is not None:
        trips = trips + _flag(state.fault, Reason.SERVO_FAULT)
    return trips


def _flag(per_joint: NDArray[np.bool_], reason: Reason) -> Reasons:
    flagged: Reasons = np.logical_or.reduce(per_joint, axis=-1) * np.uint16(reason.value)
    return flagged


def _keep_clear(limits: GuardLimits, command: Array, sent: Array) -> tuple[Array, NDArray[np.bool_]]:
    shortened = np.zeros((2, len(command)), dtype=bool)
    clear = clear_by(limits, command)
    if not np.count_nonzero(clear < 0.0):
        return command, shortened
    index = np.flatnonzero(np.logical_or.reduce(clear < 0.0, axis=-1))
    start, way = sent[index], command[index] - sent[index]
    on_way = clear_by(limits, start[:, None] + limits.shares * way[:, None])
    on_way[:, -1] = clear[index]  # of the command itself, without rounding
    least = np.where(on_way[:, 0] < 0.0, on_way[:, 0] - _TOLERANCE, 0.0)  # none may become negative, or more so
    touches = on_way < least[:, None]
    worse = touches[:, -1].any(axis=-1)
    index, touches = index[worse], touches[worse]
    first = touches[:, 1:].any(axis=-1).argmax(axis=1)  # tried part before the first that touches
    result, met, n = command.copy(), touches[np.arange(len(index)), first + 1], command.shape[1]
    result[index] = start[worse] + limits.shares[first] * way[worse]
    shortened[:, index] = met[:, :n].any(axis=-1), met[:, n:].any(axis=-1)
    return result, shortened


def clear_by(limits: GuardLimits, q: Array) -> Array:
    """Clearances (..., n or more) [m] at ``q`` (..., n) [rad].

    Heights of the joint frames but the first, and TCP, above floors; then distances between bodies.
    """
    if limits.collisions:
        return clearances(limits.arm, q, limits.floors)
    return heights(limits.arm, q)[..., 1:] - limits.floors
