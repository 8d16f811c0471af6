"""Laws that whatever leaves the guard must keep, checked without it: plain NumPy and own distances.

Used by the tests, and by `python -m benchmarks guard` for millions of cases.
"""

from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Box, tcp_position
from rejoint.arms.collision import collision_shape
from rejoint.control.guard import MAX_LEAD, RAMP, TRIPS, Guarded, GuardLimits, Reason, guard
from rejoint.control.robot import JointState
from segments import link_ends, segments_apart

STEP_ROUNDING = 1e-12  # [rad]
HEIGHT_ROUNDING = 3e-9  # [m] what the guard tolerates where the arm is too low or in contact already, and rounding
GAP_ROUNDING = 2e-6  # [m] distances between segments are exact to a micrometre
SPECIAL = np.array([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-308, 0.0, -0.0])
PERIODS = np.array([0.0, -0.0, -1.0, np.nan, np.inf, -np.inf, 1e-300, 1e-17, 1e-9, 1e-4, 0.005, RAMP, 0.1, 3.0, 1e308])

_CLEARANCE = np.uint16(Reason.FLOOR | Reason.COLLISION)


class Case(NamedTuple):
    """What the guard is asked, for B arms."""

    command: np.ndarray
    sent: np.ndarray
    speed: np.ndarray
    state: JointState
    period: np.ndarray


def random_chain(rng: np.random.Generator) -> Arm:
    """An arm of 3 to 7 joints that nobody built, on its base or on a pedestal."""
    n = int(rng.integers(3, 8))
    offset = np.tile(np.eye(4), (n, 1, 1))
    offset[:, :3, :3] = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    offset[:, :3, :3] *= np.linalg.det(offset[:, :3, :3])[:, None, None]
    offset[0] = np.eye(4)
    offset[1:, :3, 3] = rng.normal(scale=0.12, size=(n - 1, 3))
    offset[0, 2, 3] = 0.2
    axis = rng.normal(size=(n, 3))
    tip = np.eye(4)
    tip[:3, 3] = rng.normal(scale=0.1, size=3)
    arm = Arm(
        name="chain",
        joint_names=tuple(f"j{i}" for i in range(n)),
        offset=offset,
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        tip=tip,
        lower=-rng.uniform(1.0, 3.0, n),
        upper=rng.uniform(1.0, 3.0, n),
        max_speed=rng.uniform(0.5, 6.0, n),
        mass=np.full(n, 0.2),
        com=np.zeros((n, 3)),
        inertia=np.tile(1e-4 * np.eye(3), (n, 1, 1)),
        rest=rng.uniform(-0.9, 0.9, n),
        targets=Box(lower=-np.ones(3), upper=np.ones(3)),
        floor=float(rng.choice([-0.4, -0.05, 0.0, 0.02])),
        encoder_step=1e-3,
    )
    tcp = tcp_position(arm, arm.rest)
    object.__setattr__(arm, "targets", Box(lower=tcp - 0.02, upper=tcp + 0.02))
    return arm


def draw_cases(limits: GuardLimits, rng: np.random.Generator, count: int, *, garbage: float) -> Case:
    """Draw ``count`` cases, wild and mild; about the share ``garbage`` of the arms has numbers in it that are none."""
    arm = limits.arm
    shape, low, high = (count, arm.joints), limits.lower, limits.upper
    far = rng.uniform(low, high, shape)
    near = np.clip(arm.rest + rng.normal(scale=0.4, size=shape), low, high)
    outside = rng.uniform(low - 0.3, high + 0.3, shape)
    sent = _choose(rng, [far, near, outside, np.clip(outside, low, high)])
    period = np.where(rng.random(count) < 0.7, rng.uniform(0.015, 0.06, count), rng.choice(PERIODS, count))
    reach = np.nan_to_num(np.clip(period, 0.0, 0.1))[:, None] * arm.max_speed
    speed = _choose(
        rng,
        [
            np.zeros(shape),
            arm.max_speed * rng.uniform(-1.0, 1.0, shape),
            arm.max_speed * rng.choice([-1.0, 0.0, 1.0], shape),
        ],
    )
    step = reach * rng.uniform(-1.0, 1.0, shape)
    command = _choose(
        rng,
        [
            sent + step,
            sent + 0.1 * step,
            sent + reach * np.sign(step),
            sent - speed * 0.02,
            sent + 0.3 * step,
            rng.uniform(low, high, shape),
            sent + rng.normal(size=shape) * 2.0,
            sent.copy(),
        ],
    )
    position = sent + rng.choice([0.0, 0.02, 0.2, 0.5], (count, 1)) * rng.normal(size=shape)
    age = np.where(
        rng.random(count) < 0.9, rng.uniform(0.0, 0.4, count), rng.choice([0.6, np.nan, np.inf, -1.0], count)
    )
    for array in (command, sent, speed, position):
        spoilt = (rng.random((count, 1)) < garbage / 4) & (rng.random(shape) < 0.4)
        array[spoilt] = rng.choice(SPECIAL, int(spoilt.sum()))
    temperature = np.where(rng.random(shape) < 0.01, rng.choice([66.0, np.nan, 1e9], shape), 50.0)
    fault = rng.random(shape) < 0.005
    told = rng.random() < 0.5
    state = JointState(
        time=np.zeros(count),
        position=position,
        age=age,
        temperature=temperature if told else None,
        fault=fault if told else None,
    )
    return Case(command, sent, speed, state, period)


