"""Quantiles against another implementation of them."""

import math

import numpy as np
import pytest

from rejoint.system.statistics import NORMAL95, Estimate, student95


def test_students_quantiles_are_those_of_tables():
    assert [student95(n) for n in (1, 5, 30)] == pytest.approx([12.706, 2.571, 2.042], abs=5e-4)
    assert student95(200_000) == pytest.approx(NORMAL95, rel=1e-5)


def test_nothing_is_known_without_a_degree_of_freedom():
    assert student95(0) == math.inf


def test_an_estimate_is_plain_data():
    estimate = Estimate(np.float64(1.0), None, np.float32(2.0))
    assert [type(number) for number in (estimate.value, estimate.low, estimate.high)] == [float, type(None), float]
