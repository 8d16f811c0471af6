"""Pairs of controllers: differences worked by hand, and intervals whose ends are known."""

import numpy as np
import pytest
from evaluation_samples import outcome
from scipy.stats import binom

from rejoint_lab.research.evaluation.evaluate import pair, together
from rejoint_lab.research.evaluation.family import ArmFamily


def paired(*settled_mm):
    """Difference [mm] of the settled errors of two controllers with these (A, K)."""
    arms, targets = settled_mm[0].shape
    both = {str(i): [outcome(one)] for i, one in enumerate(settled_mm)}
    found = pair("worn", together(both, np.zeros((arms, targets, 3)), ArmFamily(arms=arms)), "0", "1")
    mean = found.differences["settled"]
    return mean and tuple(1e3 * end for end in (mean.low, mean.value, mean.high))


def test_the_interval_of_a_difference_is_that_of_drawing_arms_with_replacement():
    # 10 of 20 arms differ by 1, the others by 0: a resample's mean is a binomial share of 20.
    each = np.array([1.0, 0.0] * 10)[:, None]
    low, high = binom.ppf([0.025, 0.975], 20, 0.5) / 20
    assert paired(each, 0.0 * each) == pytest.approx((low, 0.5, high))
    # More targets of the same arms bring no other arms, so the interval stays.
    assert paired(np.repeat(each, 9, axis=1), np.zeros((20, 9))) == pytest.approx((low, 0.5, high))


def test_a_difference_is_over_what_both_have():
    base = np.arange(12.0).reshape(6, 2)
    assert paired(base + 0.5, base) == pytest.approx((0.5, 0.5, 0.5))
    holes = base.copy()
    holes[0, 0], holes[3, 1] = np.nan, np.nan
    other = base - np.where(np.arange(12).reshape(6, 2) == 5, 0.0, 1.0)  # one of the twelve is no better
    assert paired(holes, other)[1] == pytest.approx(9 / 10)
    assert paired(np.full((2, 2), np.nan), base[:2]) is None
