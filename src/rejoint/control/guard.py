"""The guard between every controller and the robot: what may be sent, and why it was changed.

A pure function over a batch of arms; what it remembers from call to call is the last command and its speed. Two kinds
of reasons:

* Limits change the command and the motion goes on, for as long as the controller asks for what it may not have.
* Trips (see `TRIPS`) mean that the arm cannot be judged any more. The guard returns the last
  command, and the control loop stops the robot at the first one.

The limits are applied in the order lead, position, step, acceleration, and then floor and contacts together, so that
in a conflict the later one wins. Lead and position pull a command to where it belongs. All later ones only shorten the
step from the last command, which is within each of them: whatever comes in, a hold is always left to go out, and no two
of them are ever in conflict. So the acceleration limit holds back what gains speed or turns round; braking is free,
since the hardest braking is the hold. With periods of `RAMP` and more this is a limit of every change of speed.

What is judged is the commanded posture. Where the arm really is, lagging and sagging behind its commands or swinging
beyond them, is not, and neither is its way from one command to the next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array, clearances, heights
from rejoint.control.law import plain
from rejoint.control.limits import RAMP, TRIPS, GuardLimits, Reason, Reasons, reason_names
from rejoint.control.robot import JointState, Mask
from rejoint.system.errors import InputError
from rejoint.system.late import Late

__all__ = [
    "RAMP",
    "TRIPS",
    "GuardLimits",
    "Guarded",
    "Reason",
    "Reasons",
    "clear_by",
    "guard",
    "reason_names",
    "warm_up",
]

compiled = Late("rejoint.control.compiled")

_TOLERANCE = 1e-9  # [m] rounding of the kinematics: a joint that cannot move must not look sinking
_TRIP_BITS = np.uint16(TRIPS.value)
_LIMIT_BITS = np.array(  # as applied
    [Reason.LEAD, Reason.POSITION, Reason.STEP, Reason.ACCELERATION, Reason.FLOOR, Reason.COLLISION], dtype=np.uint16
)


class Guarded(NamedTuple):
    """The guard's answer."""

    command: Array
    """(B, n) [rad] what is to be sent"""
    reasons: Reasons
    """(B,) `Reason` flags per arm; 0 where the wanted command passed unchanged"""
    speed: Array
    """(B, n) [rad/s] of the command, for the next call"""

    @property
    def tripped(self) -> Mask:
        """(B,) arms whose motion must end."""
        return (self.reasons & _TRIP_BITS) != 0


def guard(
    limits: GuardLimits, command: Array, sent: Array, speed: Array, state: JointState, period: float | Array
) -> Guarded:
    """Decide what is sent when ``command`` (B, n) [rad] is wanted and ``sent`` (B, n) was the last command.

    ``speed`` (B, n) [rad/s] is that of the last command, as the last call told it; 0 for an arm at rest. ``period`` is
    the time [s] since the last command, a number or (B,). The result is always finite, within one step of ``sent`` and,
    if ``sent`` is, inside the position limits; a ``sent`` outside is led back at the speed limit. An acceptable command
    passes unchanged. InputError where shapes differ.
    """
    _check_shapes(limits.arm.joints, command, sent, speed, state, period)
    last, trips = _check(limits, command, sent, speed, state)
    measured, wanted, hold = state.position, command, np.count_nonzero(trips) > 0
    if hold:
        measured, wanted = (np.where(trips[:, None] != 0, last, array) for array in (measured, wanted))
    elapsed = np.minimum(np.fmax(period, 0.0), limits.max_period).reshape(-1)  # NaN counts as no time
    stages = np.empty((5, *command.shape))
    stages[0], stepped = wanted, stages[4]
    last = plain(last)
    compiled.limit(
        stages, plain(measured), last, plain(speed), elapsed, limits.max_speed, limits.max_acceleration,
        limits.lower, limits.upper, limits.max_lead,
    )  # fmt: skip
    if hold:  # whatever the limits say of the posture
        stepped[trips != 0] = last[trips != 0]
    allowed, shortened = _keep_clear(limits, stepped, last)
    now = np.empty_like(allowed)
    compiled.take_speed(now, allowed, last, elapsed, limits.max_speed)
    changed = allowed != wanted
    if not np.count_nonzero(changed):
        return Guarded(allowed, trips, now)
    limited = np.logical_or.reduce(stages[1:] != stages[:-1], axis=-1)
    reasons: Reasons = _LIMIT_BITS @ np.concatenate([limited, shortened])
    return Guarded(allowed, trips + reasons * np.logical_or.reduce(changed, axis=-1), now)


def warm_up(limits: GuardLimits) -> None:
    """Guard a command once that is not sent: compiled loops are compiled or read from disk when first used."""
    rest = limits.arm.rest[None]
    state = JointState(time=np.zeros(1), position=rest, age=np.zeros(1))
    guard(limits, rest, rest, 0.0 * rest, state, 0.0)


