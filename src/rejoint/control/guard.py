"""The guard between every controller and the robot: what may be sent, and why it was changed.

A pure function over a batch of arms. Two kinds of reasons:

* Limits (POSITION, LEAD, STEP, FLOOR) change the command and the motion goes on.
* Trips (see `TRIPS`) mean that the arm cannot be judged any more. The guard returns the last
  command, and the control loop stops the robot.

The limits are applied in the order lead, position, step, floor, so that in a conflict the later one
wins: whatever comes in, no command is further from the last one than the step limit, and none
brings the arm nearer to the floor than is allowed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, heights
from rejoint.arms.size import length_size
from rejoint.control.following import Following, Knowledge
from rejoint.control.law import plain
from rejoint.control.robot import JointState, Mask
from rejoint.errors import InputError
from rejoint.late import Late

compiled = Late("rejoint.control.compiled")

Reasons = NDArray[np.uint16]

JOINT_CLEARANCE = 0.01
"""[m] height of joint frames above the floor of the TCP, for a myCobot 280 (chosen: the radius of a link and a little
more, less the floor of 20 mm); goes with the reach."""

_SHARES = np.arange(1, 33) / 32  # of a step that are tried, all at once (chosen: 0.2 deg of the largest step)
_HEIGHT_TOLERANCE = 1e-9  # [m] rounding of the kinematics: a joint that cannot move must not look sinking


class Reason(IntFlag):
    """Why a command was changed, or why the guard tripped."""

    NONE = 0
    POSITION = 1
    """beyond a joint limit"""
    STEP = 2
    """further from the last command than the joint's speed allows in one period"""
    LEAD = 4
    """further ahead of the measured position than allowed"""
    FLOOR = 8
    """a point of the arm would come too low"""
    NOT_FINITE = 16
    """a command or a measured position is not a finite number"""
    STALE = 32
    """the joint state is too old"""
    OUT_OF_RANGE = 64
    """a measured position lies far outside the joint limits"""
    TEMPERATURE = 128
    """a servo is too hot"""
    SERVO_FAULT = 256
    """a servo reports a fault"""
    NOT_FOLLOWING = 512
    """a joint's reading stands still and is not believed, see `rejoint.control.following`"""


TRIPS = (
    Reason.NOT_FINITE | Reason.STALE | Reason.OUT_OF_RANGE | Reason.TEMPERATURE | Reason.SERVO_FAULT
    | Reason.NOT_FOLLOWING
)  # fmt: skip
"""Reasons that end the motion."""
_TRIP_BITS = np.uint16(TRIPS.value)
_LIMIT_BITS = np.array([Reason.LEAD, Reason.POSITION, Reason.STEP, Reason.FLOOR], dtype=np.uint16)  # as applied