def check(limits: GuardLimits, case: Case) -> Guarded:
    """Ask the guard and assert every law; returns its answer."""
    out = guard(limits, *case)
    tripped = expected_trips(limits, case)
    np.testing.assert_array_equal(out.reasons & np.uint16(TRIPS.value), tripped)
    ok = tripped == 0
    assert np.isfinite(out.command).all()
    assert np.isfinite(out.speed).all()
    _check_holds(limits, case, out, ~ok)
    good = Case(case.command[ok], case.sent[ok], case.speed[ok], _rows(case.state, ok), case.period[ok])
    sound = Guarded(out.command[ok], out.reasons[ok], out.speed[ok])
    bounds = _check_motion(limits, good, sound)
    least = check_clear(limits, good.sent, sound.command)
    changed = (sound.command != good.command).any(axis=-1)
    np.testing.assert_array_equal(sound.reasons != 0, changed, err_msg="a reason for every change, and no other")
    rounding = np.minimum(STEP_ROUNDING * (1.0 + np.abs(good.sent)), 1.0)
    fine = ((good.command >= bounds[0] + rounding) & (good.command <= bounds[1] - rounding)).all(axis=-1)
    at_home = (good.sent >= bounds[0]) & (good.sent <= bounds[1])
    fine |= ((good.command == good.sent) & at_home).all(axis=-1)  # a hold is always allowed
    free = (clearances(limits, np.where(fine[:, None], good.command, good.sent)) >= least + GAP_ROUNDING).all(axis=-1)
    away = (clearances(limits, good.state.position) > limits.near + 0.04).all(axis=-1)
    away |= (np.abs(good.state.position - good.sent) < np.radians(0.9)).all(axis=-1)
    assert not (fine & free & away & changed).any(), "an acceptable command passes unchanged"
    _check_again(limits, case, out, ok)
    return out


