"""Hand-worked numbers of ISO 9283 and ISO 230-2."""

import numpy as np
import pytest

from rejoint.control.comparison.protocols import reversal
from rejoint.control.comparison.result import position_repeatability

CROSS = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])


def test_repeatability_adds_three_standard_deviations():
    places = np.array([[-3.0, 0, 0], [0, 0, 0], [3, 0, 0]])  # distances 3, 0, 3: mean 2, deviation sqrt(3)
    assert position_repeatability(places) == pytest.approx(2.0 + 3.0 * np.sqrt(3.0))


def test_one_cycle_has_no_repeatability():
    assert np.isnan(position_repeatability(CROSS[:1]))


def test_repeatability_of_equal_distances_is_that_distance_pose_by_pose():
    both = np.stack([CROSS, 2 * CROSS])
    np.testing.assert_allclose(position_repeatability(both), [1.0, 2.0])


def test_reversal_is_the_play_between_two_sides():
    assert reversal(CROSS + np.array([0.5, 0, 0]), CROSS - np.array([0.5, 0, 0])) == pytest.approx(1.0)
