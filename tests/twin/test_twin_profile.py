"""References of limited acceleration, against hand-worked numbers, small steps and their own laws."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.control.servoreference import ServoReference, move

NO_DELAY = np.array([0.0])


def advance(position, velocity, goal, acceleration, elapsed):
    return move(position, velocity, goal, np.inf, acceleration, elapsed)


def test_hand_worked_motion_from_rest_to_rest():
    # 1 rad at 4 rad/s^2: speeds up for half a second, half way there with 2 rad/s, at rest after one second.
    seen = np.array([advance(0.0, 0.0, 1.0, 4.0, at) for at in (0.25, 0.5, 0.75, 1.0, 2.0)])
    np.testing.assert_allclose(seen[:, 0], [0.125, 0.5, 0.875, 1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(seen[:, 1], [1.0, 2.0, 1.0, 0.0, 0.0], atol=1e-12)


def test_hand_worked_turn():
    # Moving away with 1 rad/s at 2 rad/s^2: stops after 0.5 s, 0.25 rad further off; 1 rad back take 2 sqrt(1 / 2) s.
    np.testing.assert_allclose(advance(0.25, -1.0, 1.0, 2.0, 0.5), [0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(advance(0.25, -1.0, 1.0, 2.0, 0.5 + np.sqrt(2.0)), [1.0, 0.0], atol=1e-12)


@settings(max_examples=50)
@given(
    start=st.floats(-2, 2),
    speed=st.floats(-5, 5),
    goal=st.floats(-2, 2),
    limit=st.floats(1, 100),
    first=st.floats(0, 1),
    second=st.floats(0, 1),
)
def test_two_advances_are_one(start, speed, goal, limit, first, second):
    at_once = advance(start, speed, goal, limit, first + second)
    half = advance(start, speed, goal, limit, first)
    np.testing.assert_allclose(advance(*half, goal, limit, second), at_once, atol=1e-6)


@settings(max_examples=25)
@given(limit=st.floats(5.0, 100.0), seed=st.integers(0, 99))
def test_the_acceleration_is_never_exceeded_while_commands_keep_changing(limit, seed):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.015, 0.025, 60))
    command = np.cumsum(rng.normal(0.0, 0.05, (60, 2)), axis=0)
    step = 1e-3
    path = ServoReference(time, command, 1.0, limit).sample(np.arange(time[0], time[-1], step), NO_DELAY)[0]
    assert np.abs(np.diff(path, 2, axis=0)).max() < 1.001 * limit * step**2
    np.testing.assert_allclose(path[0], command[0])


def test_a_goal_that_is_sent_again_is_followed_at_once():
    time = np.arange(6) * 0.02
    command = np.array([0.0, 0.3, 0.3, 0.3, 0.5, 0.5])[:, None]
    seen = ServoReference(time, command, 1.0, 40.0).sample(np.array([0.039, 0.040, 0.079, 0.099, 0.1]), NO_DELAY)[
        0, :, 0
    ]
    # 40 / 2 * 0.019^2 from each of the two goals before the second sending of the next
    np.testing.assert_allclose(seen, [0.00722, 0.3, 0.3, 0.30722, 0.5], atol=1e-12)


def test_a_fast_sine_is_followed_to_its_limit_and_no_further():
    # a w^2 = 18 and 95 rad/s^2, limit 40: the first keeps its size, the second cannot.
    time = np.arange(0.0, 6.0, 0.02)
    for frequency, smallest, largest in ((1.75, 0.98, 1.02), (4.0, 0.2, 0.8)):
        command = 0.15 * np.sin(2 * np.pi * frequency * time)[:, None]
        path = ServoReference(time, command, 1.0, 40.0).sample(np.arange(3.0, 6.0, 0.002), NO_DELAY)
        assert smallest < np.abs(path).max() / 0.15 < largest
