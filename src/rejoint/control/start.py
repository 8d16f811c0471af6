"""Start of every drive: a look, then slow motion.

Constants without a source are chosen.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, Mask, gravity_torque
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.guard import MAX_LEAD, MAX_TEMPERATURE, GuardLimits, Reason
from rejoint.control.loop import Schedule, in_force, run, say_faulty, say_hot
from rejoint.control.recording import Cycle, OnCycle, Recording
from rejoint.control.reference import JointMotion
from rejoint.control.robot import ControlInput, JointState, Robot
from rejoint.system.errors import NotReadyError
from rejoint.system.records import entity
from rejoint.system.stopping import pause

BEYOND = np.radians(3.0)
"""[rad] beyond a limit"""
WARMTH = 5.0
"""[deg C] below the guard's trip"""
COLDEST, HOTTEST = -20.0, 120.0
"""[deg C] trusted"""
LOOK = 0.3
"""[s]"""
STILL = np.radians(5.0)
"""[rad] motion during the look"""
STANCE = np.radians(15.0)
"""[rad] from the twin's rest posture"""
FARTHER = np.radians(5.0)
"""[rad] more than in the diagnosis"""
FALL = MAX_LEAD + np.radians(5.0)
"""[rad] of falling off the first motion"""
ASTRAY = np.radians(8.0)
"""[rad] of leaving it without or against weight"""
STRIKES = 2
"""Readings in a row"""
LIGHT = 1e-3
"""[N m] without weight"""

WARM = 50.0
"""[deg C] of a servo that should cool down before a motion (chosen: 15 below the guard's trip)"""
SAG = 0.85
"""Share of the usual supply below which a voltage is low (chosen)"""
SUPPLIES = (5.0, 7.4, 12.0)
"""[V] of servos (manuals of the STS3215 and the X series)"""
POWER = "check power supply and cables"


@entity
class Stance:
    """Expected rest posture by a twin."""

    stiffness: Array
    """(n,) [N m/rad]"""
    offset: Array
    """(n,) [rad] unloaded joint minus command"""
    compensation: Array | float = 0.0
    """(n,) share of gravity that the controller feeds forward"""
    off: Array | float = 0.0
    """(n,) [rad] distance in the diagnosis"""

    def away(self, arm: Arm, position: Array, command: Array) -> Array:
        """Distances (..., n) [rad] of ``position`` (..., n) under ``command``."""
        sag = (1.0 - self.compensation) * gravity_torque(arm, position) / self.stiffness
        return np.abs(position - (command + self.offset - sag))

    def check(self, arm: Arm, state: JointState, command: Array) -> None:
        """Raise NotReadyError unless ``state`` matches under ``command`` (B, n) [rad]."""
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
    """Look, move slowly to rest, and compare with ``stance`` or rest; NotReadyError if unsafe."""
    check_ready(robot)
    motion = move(robot, robot.arm.rest, limits=limits, on_cycle=_first_way(robot, on_cycle))
    state = robot.read()
    away = np.abs(state.position - robot.arm.rest).max(axis=0)
    if stance is not None:
        stance.check(robot.arm, state, motion.command[-1])
    elif away.max() > MAX_LEAD:  # commands go no farther
        name, degrees = robot.arm.joint_names[away.argmax()], np.degrees(away.max())
        raise NotReadyError(
            f"{robot.address}: {name} is {degrees:.0f} deg from the rest posture, where it was sent: without torque, "
            "too weak or slow for its load, or blocked. Support the arm, switch it off, and look at this joint"
        )
    return motion


def _first_way(robot: Robot, on_cycle: OnCycle | None) -> OnCycle:
    """Return what raises NotReadyError when a joint leaves its first motion: reversed or exchanged joints."""
    arm, strikes = robot.arm, 0
    low = high = robot.read().position  # [rad] so far

    def see(cycle: Cycle) -> None:
        nonlocal low, high, strikes
        if on_cycle is not None:
            on_cycle(cycle)
        gap = ((cycle.reasons & Reason.GAP) != 0)[:, None]  # others may have moved it
        low, high = np.where(gap, cycle.position, (low, high))
        weight = gravity_torque(arm, cycle.position)
        below, above = (np.where(pull > LIGHT, FALL, ASTRAY) for pull in (weight, -weight))
        beyond = np.maximum(low - cycle.position - below, cycle.position - high - above)
        astray = np.where(cycle.active[:, None], beyond, -np.inf)
        strikes = strikes + 1 if astray.max() > 0.0 else 0
        if strikes >= STRIKES:
            b, j = np.unravel_index(np.argmax(astray), astray.shape)
            least, found, most = np.degrees([low[b, j], cycle.position[b, j], high[b, j]])
            raise NotReadyError(
                f"{robot.address}: {arm.joint_names[j]} was sent no farther than {least:.0f} to {most:.0f} deg, and "
                f"reads {found:.0f} deg: it turns the other way than it reads, its reading is another joint's, it is "
                "pushed, or it cannot carry its load. Compare directions and cables with the arm's description"
            )
        low, high = np.minimum(low, cycle.command), np.maximum(high, cycle.command)

    return see


