"""The compiled loops give, to the bit, what NumPy gives element by element."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rejoint.arms import clip_norm
from rejoint.control import compiled
from rejoint.control.law import fade
from rejoint.control.residual import CommandLaw

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS)
def test_velocities_are_differences_newest_first_and_a_repeated_answer_changes_none(seed):
    rng = np.random.default_rng(seed)
    time, position = rng.normal(size=5), rng.normal(size=(5, 6))
    velocity, period = rng.normal(size=(5, 3, 6)), rng.uniform(0.02, 0.05, 5)
    rows = np.array([0, 2, 3])
    now, there = time[rows] + rng.choice([0.0, 0.02, 0.3], 3), rng.normal(size=(3, 6))
    elapsed = now - time[rows]
    fresh = elapsed > 0.0
    wanted, wanted_period = velocity.copy(), period.copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        newest = (there - position[rows]) / elapsed[:, None]
    moved = np.concatenate([newest[:, None], velocity[rows, :2]], axis=1)
    wanted[rows] = np.where(fresh[:, None, None], moved, velocity[rows])
    change = np.minimum(elapsed, 0.1) - period[rows]
    wanted_period[rows] = np.where(fresh, period[rows] + 0.3 * change, period[rows])
    compiled.differentiate(rows, now, there, time, position, velocity, period, np.array([0.1, 0.3]))
    np.testing.assert_array_equal(velocity, wanted)
    np.testing.assert_array_equal(period, wanted_period)
    np.testing.assert_array_equal(time[rows], now)
    np.testing.assert_array_equal(position[rows], there)


@given(SEEDS)
def test_joints_on_their_way_are_not_pushed_and_corrections_keep_their_limit(seed):
    rng = np.random.default_rng(seed)
    correction, speed, last, position, step, extra = rng.normal(scale=0.3, size=(6, 4, 6))
    elapsed = rng.choice([0.0, 0.03, 0.1], 4)
    with np.errstate(divide="ignore", invalid="ignore"):
        newest = np.where(elapsed[:, None] > 0.0, (position - last) / elapsed[:, None], speed)
    now = 0.5 * newest + 0.5 * speed
    push = 1.5 * elapsed[:, None] * step
    push = np.where((np.abs(now) > 0.1) & (now * push > 0.0), 0.0, push)
    wanted = np.minimum(np.maximum(correction + push + extra, -0.4), 0.4)
    compiled.integrate(correction, speed, last, position, elapsed, step, extra, np.array([1.5, 0.4, 0.1, 0.5]))
    np.testing.assert_array_equal(correction, wanted)
    np.testing.assert_array_equal(speed, now)
    np.testing.assert_array_equal(last, position)


def test_a_correction_that_is_no_number_stays_visible():
    correction, zeros = np.full((1, 1), np.nan), np.zeros((1, 1))
    compiled.integrate(
        correction, zeros.copy(), zeros.copy(), zeros, np.ones(1), zeros, zeros, np.array([1.0, 0.4, 0.1, 0.5])
    )
    assert np.isnan(correction).all()  # the guard must see it


@given(SEEDS, st.sampled_from([0.0, np.nan]))
def test_steps_and_actions_are_shaped_as_the_law_says(seed, bad):
    rng = np.random.default_rng(seed)
    law = CommandLaw(authority_slope=0.4, step_limit=0.1, load_penalty_distance=0.004)
    scale = 10.0 ** rng.uniform(-6, 0, (5, 1))
    step, error, action = scale * rng.normal(size=(5, 6)), scale * rng.normal(size=(5, 3)), rng.normal(size=(5, 6))
    step[0, 1], action[1, 2] = bad, bad
    distance, moves, spared = np.linalg.norm(error, axis=-1), np.array([1.0, 1, 1, 1, 1, 0]), rng.uniform(0, 1, 6)
    out = np.empty((2, 5, 6))
    rules = (
        law.authority_floor,
        law.authority_slope,
        law.authority_limit,
        law.step_limit,
        0.0005,
        law.load_penalty_distance,
    )
    compiled.weigh(out, step, error, distance, action, moves, spared, np.array(rules))
    near = 1.0 / (1.0 + (distance / law.load_penalty_distance) ** 2)
    wanted = fade(error, 0.0005) * clip_norm(step, law.step_limit) * (1.0 - near[:, None] * spared)
    np.testing.assert_array_equal(out[0], wanted)
    np.testing.assert_array_equal(out[1], law.authority(step) * moves * np.clip(action, -1.0, 1.0))


@given(SEEDS)
def test_limits_are_applied_in_order(seed):
    rng = np.random.default_rng(seed)
    wanted, measured, last, speed = rng.normal(size=(4, 4, 6))
    fastest, acceleration = rng.uniform(1.0, 3.0, 6), rng.choice([10.0, 100.0, np.inf], 6)
    elapsed, lower, upper = rng.choice([0.0, 0.01, 0.1], 4), np.full(6, -0.5), np.full(6, 0.7)
    for time in (elapsed, elapsed[:1]):
        stages = np.empty((5, 4, 6))
        stages[0] = wanted
        compiled.limit(stages, measured, last, speed, time, np.array([fastest, acceleration, lower, upper]), 0.2)
        near = np.minimum(np.maximum(wanted, measured - 0.2), measured + 0.2)
        legal = np.minimum(np.maximum(near, lower), upper)
        time = np.broadcast_to(time, 4)[:, None]
        stepped = np.minimum(np.maximum(legal, last - fastest * time), last + fastest * time)
        gain = np.where(time > 0.0, acceleration * np.maximum(time, 1e-9) * np.maximum(time, 1e-9), 0.0)
        down, up = np.minimum(speed * time - gain, 0.0), np.maximum(speed * time + gain, 0.0)
        smooth = np.minimum(np.maximum(stepped, last + down), last + up)
        np.testing.assert_array_equal(stages, [wanted, near, legal, stepped, smooth])
        assert (smooth[time[:, 0] == 0.0] == last[time[:, 0] == 0.0]).all()


@given(SEEDS)
def test_steps_end_before_the_first_share_that_is_not_clear(seed):
    rng = np.random.default_rng(seed)
    start, command = rng.normal(size=(2, 7, 6))
    clear = rng.normal(loc=rng.choice([0.5, 2.0, 4.0], (7, 1, 1)), size=(7, 9, 10))
    bad = clear < np.where(clear[:, :1] < 0.0, clear[:, :1] - 1e-3, 0.0)
    worse, first = bad[:, -1].any(axis=-1), bad.any(axis=-1).argmax(axis=-1)
    shorter = start + ((first - 1) / 8)[:, None] * (command - start)
    reached = bad[np.arange(7), first] & worse[:, None]
    found, why = command.copy(), np.zeros((2, 7), dtype=bool)
    compiled.shorten(found, why, start, command - start, clear, 1e-3)
    np.testing.assert_array_equal(found, np.where(worse[:, None], shorter, command))
    np.testing.assert_array_equal(why, [reached[:, :6].any(axis=-1), reached[:, 6:].any(axis=-1)])


@given(SEEDS)
def test_the_speed_of_a_command_is_its_step_over_the_time(seed):
    rng = np.random.default_rng(seed)
    command, last = rng.normal(scale=0.1, size=(2, 4, 6))
    elapsed, fastest, speed = rng.choice([0.0, 1e-300, 0.02, 0.1], 4), np.full(6, 3.0), np.empty((4, 6))
    for time in (elapsed, elapsed[:1]):
        compiled.take_speed(speed, command, last, time, fastest)
        with np.errstate(divide="ignore", over="ignore"):
            quotient = np.clip((command - last) / np.broadcast_to(time, 4)[:, None], -3.0, 3.0)
        np.testing.assert_array_equal(speed, np.where(np.broadcast_to(time, 4)[:, None] > 0.0, quotient, 0.0))
