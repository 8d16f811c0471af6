"""Laws of the guard: finite, bounded, idempotent, transparent, the same for one arm and for many."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import Box, frames, mycobot280, tcp_position
from rejoint.arms.collision import collision_shape
from rejoint.control.guard import RAMP, TRIPS, Guarded, GuardLimits, Reason, guard, reason_names
from rejoint.control.robot import JointState
from rejoint.system.errors import InputError

ARM = mycobot280()
LIMITS = GuardLimits.of(ARM)
PERIOD = 0.025
REACH = ARM.max_speed * PERIOD


def state(position, *, age=0.0, temperature=None, fault=None):
    position = np.atleast_2d(position)
    count = len(position)
    return JointState(
        time=np.zeros(count),
        position=position,
        age=np.full(count, age),
        temperature=temperature,
        fault=fault,
    )


seeds = st.integers(0, 2**32 - 1)


def inputs(seed, count=5):
    """Last commands, measured positions within the lead, and wild or mild wanted commands."""
    rng = np.random.default_rng(seed)
    sent = rng.uniform(LIMITS.lower, LIMITS.upper, (count, 6))
    measured = np.clip(sent + rng.uniform(-0.3, 0.3, sent.shape), ARM.lower, ARM.upper)
    command = sent + rng.normal(0.0, rng.choice([0.01, 0.1, 2.0]), sent.shape)
    return command, sent, state(measured)


@settings(max_examples=150)
@given(seeds)
def test_idempotent_and_a_reason_for_every_change(seed):
    command, sent, now = inputs(seed)
    once = guard(LIMITS, command, sent, 0 * sent, now, PERIOD)
    twice = guard(LIMITS, once.command, sent, 0 * sent, now, PERIOD)
    assert (twice.command == once.command).all()
    assert (twice.reasons == 0).all()
    assert ((once.reasons != 0) == (once.command != command).any(axis=-1)).all()


@settings(max_examples=50)
@given(seeds)
def test_a_batch_is_many_single_arms(seed):
    command, sent, now = inputs(seed)
    period = np.random.default_rng(seed).uniform(0.01, 0.05, len(sent))
    batch = guard(LIMITS, command, sent, 0 * sent, now, period)
    for b in range(len(sent)):
        one = guard(LIMITS, command[[b]], sent[[b]], np.zeros((1, 6)), state(now.position[[b]]), period[[b]])
        assert (one.command[0] == batch.command[b]).all()
        assert one.reasons[0] == batch.reasons[b]


def test_an_acceptable_command_passes_unchanged():
    sent = np.tile(ARM.rest, (3, 1))
    command = sent + 0.9 * REACH * np.array([[1.0], [0.0], [-1.0]])
    out = guard(LIMITS, command, sent, 0 * sent, state(sent), PERIOD)
    assert (out.command == command).all()
    assert (out.reasons == 0).all()


def one(command, sent=None, position=None, limits=LIMITS, **kwargs) -> Guarded:
    sent = ARM.rest if sent is None else sent
    position = sent if position is None else position
    return guard(
        limits, np.atleast_2d(command), np.atleast_2d(sent), np.zeros((1, 6)), state(position, **kwargs), PERIOD
    )


def test_step_is_speed_times_period():
    out = one(ARM.rest + 1.0)
    np.testing.assert_allclose(out.command[0] - ARM.rest, np.radians(150.0) * 0.025)
    assert out.reasons[0] == Reason.LEAD | Reason.STEP


def test_a_long_period_does_not_allow_a_long_step():
    sent = np.atleast_2d(ARM.rest)
    out = guard(LIMITS, sent + 0.34, sent, 0 * sent, state(sent), 5.0)
    np.testing.assert_allclose(out.command - sent, ARM.max_speed[None] * LIMITS.max_period)
    assert out.reasons[0] == Reason.STEP


def test_lead_is_kept():
    measured = ARM.rest - np.radians(19.0)
    out = one(ARM.rest + np.radians(3.0), position=measured)
    np.testing.assert_allclose(out.command[0], ARM.rest + np.radians(1.0))
    assert out.reasons[0] == Reason.LEAD


def test_position_limit_and_way_back_from_outside():
    outside = ARM.rest.copy()
    outside[2] = ARM.lower[2] - np.radians(2.0)
    out = one(outside, sent=outside)
    assert out.reasons[0] == Reason.POSITION
    assert out.command[0, 2] == LIMITS.lower[2]
    further = one(outside - 0.01, sent=outside)
    assert further.command[0, 2] == LIMITS.lower[2]


def posture_at(height):
    """Shoulder angle at which the stretched arm's TCP is at ``height`` [m]."""
    angles = np.linspace(0.0, np.radians(139.0), 20_000)
    q = np.zeros((len(angles), 6))
    q[:, 1] = -angles
    heights = tcp_position(ARM, q)[:, 2]
    return q[np.argmax(heights < height)]


