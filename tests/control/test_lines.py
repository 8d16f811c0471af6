"""The slopes of load over error that the logs of an arm's own motion tell."""

from dataclasses import replace

import numpy as np

from rejoint.arms import mycobot280
from rejoint.control.monitor import load_slopes
from rejoint.logs.runlog import RunLog

ARM = mycobot280()
STEP = ARM.encoder_step
GAIN = np.array([5.0, 8.0, 12.0, 20.0, 30.0, 60.0])


def standing_log(gain=GAIN, offset=0.01, noise=0.0, holds=20, lead=0.02):
    """A log of joints that stand while their commands are held, each hold at another lead up to ``lead`` [rad]."""
    rng, rows = np.random.default_rng(0), 20 * holds
    leads = np.repeat(rng.uniform(-lead, lead, (holds, 6)), 20, axis=0)
    time, position = 0.025 * np.arange(rows), np.tile(STEP * np.round(ARM.rest / STEP), (rows, 1))
    arrived = np.vstack([leads[:1], leads[:-1]])  # row k holds the command sent after its state was read
    load = np.clip(gain * arrived + offset + rng.normal(0.0, max(noise, 1e-12), arrived.shape), -1.0, 1.0)
    return replace(RunLog.of(time, position + leads, position, arm=ARM), servo_load=load)


def test_a_line_is_read_from_joints_that_stand():
    slope, error = load_slopes(ARM, [standing_log()])
    np.testing.assert_allclose(slope, GAIN, rtol=1e-3)
    assert (error < 0.15).all()


def test_the_noise_of_loads_makes_a_slope_less_sure():
    gain = np.full(6, 10.0)
    quiet, noisy = (load_slopes(ARM, [standing_log(gain, noise=noise, lead=0.06)]) for noise in (0.001, 0.005))
    assert (noisy[1] > quiet[1]).all()
    assert (np.abs(noisy[0] / gain - 1.0) < noisy[1]).all()
