"""What the stages are given: nearly right values are refused with their name, not taken for something else."""

from functools import partial

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.arms.inertia import loaded
from rejoint.robots import open_robot
from rejoint.system.errors import InputError

WORN = "emulated:worn"
TARGET = [[0.17, 0.0, 0.2]]
TIME, MOTION = np.arange(50) * 0.03, np.zeros((50, 6))


@pytest.mark.parametrize("seed", [-1, 1.5, "3", float("nan")])
@pytest.mark.parametrize("make", [partial(open_robot, WORN), rejoint.Settings])
def test_a_seed_is_a_whole_number_from_zero_on(make, seed):
    with pytest.raises(InputError, match="expected a whole number from 0 on"):
        make(seed=seed)


@pytest.mark.parametrize("period", [0.03, (0.03,), (20, 30), (0.05, 0.02), (0, 0), (np.nan, 1), "30", ("a", "b")])
def test_a_period_is_two_times_in_seconds(period):
    with pytest.raises(InputError, match="period"):
        open_robot(WORN, period=period)
    with pytest.raises(InputError, match="period"):
        rejoint.deploy(WORN, TARGET, settings=rejoint.Settings(controller="default", period=period))


def test_a_payload_may_be_any_number():
    masses = [loaded(mycobot280(), kilograms).mass for kilograms in (0.25, np.float32(0.25), np.float64(0.25))]
    np.testing.assert_array_equal(masses[0], masses[1])
    np.testing.assert_array_equal(masses[0], masses[2])
    with pytest.raises(InputError, match=r"tool: expected a point \(3,\) in metres, found text"):
        loaded(mycobot280(), tool=["0", "0", "0.1"])


@pytest.mark.parametrize(("factor", "said"), [(1e3, "30 s apart"), (1e9, r"3e\+07 s apart")])
def test_times_of_another_unit_are_refused(factor, said):
    log = rejoint.RunLog.of(factor * TIME, MOTION, MOTION, arm="mycobot280")
    with pytest.raises(InputError, match=f"its rows are {said}; give times in seconds"):
        rejoint.diagnose(log)
