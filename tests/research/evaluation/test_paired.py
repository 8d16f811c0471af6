"""Pairs of controllers: differences worked by hand, and intervals whose ends are known."""

import numpy as np
import pytest
from scipy.stats import binom

from rejoint_lab.research.evaluation.evaluate import difference, worst


def test_swapping_two_controllers_negates_differences():
    first, second = np.random.default_rng(1).normal(size=(2, 7, 3))
    here, there = difference(first - second, seed=3), difference(second - first, seed=3)
    for one, other in ((here.value, there.value), (here.low, there.high), (here.high, there.low)):
        assert one == pytest.approx(-other)
    assert worst(first - second) == pytest.approx((first - second).mean(axis=1).max())


def test_the_interval_of_a_difference_is_that_of_drawing_arms_with_replacement():
    # 10 of 20 arms differ by 1, the others by 0: a resample's mean is a binomial share of 20.
    each = np.array([1.0, 0.0] * 10)[:, None]
    low, high = binom.ppf([0.025, 0.975], 20, 0.5) / 20
    one_target = difference(each)
    assert (one_target.low, one_target.value, one_target.high) == (low, 0.5, high) == (0.3, 0.5, 0.7)
    # More targets of the same arms bring no other arms, so the interval stays.
    many = np.repeat(each, 9, axis=1)
    nine = difference(many)
    assert (nine.low, nine.value, nine.high) == pytest.approx((low, 0.5, high))


def test_a_difference_is_over_what_both_have():
    base = np.arange(12.0).reshape(6, 2)
    estimate = difference(base + 0.5 - base)
    assert estimate.value == estimate.low == estimate.high == 0.5
    holes = base.copy()
    holes[0, 0], holes[3, 1] = np.nan, np.nan
    other = base - np.where(np.arange(12).reshape(6, 2) == 5, 0.0, 1.0)  # one of the twelve is no better
    assert difference(holes - other).value == pytest.approx(9 / 10)
    assert difference(np.full((2, 2), np.nan)) is None
