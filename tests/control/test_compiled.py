"""The compiled loops give, to the bit, what NumPy gives element by element."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rejoint.arms import clip_norm
from rejoint.control import compiled
from rejoint.control.controllers.law import fade
from rejoint.control.controllers.residual import CommandLaw

SEEDS = st.integers(0, 2**32 - 1)


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
