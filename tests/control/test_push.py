"""The push against friction: a share of what the twin tells of each joint, where it stands and has to move."""

import numpy as np
import pytest

from rejoint.arms import load_arm, tcp_position
from rejoint.control.feedforward import FeedforwardController, PushController, PushGains
from rejoint.control.goal import nearest_postures
from rejoint.system.errors import InputError
from standin import inputs_of, state_of

ARM = load_arm("so101")
STIFFNESS, FRICTION = np.array([25.0, 20.0, 20.0, 23.0, 26.0]), np.array([0.25, 0.6, 0.8, 0.35, 0.0])
ONE = np.ones(1, dtype=bool)
GAINS = PushGains()
PERIOD = 0.02


def inputs(position, target, time):
    state = state_of(position, time)
    goal = nearest_postures(ARM, target, position)
    return inputs_of(state, target, goal, position, time)


def led(positions, target, gains=GAINS, friction=FRICTION):
    """By how much the push leads the feed-forward [rad], at each of ``positions`` (k, n) one period after another."""
    plain = FeedforwardController(ARM, STIFFNESS, loosen=0.0)
    pushed = PushController(ARM, STIFFNESS, friction, gains)
    found = []
    for k, position in enumerate(positions):
        seen = inputs(position[None], target, PERIOD * k)
        if k == 0:
            plain.reset(seen, ONE)
            pushed.reset(seen, ONE)
        found.append((pushed.command(seen) - plain.command(seen))[0])
    return np.array(found)


def test_a_joint_that_stands_is_led_by_a_share_of_its_friction_and_trembles_by_another():
    standing = np.tile(ARM.rest, (25, 1))  # four periods of the dither, at 8 Hz
    target = tcp_position(ARM, ARM.rest + 0.3)[None]
    lead = led(standing, target)
    away = np.linalg.norm(target - tcp_position(ARM, ARM.rest))
    share = away / (away + GAINS.near) * FRICTION / STIFFNESS
    mean, swing = lead.mean(axis=0), np.ptp(lead, axis=0) / 2
    sure = np.abs(mean) > 0.29 * share  # all but a joint that has hardly anything to do
    assert sure[:4].sum() >= 3
    np.testing.assert_allclose(np.abs(mean)[sure], (GAINS.push * share)[sure], rtol=0.02)
    np.testing.assert_allclose(swing[:4], (GAINS.dither * share)[:4], rtol=0.05)
    assert not lead[:, 4].any(), "a joint without friction is left alone"
    back = led(standing, tcp_position(ARM, ARM.rest - 0.3)[None]).mean(axis=0)
    assert (np.sign(back)[:3] != np.sign(mean)[:3]).any()


def test_neither_pushes_a_joint_that_moves_nor_one_that_is_there():
    target = tcp_position(ARM, ARM.rest + 0.3)[None]
    moving = ARM.rest + 0.3 * PERIOD * np.arange(25)[:, None]  # 0.3 rad/s
    assert np.abs(led(moving, target)[5:]).max() < 1e-9
    assert np.abs(led(np.tile(ARM.rest, (25, 1)), tcp_position(ARM, ARM.rest)[None])).max() < 1e-9


def test_a_friction_beyond_belief_is_held_to_five_degrees():
    lead = led(np.tile(ARM.rest, (25, 1)), tcp_position(ARM, ARM.rest + 0.3)[None], friction=np.full(5, 50.0))
    assert np.abs(lead).max() <= (GAINS.push + GAINS.dither) * GAINS.most
    with pytest.raises(InputError, match="friction must not be negative"):
        PushController(ARM, STIFFNESS, -FRICTION)
