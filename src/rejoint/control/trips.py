"""What a trip of the guard says: which arm, when, what was seen, and what to do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.control.limits import GuardLimits, Reason, reason_names
from rejoint.control.runstate import RunState
from rejoint.system.errors import GuardTripError


def trip_error(b: int, run_state: RunState, limits: GuardLimits) -> GuardTripError:
    """Return the error of the arm ``b`` that tripped."""
    state, flags = run_state.state, Reason(int(run_state.tripped[b]))
    names = limits.arm.joint_names
    details = []
    if Reason.STALE in flags:
        details.append(
            f"the joint state is {state.age[b]:.2f} s old, limit {limits.max_age:.2f} s; check the connection"
        )
    if Reason.TEMPERATURE in flags and state.temperature is not None:
        details.append(say_hot(names, state.temperature[b], limits.max_temperature))
    if Reason.SERVO_FAULT in flags and state.fault is not None:
        details.append(say_faulty(names, state.fault[b], state.trouble))
    if Reason.OUT_OF_RANGE in flags:
        degrees = np.round(np.degrees(state.position[b]), 1).tolist()
        details.append(f"measured {degrees} deg lies far outside the joint limits; check the arm's zero")
    if Reason.NOT_FOLLOWING in flags and run_state.unbelieved is not None:
        details.append(run_state.following.describe(b, run_state.unbelieved[b]))
    if Reason.NOT_FINITE in flags:
        details.append("a command or a measured position is not a number; check the controller and the connection")
    where = (
        f"arm {b} at {run_state.state.time[b] - run_state.set_at[b]:.2f} s into target {int(run_state.index[b]) + 1}"
    )
    return GuardTripError(", ".join(reason_names(int(flags))), f"{where}: {'; '.join(details)}")


def say_hot(names: tuple[str, ...], temperature: Array, limit: float) -> str:
    """Name the hottest of the joints at ``temperature`` (n,) [deg C], of which one is above the ``limit``."""
    hot = int(np.argmax(temperature))
    return f"{names[hot]} is at {temperature[hot]:.0f} deg C, limit {limit:.0f}; let it cool"


_FREE = "free the arm and clear the fault"


def say_faulty(names: tuple[str, ...], fault: NDArray[np.bool_], trouble: tuple[str, ...] | None = None) -> str:
    """Name the joints whose servos report a ``fault`` (n,), and what they complain of where they tell."""
    faulty = ", ".join(np.array(names)[fault])
    found = list(dict.fromkeys(filter(None, trouble or ())))
    starved = bool(found) and all(one == "voltage" or one.startswith("the supply sags") for one in found)
    advice = "look at its supply, which may be too weak, and at the cables" if starved else _FREE
    verb = "reports" if np.count_nonzero(fault) == 1 else "report"
    words = f" ({'; '.join(found)})" if found else ""
    return f"{faulty} {verb} a servo fault{words}; {advice}"
