"""The figures of a report show the data of the run: the artists' data are compared with the results, not pixels."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def figures(whole):
    return whole[1]


def test_training_curves_are_those_of_the_file(figures):
    k = np.arange(1, 81)
    axes = figures["training"].axes
    expected = (1 - 3 * np.exp(-k / 15), 100 * (1 - np.exp(-k / 20)), 50 * np.exp(-k / 12) + 0.8)
    for one, values in zip(axes, expected, strict=True):
        np.testing.assert_allclose(one.lines[0].get_xdata(), 16384 * k / 1e6)
        np.testing.assert_allclose(one.lines[0].get_ydata(), values)
