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


def test_cost_of_a_joint_is_that_of_moving_it_alone():
    arm = dataclasses.replace(so101(), servos=("big", "big", "", "big", "small"))
    time = np.arange(0.0, 3.0, 0.02)
    path = 0.1 * np.sin(time)[:, None] * np.ones(5)
    log = RunLog.of(time, path, path, arm=arm)
    problem = Problem(Replay(arm, cut([log], 3.0), 0.01), unknown_prior(arm))
    rng, layout = np.random.default_rng(0), Layout(5)
    base = problem.prior.mean + 0.3 * problem.prior.sigma * rng.standard_normal(len(layout.kind))
    moved, residuals = np.tile(base, (2, 1)), 1e-3 * rng.standard_normal((2, len(time), 5))
    own = layout.owner == 1
    moved[1, own] += 0.2 * rng.standard_normal(own.sum())
    residuals[1][:, [0, 2, 3, 4]] = residuals[0][:, [0, 2, 3, 4]]
    alone, total = problem.costs(moved, residuals, problem.weights(residuals[0]))
    assert total[1] - total[0] == pytest.approx(alone[1, 1] - alone[0, 1])