def _check_shapes(
    joints: int, command: Array, sent: Array, speed: Array, state: JointState, period: float | Array
) -> None:
    """Raise InputError unless everything is of as many arms: loops over shorter arrays would mix them up."""
    shape = len(command), joints
    per_arm = np.shape(period) in ((), (1,), shape[:1]) and np.shape(state.age) == shape[:1]
    if not (per_arm and command.shape == sent.shape == speed.shape == state.position.shape == shape):
        raise InputError(
            f"guard: command {command.shape}, last command {sent.shape}, its speed {speed.shape}, positions "
            f"{state.position.shape}, ages {np.shape(state.age)}, periods {np.shape(period)}; expected {shape} and "
            f"{shape[:1]} each"
        )


def _check(limits: GuardLimits, command: Array, sent: Array, speed: Array, state: JointState) -> tuple[Array, Reasons]:
    """Return the posture to hold (B, n), always finite, and the trips (B,)."""
    lowest, highest = limits.believed
    if _nothing_wrong(limits, command, sent, speed, state):
        return sent, np.zeros(len(sent), dtype=np.uint16)
    unknown = ~np.isfinite(state.position)
    not_finite = ~np.isfinite(command) | ~np.isfinite(sent) | ~np.isfinite(speed) | unknown
    trips = (
        _flag(not_finite, Reason.NOT_FINITE)
        + _flag(~(state.age <= limits.max_age)[:, None], Reason.STALE)  # NaN counts as stale
        + _flag(((state.position < lowest) | (state.position > highest)) & ~unknown, Reason.OUT_OF_RANGE)
    )
    trips = trips + _servo_trips(limits, state)
    if not not_finite.any():
        return sent, trips
    known = np.where(unknown, limits.arm.rest, np.clip(state.position, limits.lower, limits.upper))
    return np.where(np.isfinite(sent), sent, known), trips


def suffers(limits: GuardLimits, state: JointState) -> NDArray[np.bool_]:
    """Arms (B,) that trip for what their servos tell, whatever is to be sent: too hot, or a fault."""
    return _servo_trips(limits, state) != 0


def _servo_trips(limits: GuardLimits, state: JointState) -> Reasons:
    """Return the trips (B,) for what servos tell of themselves."""
    trips = np.zeros(len(state.position), dtype=np.uint16)
    if state.temperature is not None:
        trips = trips + _flag(state.temperature > limits.max_temperature, Reason.TEMPERATURE)
    if state.fault is not None:
        trips = trips + _flag(state.fault, Reason.SERVO_FAULT)
    return trips


def _nothing_wrong(limits: GuardLimits, command: Array, sent: Array, speed: Array, state: JointState) -> bool:
    """Tell that nothing trips in the whole batch; almost always so, and cheaper to ask than what does."""
    if state.temperature is not None or state.fault is not None:
        return False
    numbers = (plain(command), plain(sent), plain(speed), plain(state.position))
    return bool(compiled.credible(*numbers, *limits.believed, plain(state.age), limits.max_age))


def _flag(per_joint: NDArray[np.bool_], reason: Reason) -> Reasons:
    """``reason`` (B,) where it holds for any joint of an arm."""
    flagged: Reasons = np.asarray(per_joint.any(axis=-1)) * np.uint16(reason.value)
    return flagged


def _keep_clear(limits: GuardLimits, command: Array, sent: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Scale steps back that bring a point of the arm below its floor, or a link into contact.

    Returns the commands, and the arms (2, B) changed for the floor and for contacts. What is already too low, or in
    contact, may not go further, so every motion that lifts or frees it is free.
    """
    shortened = np.zeros((2, len(command)), dtype=bool)
    clear = clear_by(limits, command)
    if not np.count_nonzero(clear < 0.0):
        return command, shortened
    index = np.flatnonzero(np.logical_or.reduce(clear < 0.0, axis=-1))
    start, way = sent[index], command[index] - sent[index]
    on_way = clear_by(limits, start[:, None] + limits.shares * way[:, None])
    on_way[:, -1] = clear[index]  # of the command itself, without rounding
    nearer, why = command[index], np.zeros((2, len(index)), dtype=bool)
    compiled.shorten(nearer, why, start, way, plain(on_way), _TOLERANCE)
    result = command.copy()
    result[index], shortened[:, index] = nearer, why
    return result, shortened


def clear_by(limits: GuardLimits, q: Array) -> Array:
    """Return what the guard keeps from falling below zero at ``q`` (..., n) [rad]: (..., n or more) [m].

    These are the heights above their floors of all joint frames but the first, and of the TCP; then the distances
    between what can touch.
    """
    if limits.collisions:
        return clearances(limits.arm, q, limits.floors)
    return heights(limits.arm, q)[..., 1:] - limits.floors