def check_ready(robot: Robot) -> None:
    """Raise NotReadyError unless the arms are still, inside limits, cool and healthy."""
    first = robot.read()
    state = robot.read()
    if (state.time > first.time).any():  # virtual time stands still
        pause(LOOK)
        state = robot.read()
    problem = _problem(robot.arm, first, state)
    if problem:
        raise NotReadyError(f"{robot.address}: {problem}; nothing was moved")


def _beyond(arm: Arm, state: JointState) -> Mask:
    """Joints (B, n) more than `BEYOND` outside their limits."""
    return (state.position < arm.lower - BEYOND) | (state.position > arm.upper + BEYOND)


def _problem(arm: Arm, first: JointState, state: JointState) -> str:
    away = np.abs(state.position - first.position).max(axis=0)
    if away.max() > STILL:
        name = arm.joint_names[away.argmax()]
        return f"{name} is moving by itself; wait until the arm rests, and end what else drives it"
    beyond = np.argwhere(_beyond(arm, state))
    if len(beyond):
        b, j = beyond[0]
        low, angle, high = np.degrees([arm.lower[j], state.position[b, j], arm.upper[j]])
        return (
            f"{arm.joint_names[j]} stands at {angle:.1f} deg, outside its limits of {low:.0f} to {high:.0f} deg; bring "
            "it inside by hand, or correct the arm's zero"
        )
    if state.fault is not None and state.fault.any():
        return say_faulty(arm.joint_names, np.asarray(state.fault.any(axis=0)), state.trouble)
    if state.temperature is None:
        return ""
    if not ((state.temperature > COLDEST) & (state.temperature < HOTTEST)).all():
        return f"temperatures of {np.round(state.temperature).tolist()} deg C are not believed; check the servo bus"
    hottest, limit = state.temperature.max(axis=0), MAX_TEMPERATURE - WARMTH
    return say_hot(arm.joint_names, hottest, limit) if (hottest > limit).any() else ""


class Symptom(NamedTuple):
    """What was found."""

    found: str
    fix: str = ""
    """what to do; empty: nothing"""


def look_at_servos(arm: Arm, state: JointState) -> Iterator[Symptom]:
    """Compare positions, temperatures, supply and status with what they should be."""
    yield Symptom(f"all {arm.joints} servos answer")
    names = np.array(arm.joint_names)
    beyond = names[_beyond(arm, state)[0]].tolist()
    fix = "move it back by hand, with power off and the arm supported" if beyond else ""
    yield Symptom(f"beyond its limit: {', '.join(beyond) or 'no joint'}", fix)
    readings = state.temperature, state.voltage
    heat, volts = (np.full(arm.joints, np.nan) if one is None else one[0] for one in readings)
    kinds = np.array(arm.servos or ("",) * arm.joints)
    most = [np.nanmax(volts[kinds == kind], initial=0.0) for kind in kinds]  # each kind has a supply of its own
    usual = np.array([min((one for one in SUPPLIES if one * (2.0 - SAG) >= high), default=high) for high in most])
    for what, unit, values, bad, fix in (
        ("temperature", "deg C", heat, heat > WARM, "switch the arm off and let it cool down"),
        ("supply", "V", volts, volts < SAG * usual, POWER),
    ):
        worst = [f"{names[j]} {values[j]:.1f} {unit}" for j in np.flatnonzero(bad)]
        known = values[np.isfinite(values)]
        span = f"{known.min():.1f} to {known.max():.1f} {unit}" if len(known) else "not told"
        yield Symptom(f"{what}: {', '.join(worst) or span}", fix * bool(worst))
    words = [(name, word) for name, word in zip(names, state.trouble or (), strict=False) if word]
    for name, word in words:
        power = "voltage" in word or "supply" in word
        yield Symptom(f"{name} reports: {word}", POWER if power else "let it rest, and look at the joint")
    if not words and state.fault is not None and state.fault.any():
        yield Symptom("a servo reports a fault", "switch the arm off and on")


def play(
    robot: Robot,
    trajectory: Callable[[Array], Array],
    duration: float,
    *,
    sent: Array | None = None,
    limits: GuardLimits | None = None,
    give_up: Callable[[ControlInput], bool] | None = None,
    on_cycle: OnCycle | None = None,
) -> Recording:
    """Send ``trajectory(time)``, (B,) [s] to (B, n) [rad], for ``duration`` [s], guarded; ``sent`` as in `Schedule`."""
    reference, schedule = JointMotion(trajectory), Schedule(dwell=duration, sent=sent, give_up=give_up)
    return run(robot, Playback(robot.arm), reference, schedule, limits=limits, on_cycle=on_cycle)


def move(
    robot: Robot,
    posture: Array,
    *,
    sent: Array | None = None,
    speed: float = 0.5,
    settle: float = 1.0,
    **how: Any,  # noqa: ANN401 - as of `play`
) -> Recording:
    """Move to ``posture`` (n,) [rad] at ``speed`` [rad/s] and wait ``settle`` [s]; ``how``: options of `play`.

    From ``sent`` (B, n) [rad], or the measured position of moved arms.
    """
    state = robot.read()
    start = in_force(state, sent)
    way = posture - start
    duration = max(np.abs(way).max() / speed, 1e-3)

    def trajectory(time: Array) -> Array:
        return start + np.minimum(time / duration, 1.0)[:, None] * way

    return play(robot, trajectory, duration + settle, sent=start, **how)


class Playback(DefaultController):
    """Sends the goals of a joint motion."""

    name = "playback"
