"""A replay's answers do not depend on how long its steps are, nor on where in them the commands come."""

from dataclasses import replace

import numpy as np
import pytest
from motion_logs import ARM, PERIOD, TRUTH, as_log, wandering

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
