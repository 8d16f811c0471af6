"""The reference ramp and the delay, against hand-worked numbers and against small steps."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.control.servoreference import ServoReference
from rejoint.logs.runlog import RunLog


def commands(seed):
    """Times (8,) [s] and commands (8, 2) [rad]."""
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.02, 0.03, 8)), rng.normal(0, 0.3, (8, 2))


def test_hand_worked_ramp():
    # 1 rad at 2 rad/s, sent at 1 s: there after half a second; turned round at 1.25 s.
    time, command = np.array([0.0, 1.0, 1.25]), np.array([[0.0], [1.0], [-1.0]])
    r = ServoReference(time, command, 2.0)
    seen = r.sample(np.array([3.0, 0.5, 1.0, 1.1, 1.25, 1.5, 2.0]), np.array([0.0]))[0, :, 0]
    np.testing.assert_allclose(seen, [-1.0, 0.0, 0.0, 0.2, 0.5, 0.0, -1.0], atol=1e-12)


@settings(max_examples=25)
@given(delay=st.floats(0.0, 0.1), limits=st.sampled_from([(0.2,), (5.0,), (1.0, 30.0)]), seed=st.integers(0, 99))
def test_delay_shifts(delay, limits, seed):
    time, command = commands(seed)
    r = ServoReference(time, command, *limits)
    at = np.linspace(time[0], time[-1] + 0.1, 57)
    both = r.sample(at, np.array([0.0, delay]))
    np.testing.assert_allclose(both[1], r.sample(at - delay, np.array([0.0, 0.0]))[0], atol=1e-9)


@pytest.mark.parametrize("speed", [1.5, 5.0, 40.0])
def test_references_move_at_their_speed_and_stop_at_their_command(speed):
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.01, 0.03, 400))
    command = np.cumsum(rng.normal(0, 0.02, (400, 3)), axis=0)
    expected = command.copy()
    for k, reach in enumerate(speed * np.diff(time)):
        expected[k + 1] = expected[k] + np.clip(command[k] - expected[k], -reach, reach)
    np.testing.assert_allclose(ServoReference(time, command, speed).sample(time, np.zeros(1))[0], expected, atol=1e-12)


def test_commands_of_rows_lost_from_an_imported_log_are_interpolated():
    time, command = 0.02 * np.arange(100), np.linspace(0.0, np.ones(5), 100)
    whole = replace(RunLog.of(time, command, command, arm="so101"), extra={"format": "table"})
    lost = whole.rows(np.delete(np.arange(100), [7, 30, 31]))
    np.testing.assert_allclose(lost.sent[0], time, atol=1e-12)
    np.testing.assert_allclose(lost.sent[1], command, atol=1e-12)
    for same in (whole, replace(lost, extra={})):
        np.testing.assert_array_equal(same.sent[1], same.command)
