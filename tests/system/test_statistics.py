"""Quantiles against another implementation of them."""

import math

import numpy as np
import pytest
from scipy.special import ndtri, stdtrit

from rejoint.system.statistics import NORMAL95, Estimate, student95


@pytest.mark.parametrize("freedom", [*range(1, 41), 99, 100, 1000, 5001])
def test_students_quantile_is_that_of_scipy(freedom):
    assert student95(freedom) == pytest.approx(stdtrit(freedom, 0.975), rel=1e-11)


def test_the_normal_quantile_is_that_of_scipy_and_the_limit_of_students():
    assert pytest.approx(ndtri(0.975), rel=1e-14) == NORMAL95
    assert student95(200_000) == pytest.approx(NORMAL95, rel=1e-5)


def test_nothing_is_known_without_a_degree_of_freedom():
    assert student95(0) == math.inf


def test_an_estimate_is_plain_data():
    estimate = Estimate(np.float64(1.0), None, np.float32(2.0))
    assert [type(number) for number in (estimate.value, estimate.low, estimate.high)] == [float, type(None), float]