def test_floor_scales_the_step_back_and_lets_the_arm_leave():
    limits = dataclasses.replace(LIMITS, collisions=False)
    sent = posture_at(ARM.floor + 0.002)
    down = posture_at(ARM.floor - 0.01)
    down = sent + (down - sent) * min(1.0, 0.9 * REACH[1] / np.abs(down - sent).max())
    out = one(down, sent=sent, limits=limits)
    assert out.reasons[0] == Reason.FLOOR
    assert 0.0 <= tcp_position(ARM, out.command[0])[2] - ARM.floor < 0.001
    below = posture_at(ARM.floor - 0.005)
    up = below + 0.5 * (sent - below)
    assert (one(up, sent=below, limits=limits).command[0] == up).all()
    held = one(below - 0.3 * (sent - below), sent=below, limits=limits)
    assert held.reasons[0] == Reason.FLOOR
    np.testing.assert_allclose(held.command[0], below, atol=1e-6)


def elbow(degrees):
    """Posture whose wrist comes near the upper arm: it touches from 139.2 deg on, see test_collision.py."""
    return np.radians([0.0, 0, degrees, -degrees, 0, 0])


def test_a_contact_ends_the_step_and_may_be_left():
    radius = collision_shape(ARM).radius
    touching = np.degrees(np.pi - np.arcsin(2 * radius / 0.096))  # forearm of 96 mm, capsules two radii thick
    out = one(elbow(touching + 1.0), sent=elbow(touching - 1.0))
    assert out.reasons[0] == Reason.COLLISION
    assert touching - 0.13 < np.degrees(out.command[0, 2]) <= touching
    deeper = one(elbow(touching + 2.0), sent=elbow(touching + 1.0))
    assert deeper.reasons[0] == Reason.COLLISION
    np.testing.assert_allclose(deeper.command[0], elbow(touching + 1.0), atol=1e-6)
    back = one(elbow(touching), sent=elbow(touching + 1.0))
    assert back.reasons[0] == 0
    assert (back.command[0] == elbow(touching)).all()


def test_the_table_is_a_contact_of_housings():
    # Stretched out level the arm is 131 mm high; turned down about its shoulder, the wrist's housing comes first.
    level = np.radians([0.0, -90, 0, 0, 0, 0])
    sent, speed = level[None], np.zeros((1, 6))
    for _ in range(100):
        sent, reasons, speed = guard(LIMITS, sent - [0, 0.03, 0, 0, 0, 0], sent, speed, state(sent), PERIOD)
    assert reasons[0] & Reason.COLLISION
    shape = collision_shape(ARM)
    ends = np.append(frames(ARM, sent[0]).position[2:, 2], tcp_position(ARM, sent[0])[2])
    assert ends.min() == pytest.approx(shape.radius, abs=1e-3)
    assert ends.min() >= shape.radius


def test_a_ground_that_the_tool_may_pass_is_no_ground():
    pedestal = dataclasses.replace(ARM, floor=-0.4)
    down = np.radians([0.0, -135, 0, 0, 0, 0])
    on_table, above = (
        guard(GuardLimits.of(arm), down[None], down[None] + 0.01, np.zeros((1, 6)), state(down), PERIOD)
        for arm in (ARM, pedestal)
    )
    assert on_table.reasons[0] & (Reason.COLLISION | Reason.FLOOR)
    assert above.reasons[0] == 0


def test_acceleration_is_limited_away_from_rest_and_braking_is_free():
    rest, full = ARM.rest[None], np.full((1, 6), ARM.max_speed[0])
    gain = ARM.max_speed[0] / RAMP * 0.01  # [rad/s] in 10 ms

    def speed_of(wanted, speed):
        out = guard(LIMITS, rest + 0.01 * wanted, rest, speed, state(rest), 0.01)
        np.testing.assert_allclose(out.speed, (out.command - rest) / 0.01)
        return out.speed[0, 0], out.reasons[0]

    assert speed_of(full, 0 * full) == (pytest.approx(gain), Reason.ACCELERATION)
    assert speed_of(-full, full) == (0.0, Reason.ACCELERATION)  # 2.6 - 1.5 rad/s: not yet turned round
    assert speed_of(-full, 0.2 * full) == (pytest.approx(0.2 * full[0, 0] - gain), Reason.ACCELERATION)
    assert speed_of(0 * full, full) == (0.0, 0)  # a hold is always allowed
    assert speed_of(0.1 * full, full) == (pytest.approx(0.1 * full[0, 0]), 0)


