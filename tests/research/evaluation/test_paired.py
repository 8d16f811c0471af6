"""Pairs of controllers: ratios and differences worked by hand, and intervals whose ends are known."""

import numpy as np
import pytest
from scipy.stats import binom

from rejoint_lab.research.evaluation.summary import difference, ratios, time_ratio


def test_ratios_know_infinity():
    first = np.array([[1.0, np.inf, 2.0, np.inf, np.nan]])
    second = np.array([[2.0, np.inf, np.inf, 3.0, 1.0]])
    np.testing.assert_array_equal(ratios(first, second), [[0.5, 1.0, 0.01, 100.0, 100.0]])


def times(rng, shape):
    """Times to stay, some of them never, some of arms that were stopped."""
    found = rng.uniform(0.2, 5.0, shape)
    kind = rng.random(shape)
    return np.where(kind < 0.1, np.inf, np.where(kind < 0.2, np.nan, found))


def test_swapping_two_controllers_inverts_ratios_and_negates_differences():
    rng = np.random.default_rng(1)
    first, second = times(rng, (7, 3)), times(rng, (7, 3))
    np.testing.assert_allclose(ratios(first, second) * ratios(second, first), 1.0)
    here, there = time_ratio(first, second, seed=3), time_ratio(second, first, seed=3)
    for one, other in ((here.value, there.value), (here.low, there.high), (here.high, there.low)):
        assert one * other == pytest.approx(1.0)
    first, second = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    here, there = difference(first, second, seed=3), difference(second, first, seed=3)
    for one, other in ((here.value, there.value), (here.low, there.high), (here.high, there.low)):
        assert one == pytest.approx(-other)


def test_a_controller_against_itself_is_neither_sooner_nor_nearer():
    same = times(np.random.default_rng(2), (6, 4))
    ratio, gap = time_ratio(same, same), difference(same, same)
    assert (ratio.low, ratio.value, ratio.high) == (1.0, 1.0, 1.0)
    assert (gap.low, gap.value, gap.high) == (0.0, 0.0, 0.0)


def test_the_interval_of_a_difference_is_that_of_drawing_arms_with_replacement():
    # 10 of 20 arms differ by 1, the others by 0: a resample's mean is a binomial share of 20.
    each = np.array([1.0, 0.0] * 10)[:, None]
    low, high = binom.ppf([0.025, 0.975], 20, 0.5) / 20
    one_target = difference(each, 0 * each)
    assert (one_target.low, one_target.value, one_target.high) == (low, 0.5, high) == (0.3, 0.5, 0.7)
    # More targets of the same arms bring no other arms, so the interval stays.
    many = np.repeat(each, 9, axis=1)
    nine = difference(many, 0 * many)
    assert (nine.low, nine.value, nine.high) == pytest.approx((low, 0.5, high))


@pytest.mark.parametrize("fast", [11, 13, 15, 18])
def test_the_interval_of_a_median_ratio_is_that_of_drawing_arms_with_replacement(fast):
    # Of 21 arms some need half the time and the rest twice as much: the median of a resample is 1/2 exactly if at
    # least 11 of its 21 arms are among the fast ones.
    arms = np.where(np.arange(21) < fast, 0.5, 2.0)[:, None]
    estimate = time_ratio(np.repeat(arms, 3, axis=1), np.ones((21, 3)))
    slow = binom.cdf(10, 21, fast / 21)
    assert abs(slow - 0.025) > 0.004, "an example that a thousand resamples can decide"
    assert estimate.value == estimate.low == 0.5
    assert estimate.high == (2.0 if slow > 0.025 else 0.5)


def test_a_difference_is_over_what_both_have():
    base = np.arange(12.0).reshape(6, 2)
    estimate = difference(base + 0.5, base)
    assert estimate.value == estimate.low == estimate.high == 0.5
    holes = base.copy()
    holes[0, 0], holes[3, 1] = np.nan, np.nan
    other = base - np.where(np.arange(12).reshape(6, 2) == 5, 0.0, 1.0)  # one of the twelve is no better
    assert difference(holes, other).value == pytest.approx(9 / 10)
    assert difference(np.full((2, 2), np.nan), np.ones((2, 2))) is None
