"""A replay's answers do not depend on how long its steps are, nor on where in them the commands come."""

from dataclasses import replace

import numpy as np
import pytest
from motion_logs import ARM, PERIOD, TRUTH, as_log, wandering

from rejoint.twin.parameters import TwinParameters
from rejoint.twin.replay import Replay, cut
from twinmodel import predict


@pytest.mark.parametrize("jitter", [0.0, 0.004])
@pytest.mark.parametrize("delay", [0.010, 0.013, 0.020])
def test_a_coarse_step_adds_no_lag(delay, jitter):
    time, command = wandering(0, 24.0)
    time = time + np.random.default_rng(0).uniform(0.0, jitter, len(time))
    log = as_log("even", time, np.tile(command[:1], (len(time), 1)), command)
    twin = replace(TRUTH, delay=delay, coulomb=0.1 * TRUTH.coulomb)
    fine = predict(ARM, twin, log, PERIOD / 40)
    speed = np.gradient(fine, time, axis=0)
    moving = np.abs(speed) > 0.1
    behind = np.sum(np.where(moving, (fine - predict(ARM, twin, log, PERIOD / 2)) * speed, 0.0), axis=0)
    lag = behind / np.sum(np.where(moving, speed**2, 0.0), axis=0)
    assert np.abs(lag).max() < 0.001  # of a step of 10 ms


def test_twins_that_differ_in_their_delay_alone_are_replayed_as_each_by_itself():
    """Also where readings are uneven, so that references are sampled."""
    time, command = wandering(0, 12.0)
    time = 1.6 * time + np.random.default_rng(0).uniform(0.0, 0.004, len(time))
    log = as_log("uneven", time, command, command)
    twins = [replace(TRUTH, delay=delay) for delay in np.linspace(0.0, 0.03, 9)]
    together = Replay(ARM, cut([log], 100.0), 0.01).predict(TwinParameters.stacked(twins))
    np.testing.assert_array_equal(together, [predict(ARM, twin, log, 0.01) for twin in twins])