@pytest.mark.parametrize("period", [RAMP, 0.025, 0.05])
def test_regular_periods_let_an_arm_start_and_stop_at_once(period):
    rest, full = ARM.rest[None], ARM.max_speed[None]
    for speed, wanted in ((0 * full, full), (full, 0 * full), (full, full), (full, 0.1 * full)):
        assert guard(LIMITS, rest + 0.999 * period * wanted, rest, speed, state(rest), period).reasons[0] == 0
    back = guard(LIMITS, rest - 0.999 * period * full, rest, full, state(rest), period)
    assert back.reasons[0] == (Reason.ACCELERATION if period < 2 * RAMP else 0)


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        (Reason.STALE, {"age": 1.0}),
        (Reason.STALE, {"age": np.nan}),
        (Reason.TEMPERATURE, {"temperature": np.array([[30.0, 30, 80, 30, 30, 30]])}),
        (Reason.SERVO_FAULT, {"fault": np.array([[False, False, True, False, False, False]])}),
        (Reason.OUT_OF_RANGE, {"position": ARM.rest + 5.0}),
        (Reason.NOT_FINITE, {"position": ARM.rest * np.nan}),
    ],
)
def test_trips_hold_and_are_named(reason, change):
    out = one(ARM.rest + 0.01, **change)
    assert out.reasons[0] == reason
    assert out.tripped.all()
    assert reason in TRIPS
    assert (out.command[0] == ARM.rest).all()


def test_warm_servos_and_a_young_state_do_not_trip():
    out = one(ARM.rest + 0.01, age=0.1, temperature=np.full((1, 6), 50.0), fault=np.zeros((1, 6), bool))
    assert out.reasons[0] == 0


def test_inputs_are_not_changed():
    command, sent, now = inputs(3)
    copies = command.copy(), sent.copy(), now.position.copy()
    guard(LIMITS, command, sent, 0 * sent, now, PERIOD)
    for before, after in zip(copies, (command, sent, now.position), strict=True):
        assert (before == after).all()


def test_names_and_bad_limits():
    assert reason_names(Reason.STEP | Reason.NOT_FINITE) == ("step", "not finite")
    assert reason_names(0) == ()
    with pytest.raises(InputError, match="max_speed needs 6"):
        GuardLimits(arm=ARM, lower=ARM.lower, upper=ARM.upper, max_speed=np.ones(3), max_acceleration=np.ones(6))
    with pytest.raises(InputError, match="max_lead must be positive"):
        GuardLimits(
            arm=ARM,
            lower=ARM.lower,
            upper=ARM.upper,
            max_speed=ARM.max_speed,
            max_acceleration=np.ones(6),
            max_lead=0.0,
        )


def test_clearances_go_with_the_size_of_the_arm_and_follow_its_floor():
    assert (LIMITS.joint_floor, LIMITS.tcp_floor) == (0.03, 0.02)
    offset, tip = ARM.offset.copy(), ARM.tip.copy()
    offset[:, :3, 3] *= 2.0
    tip[:3, 3] *= 2.0
    double = GuardLimits.of(dataclasses.replace(ARM, offset=offset, tip=tip, floor=0.04))
    assert double.joint_floor == pytest.approx(2 * LIMITS.joint_floor)
    on_a_pedestal = GuardLimits.of(dataclasses.replace(ARM, floor=-0.5))
    assert on_a_pedestal.joint_floor == pytest.approx(-0.49)


def test_the_others_heed_where_a_stuck_joint_is():
    low = tcp_position(ARM, ARM.rest)[2] - 0.05
    wall = Box(lower=np.array([-1.0, -1.0, -0.5]), upper=np.array([1.0, 1.0, low]))
    limits = GuardLimits.of(dataclasses.replace(ARM, keep_out=(wall,)))
    for stuck in (False, True):
        sent, speed = ARM.rest[None] + np.radians([0.0, 20.0, 0.0, 0.0, 0.0, 0.0]), np.zeros((1, 6))
        reasons = 0
        for _ in range(14):
            position = sent.copy()
            if stuck:
                position[0, 1] = ARM.rest[1]
            wanted = sent - np.radians([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
            sent, found, speed = guard(limits, wanted, sent, speed, state(position), PERIOD)
            reasons |= int(found[0])
        assert bool(reasons & Reason.COLLISION) == stuck