def check_clear(limits: GuardLimits, sent: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Nothing is too low or in contact that was not, and what was is no worse; returns the least clearances allowed."""
    before, after = clearances(limits, sent), clearances(limits, command)
    least, n = np.minimum(before, 0.0), limits.arm.joints
    assert (after[:, :n] >= least[:, :n] - HEIGHT_ROUNDING).all(), "above the floor"
    assert (after[:, n:] >= least[:, n:] - GAP_ROUNDING).all(), "free of contact"
    return least


def expected_trips(limits: GuardLimits, case: Case) -> np.ndarray:
    """Flags (B,) of what ends the motion."""
    command, sent, speed, state, _ = case
    arm, position, margin = limits.arm, state.position, np.radians(10.0)
    flags = np.zeros(len(command), dtype=np.uint16)
    flags[~np.isfinite(np.concatenate([command, sent, speed, position], axis=-1)).all(axis=-1)] |= np.uint16(
        Reason.NOT_FINITE
    )
    flags[~(state.age <= 0.5)] |= np.uint16(Reason.STALE)
    known = np.where(np.isfinite(position), position, arm.rest)
    flags[((known < arm.lower - margin) | (known > arm.upper + margin)).any(axis=-1)] |= np.uint16(Reason.OUT_OF_RANGE)
    if state.temperature is not None:
        flags[(state.temperature > 65.0).any(axis=-1)] |= np.uint16(Reason.TEMPERATURE)
    if state.fault is not None:
        flags[state.fault.any(axis=-1)] |= np.uint16(Reason.SERVO_FAULT)
    return flags


def clearances(limits: GuardLimits, q: np.ndarray) -> np.ndarray:
    """Heights above their floors (n), distances between links less their thickness, and heights of ends: (B, ...)."""
    arm, shape, ends = limits.arm, collision_shape(limits.arm), link_ends(limits.arm, q)
    height = ends[:, 2:, 2] - limits.floors
    i, j = shape.pairs.T
    gap = segments_apart(ends[:, i], ends[:, i + 1], ends[:, j], ends[:, j + 1]) - 2.0 * shape.radius
    ground = ends[:, shape.places, 2] - min(0.0, arm.floor) - shape.radius
    return np.concatenate([height, gap, ground], axis=-1)


def _check_holds(limits: GuardLimits, case: Case, out: Guarded, tripped: np.ndarray) -> None:
    """A trip is a hold, of the last command where that is a number."""
    sent, command = case.sent[tripped], out.command[tripped]
    known = np.isfinite(sent)
    np.testing.assert_array_equal(command[known], sent[known])
    guessed = np.nan_to_num(command[~known])
    assert (guessed >= limits.arm.lower.min()).all()
    assert (guessed <= limits.arm.upper.max()).all()
    assert (out.speed[tripped] == 0.0).all()


def _check_again(limits: GuardLimits, case: Case, out: Guarded, ok: np.ndarray) -> None:
    """Asked for its own answer, the guard has nothing to add.

    But where a contact stops an arm that is not where it was sent, or whose last command was outside: each joint is
    pulled back anew.
    """
    again, sent = guard(limits, out.command, *case[1:]), case.sent
    with np.errstate(invalid="ignore", over="ignore"):
        home = np.abs(sent - case.state.position) < np.radians(0.9)
        home &= (sent >= limits.lower) & (sent <= limits.upper)
    settled = ok & (home.all(axis=-1) | ((out.reasons & _CLEARANCE) == 0))
    np.testing.assert_array_equal(again.command[settled], out.command[settled])
    np.testing.assert_array_equal(again.speed[settled], out.speed[settled])
    assert (again.reasons[settled] == 0).all()


def _check_motion(limits: GuardLimits, case: Case, out: Guarded) -> tuple[np.ndarray, np.ndarray]:
    """Lead, position, step and acceleration; returns the bounds (B, n) that a command must be in to pass unchanged."""
    command, sent, speed, position, arm = out.command, case.sent, case.speed, case.state.position, limits.arm
    time = np.nan_to_num(np.where(case.period > 0.0, np.minimum(case.period, 0.1), 0.0))[:, None]
    assert (np.abs(command - sent) <= arm.max_speed * time + STEP_ROUNDING * (1.0 + np.abs(sent))).all(), "step"
    low, high = np.minimum(limits.lower, sent), np.maximum(limits.upper, sent)
    assert ((command >= low) & (command <= high)).all(), "inside the limits, or no farther outside"
    near = np.abs(sent - position) <= MAX_LEAD
    assert (np.abs(command - position) <= MAX_LEAD + STEP_ROUNDING)[near].all(), "lead"
    step, way, gain = command - sent, speed * time, limits.max_acceleration * time**2
    rounding = STEP_ROUNDING * (1.0 + np.abs(sent) + np.abs(way))
    braking = (step * way >= 0.0) & (np.abs(step) <= np.abs(way) + rounding)
    held = command == sent
    assert (braking | held | (np.abs(step - way) <= gain + rounding)).all(), "acceleration"
    regular = (time >= RAMP) & (np.abs(speed) <= arm.max_speed)
    assert (np.abs(step - way) <= gain * (1.0 + 1e-9) + rounding)[regular].all(), "and all changes of speed"
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        quotient = np.clip(np.where(time > 0.0, step / time, 0.0), -arm.max_speed, arm.max_speed)
    np.testing.assert_array_equal(out.speed, quotient)
    bounds = [
        (position - MAX_LEAD, position + MAX_LEAD),
        (limits.lower, limits.upper),
        (sent - arm.max_speed * time, sent + arm.max_speed * time),
        (sent + np.minimum(way - gain, 0.0), sent + np.maximum(way + gain, 0.0)),
    ]
    return np.max([np.broadcast_to(b[0], sent.shape) for b in bounds], axis=0), np.min(
        [np.broadcast_to(b[1], sent.shape) for b in bounds], axis=0
    )


def _rows(state: JointState, rows: np.ndarray) -> JointState:
    return JointState(time=state.time[rows], position=state.position[rows], age=state.age[rows])


def _choose(rng: np.random.Generator, options: list[np.ndarray]) -> np.ndarray:
    """One of the options (B, n) for every row."""
    return np.stack(options)[rng.integers(0, len(options), len(options[0])), np.arange(len(options[0]))].copy()
