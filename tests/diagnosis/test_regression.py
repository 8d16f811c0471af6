"""Fits against known truth, intervals against their promise."""

import numpy as np
import scipy.stats

from rejoint.diagnosis.regression import PER_SET, fit_clustered, fit_trimmed


def test_noiseless_fit_is_exact():
    rng = np.random.default_rng(0)
    design = rng.normal(size=(60, 3))
    truth = np.array([2.0, -3e-4, 50.0])
    fit = fit_clustered(design, design @ truth, np.repeat(np.arange(6), 10))
    assert np.allclose(fit.coefficients, truth, rtol=1e-9)


def test_clustered_intervals_cover_where_plain_ones_do_not():
    rng = np.random.default_rng(1)
    cluster = np.repeat(np.arange(12), 25)
    clustered = plain = 0
    for _ in range(300):
        x = rng.normal(size=12)[cluster]  # the same within a motion, as friction state is
        y = 1.0 + 0.5 * x + rng.normal(size=12)[cluster] + 0.1 * rng.normal(size=300)
        estimate = fit_clustered(np.stack([np.ones(300), x], 1), y, cluster).estimate(1)
        clustered += estimate.low <= 0.5 <= estimate.high
        line = scipy.stats.linregress(x, y)
        plain += abs(line.slope - 0.5) <= 1.97 * line.stderr
    assert clustered / 300 > 0.85
    assert plain / 300 < 0.6


def test_recordings_that_differ_are_the_observations():
    rng = np.random.default_rng(3)
    recording, inside = np.repeat(np.arange(6), 200), 0
    cluster = recording * PER_SET + np.tile(np.repeat(np.arange(20), 10), 6)
    for _ in range(200):
        x = rng.normal(size=1200)
        y = (0.5 + 0.3 * rng.normal(size=6))[recording] * x + rng.normal(size=1200)
        estimate = fit_clustered(x[:, None], y, cluster).estimate(0)
        inside += estimate.low <= 0.5 <= estimate.high
    assert inside / 200 > 0.9


def test_trimmed_fit_forgets_a_third_of_stuck_samples():
    rng = np.random.default_rng(2)
    x = rng.uniform(-1, 1, 300)
    y = 0.3 * x + 0.1 + 1e-3 * rng.normal(size=300)
    y[:100] += 2.0 * (1 + x[:100])
    cluster = np.repeat(np.arange(30), 10)
    fit = fit_trimmed(np.stack([x, np.ones(300)], 1), y, cluster)
    assert np.allclose(fit.coefficients, [0.3, 0.1], atol=2e-3)


def test_a_column_of_zeros_gets_zero_and_disturbs_nothing():
    x = np.linspace(0, 1, 40)
    fit = fit_clustered(np.stack([x, np.zeros(40)], 1), 2 * x, np.arange(40) // 8)
    assert np.allclose(fit.coefficients, [2.0, 0.0])
