"""Known truth: the fit finds the parameters that made a log, and says how well it knows them."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import load_arm
from rejoint.diagnosis.excitation import record
from rejoint.robots import open_robot
from rejoint.twin.fit import Problem, fit, limiting
from rejoint.twin.identify import identify
from rejoint.twin.parameters import number, pack, prior
from rejoint.twin.replay import Replay, cut


@pytest.fixture(scope="session")
def twin(arm, log):
    return identify(arm, [log])


def test_fit_finds_the_truth(twin, truth):
    found, loaded = twin.parameters, [1, 2]  # the joints that gravity loads have a scale of their own
    np.testing.assert_allclose(found.stiffness[loaded], truth.stiffness[loaded], rtol=0.15)  # by the starts
    np.testing.assert_allclose(found.coulomb[loaded], truth.coulomb[loaded], rtol=0.15)
    np.testing.assert_allclose(found.damping / found.stiffness, truth.damping / truth.stiffness, rtol=0.15)
    np.testing.assert_allclose(found.offset, truth.offset, atol=np.radians(0.4))
    assert found.delay == pytest.approx(float(truth.delay), abs=0.002)
    assert found.ramp_speed == pytest.approx(float(truth.ramp_speed), rel=0.05)


def test_held_out_motion_decides(twin, log):
    held = twin.held_out
    assert held.twin.joint < 0.1 * held.healthy_twin.joint
    assert held.twin.tcp < 5e-4
    assert held.seconds + twin.fit_seconds == pytest.approx(log.time[-1] - log.time[0], abs=0.5)


def test_drawn_twins_have_the_covariance_and_keep_the_bounds(twin, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("rejoint.twin.twin.LEAST_SPREAD", 0.0)
        drawn = pack(replace(twin).sample(np.random.default_rng(0), 4000))
    assert (drawn >= twin.lower - 1e-12).all()
    assert (drawn <= twin.upper + 1e-12).all()
    inside = (pack(twin.parameters) - 4 * np.sqrt(np.diag(twin.covariance)) > twin.lower) & twin.identified
    inside &= pack(twin.parameters) + 4 * np.sqrt(np.diag(twin.covariance)) < twin.upper
    assert inside.sum() >= 10
    expected = twin.covariance[np.ix_(inside, inside)]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(drawn[:, inside].T) / scale, expected / scale, atol=0.08)


def test_block_jacobian_is_the_slope_of_each_joints_own_prediction(arm, truth, log):
    problem = Problem(Replay(arm, cut([log], 6.0)), prior(arm))
    problem.steps[:] *= 0.2  # so that the finite difference itself is small beside what is compared
    x, up = pack(truth), np.ones(len(pack(truth)))
    base = problem.residuals(x[None])[0]
    jacobian = problem.jacobian(base, problem.residuals(problem.perturbations(x, up)), up)
    tried = ((0, "stiffness"), (1, "stiffness"), (2, "coulomb"), (4, "damping"), (3, "offset"))
    for joint, name in tried:
        alone, parameter = x.copy(), number(name)
        element = parameter * arm.joints + joint
        alone[element] += problem.steps[element]
        slope = (problem.residuals(alone[None])[0] - base)[:, joint] / problem.steps[element]
        ours = jacobian[:, joint, parameter]
        assert np.linalg.norm(ours - slope) < 0.35 * np.linalg.norm(slope)  # the rest is other joints' pull


def test_descent_never_gains_by_leaving_the_optimum(arm, truth, log):
    problem = Problem(Replay(arm, cut([log], 6.0)[:3]), prior(arm))
    found = fit(problem, pack(truth), iterations=3)
    residuals = problem.residuals(np.vstack([pack(truth), found.vector]))
    _, costs = problem.costs(np.vstack([pack(truth), found.vector]), residuals, problem.weights(residuals[1]))
    assert costs[1] <= costs[0] + 0.5


def test_worn_motors_are_not_called_stronger_than_they_are():
    arm = replace(load_arm("wx250s"), name="stranger")
    robot = open_robot("emulated:worn?seed=3", arm=arm)
    found, worn = identify(arm, [record(robot, seed=0)[0].excitation]), robot.plant.joints
    low = found.interval[0].torque_limit / found.parameters.stiffness
    assert (low < 1.3 * worn["torque_limit"] / worn["position_gain"]).all()


def test_a_torque_limit_that_explains_no_motion_is_not_claimed(arm, log, truth):
    weak = replace(truth, torque_limit=0.6 * truth.torque_limit)
    for twin, reached in ((weak, True), (replace(truth, torque_limit=np.full(arm.joints, 3.0)), False)):
        moved = replace(log, position=Replay(arm, cut([log], 100.0)).predict(twin.repeat(1))[0])
        found = limiting(Problem(Replay(arm, cut([moved], 6.0)), prior(arm)), pack(twin))
        assert found[[1, 2]].all() == reached
        assert found.any() == reached
