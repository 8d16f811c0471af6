"""Masses that are not known: their part in an estimate's covariance is what a fit with other masses would come to."""

import numpy as np
from motion_logs import ARM, TRUTH, problem_of, record, wandering

from rejoint.twin.fit import COMMON, Fit, _central_differences, fit, fixed_covariance, influence, others
from rejoint.twin.fit import STEP as CHANGE
from rejoint.twin.parameters import Layout, pack, unknown_prior
from rejoint.twin.replay import cut
from rejoint.twin.structure import Structure

LAYOUT = Layout(ARM.joints)
LOGS = [record(f"motion{k}", *wandering(k, 10.0)) for k in range(2)]


def problem(arm=ARM):
    return problem_of(Structure(belief=unknown_prior(arm)), cut(LOGS, 8.0), arm)


def test_the_covariance_of_masses_is_how_far_other_masses_move_a_fit():
    here = problem()
    found = fit(here, np.clip(pack(TRUTH), here.prior.lower, here.prior.upper), 3)
    residual, jacobian = _central_differences(here, found.vector)
    weight = here.weights(residual) * influence(residual)
    curvature = here.system(jacobian, weight, residual)[0] + here.prior.precision
    covariance = fixed_covariance(here, found, residual, jacobian, weight, curvature)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12
    assert not covariance[here.frozen].any()
    sigma = np.sqrt(np.diag(covariance))
    lift = LAYOUT.at("stiffness").start + 1
    assert 0.3 * COMMON < sigma[lift] < 3.0 * COMMON
    assert (
        sigma[LAYOUT.at("stiffness").start + 4] < 0.7 * sigma[lift]
    )  # no load on the wrist roll: friction at rest alone
    heavier = next(others(here.replay))[0].arm
    np.testing.assert_allclose(heavier.mass, np.exp(CHANGE) * ARM.mass)
    moved: Fit = fit(problem(heavier), found.vector, 4)
    assert moved.vector[lift] - found.vector[lift] > 0.3 * CHANGE  # heavier links, the same sag: a stiffer servo


def test_each_mass_and_centre_is_moved_once_and_all_masses_together():
    replay = problem().replay
    arms = [other.arm for other, _ in others(replay)]
    heavier = np.array([arm.mass / ARM.mass for arm in arms])
    np.testing.assert_allclose(heavier[0], np.exp(CHANGE))
    np.testing.assert_allclose(heavier[1 : 1 + ARM.joints], 1.0 + np.expm1(CHANGE) * np.eye(ARM.joints))
    np.testing.assert_allclose(heavier[1 + ARM.joints :], 1.0)
    further = [np.linalg.norm(arm.com, axis=1) / np.linalg.norm(ARM.com, axis=1) for arm in arms[1 + ARM.joints :]]
    np.testing.assert_allclose(further, 1.0 + np.expm1(CHANGE) * np.eye(ARM.joints))
