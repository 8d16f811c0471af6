"""Known truth: the fit finds the parameters that made a log, and says how well it knows them."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.system.errors import InputError
from rejoint.twin.file import read_twin, write_twin
from rejoint.twin.fit import HUBER, Problem, correlation_time, fit, influence, loss
from rejoint.twin.identify import IdentifySettings, identify
from rejoint.twin.parameters import pack, prior
from rejoint.twin.prediction import prediction_error
from rejoint.twin.replay import Replay, cut, divide, predict

QUICK = IdentifySettings(starts=16, iterations=10, threads=1)


@pytest.fixture(scope="session")
def twin(arm, log):
    return identify(arm, [log], QUICK)


def test_prediction_with_the_truth_is_as_good_as_the_encoders(arm, truth, log):
    error = prediction_error(arm, predict(arm, truth, log), log.position)
    assert error.joint < np.radians(0.06)  # an encoder step is 0.088 deg, and answers jitter by 2 ms
    assert error.tcp < 0.5e-3


def test_prediction_hardly_depends_on_the_time_step(arm, truth, log):
    difference = predict(arm, truth, log, 0.0025) - predict(arm, truth, log, 0.005)
    assert np.sqrt(np.mean(difference**2)) < arm.encoder_step


def test_windows_cover_the_logs_without_overlap(log):
    windows = cut([log, log], 6.0)
    for index in (0, 1):
        rows = np.concatenate([np.arange(w.first, w.last) for w in windows if w.log == index])
        np.testing.assert_array_equal(rows, np.arange(len(log)))
    pieces = divide(windows, 80)
    assert sum(p.last - p.first for p in pieces) == 2 * len(log)
    assert {p.last - p.first for p in pieces} <= set(range(60, 110))


def test_fit_finds_the_truth(twin, truth):
    found, loaded = twin.parameters, [1, 2]  # the joints that gravity loads have a scale of their own
    np.testing.assert_allclose(found.stiffness[loaded], truth.stiffness[loaded], rtol=0.03)
    np.testing.assert_allclose(found.coulomb[loaded], truth.coulomb[loaded], rtol=0.15)
    np.testing.assert_allclose(found.damping / found.stiffness, truth.damping / truth.stiffness, rtol=0.15)
    np.testing.assert_allclose(found.offset, truth.offset, atol=np.radians(0.2))
    assert found.delay == pytest.approx(float(truth.delay), abs=0.002)
    assert found.ramp_speed == pytest.approx(float(truth.ramp_speed), rel=0.05)


def test_intervals_hold_the_truth(twin, truth):
    distance = np.abs(pack(truth) - pack(twin.parameters)) / np.sqrt(np.diag(twin.covariance))
    assert np.mean(distance[twin.identified] < 1.96) > 0.9
    assert twin.identified.sum() > 20


def test_what_the_data_cannot_tell_is_named(twin):
    assert "joint6" in twin.unknown_scale  # neither gravity nor inertia on it
    assert "joint2" not in twin.unknown_scale
    assert any("joint6" in note for note in twin.notes)
    assert any(name.startswith("torque_limit") for name in twin.unknown)  # never reached on a light joint


def test_held_out_motion_decides(twin, arm, truth, log):
    held = twin.held_out
    assert held.twin.joint < 0.1 * held.healthy_twin.joint
    assert held.healthy_twin.joint < held.no_twin.joint
    assert held.twin.tcp < 1e-3
    assert held.seconds + twin.fit_seconds == pytest.approx(log.time[-1] - log.time[0], abs=0.5)


def test_drawn_twins_have_the_covariance_and_keep_the_bounds(twin):
    drawn = pack(twin.sample(np.random.default_rng(0), 4000, least_spread=0.0))
    assert (drawn >= twin.lower - 1e-12).all()
    assert (drawn <= twin.upper + 1e-12).all()
    inside = (pack(twin.parameters) - 4 * np.sqrt(np.diag(twin.covariance)) > twin.lower) & twin.identified
    inside &= pack(twin.parameters) + 4 * np.sqrt(np.diag(twin.covariance)) < twin.upper
    assert inside.sum() > 15
    expected = twin.covariance[np.ix_(inside, inside)]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(drawn[:, inside].T) / scale, expected / scale, atol=0.08)
    again = twin.sample(np.random.default_rng(7), 3)
    np.testing.assert_array_equal(again.stiffness, twin.sample(np.random.default_rng(7), 3).stiffness)


def test_identification_survives_its_file(twin, arm, tmp_path):
    write_twin(tmp_path / "twin.toml", twin)
    back = read_twin(tmp_path / "twin.toml", arm)
    assert back.digest() == twin.digest()
    assert back.notes == twin.notes
    np.testing.assert_array_equal(back.covariance, twin.covariance)
    assert back.held_out.twin.tcp == twin.held_out.twin.tcp


def test_block_jacobian_is_the_slope_of_each_joints_own_prediction(arm, truth, log):
    problem = Problem(Replay(arm, [log], cut([log], 6.0), stiction=1.0), prior(arm))
    problem.steps[:] *= 0.2  # so that the finite difference itself is small beside what is compared
    x, up = pack(truth), np.ones(6 * arm.joints + 2)
    base = problem.residuals(x[None])[0]
    jacobian = problem.jacobian(base, problem.residuals(problem.perturbations(x, up)), up)
    for joint, parameter in ((0, 0), (1, 0), (2, 2), (4, 1), (3, 5)):  # two stiffnesses, friction, damping, offset
        alone = x.copy()
        element = parameter * arm.joints + joint
        alone[element] += problem.steps[element]
        slope = (problem.residuals(alone[None])[0] - base)[:, joint] / problem.steps[element]
        ours = jacobian[:, joint, parameter]
        assert np.linalg.norm(ours - slope) < 0.35 * np.linalg.norm(slope)  # the rest is other joints' pull


def test_the_common_scale_of_a_light_joint_leaves_no_trace(arm, truth, log):
    problem = Problem(Replay(arm, [log], cut([log], 6.0)[:4]), prior(arm))
    x, up = pack(truth), np.ones(6 * arm.joints + 2)
    moved = problem.residuals(np.vstack([x, problem.perturbations(x, up)[:2]]))
    trace = np.degrees(np.sqrt(np.mean((moved[1] - moved[0]) ** 2, axis=0)))
    assert trace[5] < 1e-3 < 1e-2 < trace[1]


def test_descent_never_gains_by_leaving_the_optimum(arm, truth, log):
    problem = Problem(Replay(arm, [log], cut([log], 6.0)[:3]), prior(arm))
    found = fit(problem, pack(truth), iterations=3)
    residuals = problem.residuals(np.vstack([pack(truth), found.vector]))
    _, _, costs = problem.costs(np.vstack([pack(truth), found.vector]), residuals, found.weights)
    assert costs[1] <= costs[0] + 0.5


def test_loss_is_square_inside_and_linear_outside():
    r = np.array([0.01 * HUBER, 0.5 * HUBER, 100 * HUBER])
    assert loss(r)[0] == pytest.approx(r[0] ** 2 / 2, rel=1e-4)
    assert loss(r)[2] == pytest.approx(HUBER * r[2], rel=0.02)
    slope = (loss(r + 1e-8) - loss(r - 1e-8)) / 2e-8
    np.testing.assert_allclose(slope, influence(r) * r, rtol=1e-4)


def test_correlation_time_of_an_autoregressive_process():
    rng = np.random.default_rng(0)
    noise, r, a = rng.normal(size=(60000, 1)), np.zeros((60000, 1)), 0.8
    for k in range(1, len(r)):
        r[k] = a * r[k - 1] + noise[k]
    window = np.zeros(len(r), dtype=int)
    assert correlation_time(r, window)[0] == pytest.approx((1 + a) / (1 - a), rel=0.12)
    assert correlation_time(noise, window)[0] == pytest.approx(1.0, abs=0.05)


def test_unusable_logs_are_refused(arm, log):
    other = replace(log, arm="so101")
    with pytest.raises(InputError, match="so101"):
        identify(arm, [other], QUICK)
    short = log.rows(slice(200))
    with pytest.raises(InputError, match="at least 20 s"):
        identify(arm, [short], QUICK)
    rows = int(np.searchsorted(log.time, log.time[0] + 20.6))  # three windows, the fourth would be held out
    close = log.rows(slice(rows))
    with pytest.raises(InputError, match="in 3 windows of about 6 s, expected at least 20 s and 4 windows"):
        identify(arm, [close], IdentifySettings())
