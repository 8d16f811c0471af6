"""Comparing structures of a twin on joints that it predicts without any loss."""

import numpy as np

from rejoint.twin.structure import _ratio


def test_joints_that_stand_still_compare_as_equal():
    assert _ratio(np.zeros(3), np.zeros(3)) == 1.0
    assert _ratio(np.array([0.0, 8.0, 2.0]), np.array([0.0, 1.0, 2.0])) == 2.0
