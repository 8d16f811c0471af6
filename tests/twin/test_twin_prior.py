"""What is believed of an arm before any data goes with its size, by the dimensions of the quantities."""

import dataclasses

import numpy as np
import pytest

from modelfiles import resized
from rejoint.arms import gravity_torque, mycobot280, so101
from rejoint.logs.runlog import RunLog
from rejoint.twin.fit import Problem
from rejoint.twin.parameters import (
    Layout,
    healthy_parameters,
    nominal_parameters,
    unknown_prior,
)
from rejoint.twin.replay import Replay, cut

ARM = mycobot280()


@pytest.mark.parametrize(("length", "mass"), [(2.0, 8.0), (0.5, 0.4)])
def test_the_prior_of_a_resized_arm_has_the_dimensions_of_its_quantities(length, mass):
    other, torque, time = resized(ARM, length, mass), length * mass, length**0.5
    for believed in (nominal_parameters, healthy_parameters):
        old, new = believed(ARM), believed(other)
        for name in ("stiffness", "coulomb", "torque_limit"):
            np.testing.assert_allclose(getattr(new, name), torque * getattr(old, name), rtol=1e-9)
        np.testing.assert_allclose(new.damping, torque * time * old.damping, rtol=1e-9)
        np.testing.assert_allclose(new.armature, torque * length * old.armature, rtol=1e-9)
        assert (new.delay, new.ramp_speed) == (old.delay, old.ramp_speed)
        sag = [gravity_torque(arm, ARM.rest) / twin.stiffness for arm, twin in ((ARM, old), (other, new))]
        np.testing.assert_allclose(sag[1], sag[0], rtol=1e-9, atol=1e-15)


def test_costs_of_a_joint_and_of_its_group_are_those_of_moving_them():
    """Alone, the total changes by the joint's own cost; together, by the group's; groups do not know of one another."""
    arm = dataclasses.replace(so101(), servos=("big", "big", "", "big", "small"))
    time = np.arange(0.0, 3.0, 0.02)
    path = 0.1 * np.sin(time)[:, None] * np.ones(5)
    log = RunLog.of(time, path, path, arm=arm)
    problem = Problem(Replay(arm, [log], cut([log], 3.0), 0.01, 1), unknown_prior(arm))
    np.testing.assert_array_equal(problem.group, [0, 0, 2, 0, 4])
    rng, layout = np.random.default_rng(0), Layout(5)
    base = problem.prior.mean + 0.3 * problem.prior.sigma * rng.standard_normal(layout.size)
    moved, residuals = np.tile(base, (3, 1)), 1e-3 * rng.standard_normal((3, len(time), 5))
    weights = problem.weights(residuals[0])
    of_one, of_group = layout.owner == 1, np.isin(layout.owner, [0, 1, 3])
    for row, own, joints in ((1, of_one, [1]), (2, of_group, [0, 1, 3])):
        moved[row, own] += 0.2 * rng.standard_normal(own.sum())
        residuals[row][:, np.setdiff1d(range(5), joints)] = residuals[0][:, np.setdiff1d(range(5), joints)]
    alone, grouped, total = problem.costs(moved, residuals, weights)
    assert total[1] - total[0] == pytest.approx(alone[1, 1] - alone[0, 1])
    assert total[1] - total[0] == pytest.approx(grouped[1, 3] - grouped[0, 3])
    assert total[2] - total[0] == pytest.approx(grouped[2, 0] - grouped[0, 0])
    assert grouped[2, 2] == pytest.approx(grouped[0, 2])
    assert abs(alone[2, [0, 1, 3]].sum() - alone[0, [0, 1, 3]].sum() - (total[2] - total[0])) > 0.1  # they are coupled
