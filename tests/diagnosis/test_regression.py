"""Fits against known truth, intervals against their promise."""

import numpy as np
import pytest

from rejoint.diagnosis.regression import fit_clustered, fit_line, fit_trimmed, mean_of, product, reciprocal
from rejoint.system.statistics import Estimate


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
        line = fit_line(x, y).estimate(1)
        plain += line.low <= 0.5 <= line.high
    assert clustered / 300 > 0.85
    assert plain / 300 < 0.6


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


def test_mean_worked_by_hand():
    # mean 2, sd 1, n 3: half width 4.3027 * 1 / sqrt 3 = 2.4842
    estimate = mean_of(np.array([1.0, 2.0, 3.0]))
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((2.0, 2 - 2.4842, 2 + 2.4842), abs=1e-3)
    assert mean_of(np.array([4.0])) == Estimate(4.0, None, None)


def test_reciprocal_and_product():
    assert reciprocal(Estimate(0.5, 0.25, 1.0)) == Estimate(2.0, 1.0, 4.0)
    assert reciprocal(Estimate(0.5, -0.1, 1.0)).high is None
    both = product(Estimate(2.0, 1.4, 2.6), Estimate(5.0, 3.0, 7.0))  # 30 % and 40 %: 50 %
    assert (both.value, both.low, both.high) == pytest.approx((10.0, 5.0, 15.0))