@dataclass(frozen=True, kw_only=True, eq=False)
class GuardLimits:
    """What the guard allows. `GuardLimits.of` fills it for an arm."""

    arm: Arm
    lower: Array
    """(n,) [rad] lowest command"""
    upper: Array
    """(n,) [rad] highest command"""
    max_speed: Array
    """(n,) [rad/s] times the period: largest change of the command in one cycle"""
    max_lead: float = np.radians(20.0)
    """[rad] between command and measured position (chosen: twice what the worn arm's sag needs)"""
    max_period: float = 0.1
    """[s] periods longer than this do not allow a larger step (chosen: twice the slowest regular period)"""
    tcp_floor: float = 0.0
    """[m] lowest height of the TCP"""
    joint_floor: float = 0.03
    """[m] lowest height of a joint frame: radius of a link and a little more, for a myCobot 280"""
    max_age: float = 0.5
    """[s] oldest joint state (chosen: ten periods of the slowest wire)"""
    max_temperature: float = 65.0
    """[deg C] hottest servo (chosen: 5 below the 70 at which servos of this class switch themselves off)"""
    range_margin: float = np.radians(10.0)
    """[rad] a measured position further than this outside the arm's limits is not believed (chosen)"""
    servos: Knowledge | None = None
    """what is known of the servos beforehand; it makes the monitor of joints that do not follow quicker"""

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "max_speed"):
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != (self.arm.joints,) or not np.isfinite(array).all():
                raise InputError(f"guard limits: {name} needs {self.arm.joints} finite numbers, got {array}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if (self.lower >= self.upper).any() or (self.max_speed <= 0).any():
            raise InputError("guard limits: lower must be below upper and speeds must be positive")
        for name in ("max_lead", "max_period", "max_age"):
            if not getattr(self, name) > 0:
                raise InputError(f"guard limits: {name} must be positive, got {getattr(self, name)}")

    @cached_property
    def floors(self) -> Array:
        """(n,) [m] lowest heights of all joint frames but the first, which stands still, and of the TCP."""
        return np.append(np.full(self.arm.joints - 1, self.joint_floor), self.tcp_floor)

    @cached_property
    def believed(self) -> tuple[Array, Array]:
        """(n,), (n,) [rad] lowest and highest measured positions that are believed."""
        return self.arm.lower - self.range_margin, self.arm.upper + self.range_margin

    @classmethod
    def of(cls, arm: Arm, *, margin: float = np.radians(0.5)) -> GuardLimits:
        """Limits of an arm; commands stay ``margin`` [rad] inside the joint limits (chosen).

        Joint frames keep farther from the ground than the TCP, by `JOINT_CLEARANCE`, since links have a
        thickness.
        """
        return cls(
            arm=arm, lower=arm.lower + margin, upper=arm.upper - margin, max_speed=arm.max_speed, tcp_floor=arm.floor,
            joint_floor=arm.floor + JOINT_CLEARANCE * length_size(arm),
        )  # fmt: skip


class Guarded(NamedTuple):
    """The guard's answer."""

    command: Array
    """(B, n) [rad] what is to be sent"""
    reasons: Reasons
    """(B,) `Reason` flags per arm; 0 where the wanted command passed unchanged"""

    @property
    def tripped(self) -> Mask:
        """(B,) arms whose motion must end."""
        return (self.reasons & _TRIP_BITS) != 0


def guard(limits: GuardLimits, command: Array, sent: Array, state: JointState, period: float | Array) -> Guarded:
    """Decide what is sent when ``command`` (B, n) [rad] is wanted and ``sent`` (B, n) was the last command.

    ``period`` is the time [s] since the last command, a number or (B,). The result is always finite,
    within one step of ``sent`` and, if ``sent`` is, inside the position limits; a ``sent`` outside is
    led back at the speed limit. An acceptable command passes unchanged. InputError where shapes differ.
    """
    _check_shapes(limits.arm.joints, command, sent, state, period)
    last, trips = _check(limits, command, sent, state)
    measured, wanted, hold = state.position, command, np.count_nonzero(trips) > 0
    if hold:
        measured, wanted = (np.where(trips[:, None] != 0, last, array) for array in (measured, wanted))
    elapsed = np.minimum(np.fmax(period, 0.0), limits.max_period)  # NaN counts as no time
    reach = (limits.max_speed * elapsed[..., None]).reshape(-1, limits.arm.joints)
    stages = np.empty((4, *command.shape))
    stages[0], stepped = wanted, stages[3]
    compiled.limit(stages, plain(measured), plain(last), reach, limits.max_lead, limits.lower, limits.upper)
    if hold:  # whatever the limits say of the posture
        stepped[trips != 0] = last[trips != 0]
    allowed, lifted = _keep_above_floor(limits, stepped, last)
    changed = allowed != wanted
    if not np.count_nonzero(changed):
        return Guarded(allowed, trips)
    limited = np.logical_or.reduce(stages[1:] != stages[:-1], axis=-1)
    reasons: Reasons = _LIMIT_BITS @ np.concatenate([limited, lifted[None]])
    return Guarded(allowed, trips + reasons * np.logical_or.reduce(changed, axis=-1))


def warm_up(limits: GuardLimits) -> None:
    """Have everything ready that a first step needs: compiled loops are compiled or read from disk when first used.

    A control cycle that waited for them would be long, and a long one allows a long step.
    """
    rest = limits.arm.rest[None]
    state = JointState(time=np.zeros(1), position=rest, age=np.zeros(1))
    guard(limits, rest, rest, state, 0.0)
    Following(limits.arm, state, rest).check(state, rest, np.ones(1, dtype=bool))


def reason_names(reasons: int) -> tuple[str, ...]:
    """Names of the flags in one element of `Guarded.reasons`, as shown to people."""
    return tuple(reason.name.lower().replace("_", " ") for reason in Reason(int(reasons)) if reason.name)


def _check_shapes(joints: int, command: Array, sent: Array, state: JointState, period: float | Array) -> None:
    """Raise InputError unless everything is of as many arms: loops over shorter arrays would mix them up."""
    shape = len(command), joints
    per_arm = np.shape(period) in ((), (1,), shape[:1]) and np.shape(state.age) == shape[:1]
    if not (per_arm and command.shape == sent.shape == state.position.shape == shape):
        raise InputError(
            f"guard: command {command.shape}, last command {sent.shape}, positions {state.position.shape}, ages "
            f"{np.shape(state.age)}, periods {np.shape(period)}; expected {shape} and {shape[:1]} each"
        )


def _check(limits: GuardLimits, command: Array, sent: Array, state: JointState) -> tuple[Array, Reasons]:
    """Return the posture to hold (B, n), always finite, and the trips (B,)."""
    lowest, highest = limits.believed
    if _nothing_wrong(limits, command, sent, state):
        return sent, np.zeros(len(sent), dtype=np.uint16)
    unknown = ~np.isfinite(state.position)
    not_finite = ~np.isfinite(command) | ~np.isfinite(sent) | unknown
    trips = (
        _flag(not_finite, Reason.NOT_FINITE)
        + _flag(~(state.age <= limits.max_age)[:, None], Reason.STALE)  # NaN counts as stale
        + _flag(((state.position < lowest) | (state.position > highest)) & ~unknown, Reason.OUT_OF_RANGE)
    )
    if state.temperature is not None:
        trips = trips + _flag(state.temperature > limits.max_temperature, Reason.TEMPERATURE)
    if state.fault is not None:
        trips = trips + _flag(state.fault, Reason.SERVO_FAULT)
    if not not_finite.any():
        return sent, trips
    known = np.where(unknown, limits.arm.rest, np.clip(state.position, limits.lower, limits.upper))
    return np.where(np.isfinite(sent), sent, known), trips


def _nothing_wrong(limits: GuardLimits, command: Array, sent: Array, state: JointState) -> bool:
    """Tell that nothing trips in the whole batch; almost always so, and cheaper to ask than what does."""
    if state.temperature is not None or state.fault is not None:
        return False
    numbers, age = (plain(command), plain(sent), plain(state.position)), plain(state.age)
    return bool(compiled.credible(*numbers, *limits.believed, age, limits.max_age))


def _flag(per_joint: NDArray[np.bool_], reason: Reason) -> Reasons:
    """``reason`` (B,) where it holds for any joint of an arm."""
    flagged: Reasons = np.asarray(per_joint.any(axis=-1)) * np.uint16(reason.value)
    return flagged


def _keep_above_floor(limits: GuardLimits, command: Array, sent: Array) -> tuple[Array, Mask]:
    """Scale steps back that bring a point of the arm below its floor; returns the arms it changed.

    A point that is already too low may not sink further, so every motion that lifts it is free.
    """
    below = _clearances(limits, command) < 0.0
    if not np.count_nonzero(below):
        return command, np.zeros(len(command), dtype=bool)
    low: Mask = np.logical_or.reduce(below, axis=-1)
    index = np.flatnonzero(low)
    start, way = sent[index], command[index] - sent[index]
    lowest = np.minimum(_clearances(limits, start), 0.0) - _HEIGHT_TOLERANCE
    postures = start[:, None] + _SHARES[:, None] * way[:, None]
    good = np.all(_clearances(limits, postures) >= lowest[:, None], axis=-1)
    steps = np.logical_and.accumulate(good, axis=-1).sum(axis=-1)  # up to the first that is too low
    result, changed = command.copy(), low.copy()
    whole = steps == len(_SHARES)
    result[index] = np.where(whole[:, None], command[index], start + (steps / len(_SHARES))[:, None] * way)
    changed[index] = ~whole
    return result, changed


def _clearances(limits: GuardLimits, q: Array) -> Array:
    """Height (..., n) [m] above their floors of all joint frames but the first, and of the TCP."""
    return heights(limits.arm, q)[..., 1:] - limits.floors
