"""What the guard did, in words: which limit, which joint."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rejoint.arms import Array, clearances
from rejoint.arms.collision import collision_shape
from rejoint.control.limits import TRIPS, GuardLimits, Reason
from rejoint.control.trips import say_hot
from rejoint.pages.live.ring import Records

KEPT = 1.5
"""[s] for which a limit that was met is still told (chosen: time to read it)"""

_Say = Callable[[Records, GuardLimits], str]


def guard_words(records: Records, limits: GuardLimits) -> tuple[str, ...]:
    """Say what the guard did in the last `KEPT` seconds of ``records``, trips first; nothing where it did nothing."""
    recent = records.lately(KEPT)
    flags = recent.reasons.astype(np.int64)
    said = []
    for reason in sorted(Reason, key=lambda one: one not in TRIPS):
        met = np.flatnonzero(flags & reason.value)
        if reason.value and len(met):
            said.append(say(reason, Records(recent.rows[max(met[-1] - 2, 0) : met[-1] + 1], recent.joints), limits))
    return tuple(said)


def say(reason: Reason, records: Records, limits: GuardLimits) -> str:
    """Say what the newest of ``records`` met; the two before it tell how fast the command was."""
    return _WORDS[reason](records, limits)


def _position(records: Records, limits: GuardLimits) -> str:
    wanted = records.wanted[-1]
    j = int(np.argmax(np.maximum(wanted - limits.upper, limits.lower - wanted)))
    limit = limits.upper[j] if wanted[j] > limits.upper[j] else limits.lower[j]
    return (
        f"joint limit: {_name(limits, j)} was asked for {_deg(wanted[j]):.1f} deg and is kept at {_deg(limit):.1f} deg"
    )


def _lead(records: Records, limits: GuardLimits) -> str:
    lead = records.wanted[-1] - records.position[-1]
    j = int(np.argmax(np.abs(lead)))
    return (
        f"lead: {_name(limits, j)} was asked to be {_deg(abs(lead[j])):.1f} deg ahead of where it is, "
        f"{_deg(limits.max_lead):.0f} deg are allowed"
    )


def _step(records: Records, limits: GuardLimits) -> str:
    j = int(np.argmax(np.abs(records.wanted[-1] - records.command[-min(len(records), 2)]) / limits.max_speed))
    return f"speed: {_name(limits, j)} is held to {_deg(limits.max_speed[j]):.0f} deg/s"


def _acceleration(records: Records, limits: GuardLimits) -> str:
    command = records.command
    before = command[-min(len(records), 2)]
    change = records.wanted[-1] - before - (before - command[0])
    j = int(np.argmax(np.abs(change) / limits.max_acceleration))
    return f"acceleration: {_name(limits, j)} was asked to gain speed or turn round faster than allowed"


def _floor(records: Records, limits: GuardLimits) -> str:
    clear = _clear(records, limits)[: len(limits.floors)]
    low = int(np.argmin(clear))
    what = "the tool" if low == len(limits.floors) - 1 else _name(limits, low + 1)
    return f"floor: {what} was asked to go lower than {1e3 * limits.floors[low]:.0f} mm"


def _collision(records: Records, limits: GuardLimits) -> str:
    clear, shape = _clear(records, limits)[len(limits.floors) :], collision_shape(limits.arm)
    if not len(clear):
        return "contact: a link would touch another one or the ground"
    nearest = int(np.argmin(clear))
    if nearest < len(shape.pairs):
        one, two = shape.pairs[nearest]
        return f"contact: {_link(limits, int(one))} would touch {_link(limits, int(two))}"
    end = int(shape.places[nearest - len(shape.pairs)])
    what = "the tool" if end == limits.arm.joints + 1 else _name(limits, end - 1)
    return f"contact: {what} would touch the ground"


def _temperature(records: Records, limits: GuardLimits) -> str:
    return say_hot(limits.arm.joint_names, records.temperature[-1], limits.max_temperature)


def _out_of_range(records: Records, limits: GuardLimits) -> str:
    low, high = limits.believed
    position = records.position[-1]
    j = int(np.argmax(np.maximum(position - high, low - position)))
    return f"{_name(limits, j)} reads {_deg(position[j]):.1f} deg, far outside its limits; check the arm's zero"


def _not_finite(records: Records, limits: GuardLimits) -> str:
    bad = ~np.isfinite(records.wanted[-1]) | ~np.isfinite(records.position[-1])
    names = ", ".join(np.array(limits.arm.joint_names)[bad])
    return f"a command or a position of {names or 'a joint'} is not a number; check the controller and the connection"


def _clear(records: Records, limits: GuardLimits) -> Array:
    """Heights above floors, then distances of what can touch [m], where the controller wanted the arm."""
    return clearances(limits.arm, records.wanted[-1:], limits.floors)[0]


def _name(limits: GuardLimits, j: int) -> str:
    return limits.arm.joint_names[j]


def _link(limits: GuardLimits, link: int) -> str:
    return "the base" if link == 0 else f"the link after {_name(limits, link - 1)}"


def _deg(angle: float) -> float:
    return float(np.degrees(angle))


_WORDS: dict[Reason, _Say] = {
    Reason.POSITION: _position,
    Reason.STEP: _step,
    Reason.LEAD: _lead,
    Reason.FLOOR: _floor,
    Reason.ACCELERATION: _acceleration,
    Reason.COLLISION: _collision,
    Reason.GAP: lambda _, __: "no answers came for a while, or a joint was led back; the arm held and goes on slowly",
    Reason.NOT_FINITE: _not_finite,
    Reason.STALE: lambda _, limits: f"no new joint state for more than {limits.max_age:.1f} s; check the connection",
    Reason.OUT_OF_RANGE: _out_of_range,
    Reason.TEMPERATURE: _temperature,
    Reason.SERVO_FAULT: lambda _, __: "a servo reports a fault; free the arm and clear the fault",
    Reason.NOT_FOLLOWING: lambda _, __: "the reading of a joint stands still and is not believed",
}
