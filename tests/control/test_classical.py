"""Laws of the classical controllers: hand-worked commands, and what integral action must achieve."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import mycobot280, position_kinematics, tcp_position
from rejoint.arms.postures import find_postures
from rejoint.control.controllers import classical
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.controllers.classical import IntegratorController, dls_step, null_space
from rejoint.control.controllers.feedforward import LOOSEN, FeedforwardController, FeedforwardGains
from rejoint.control.loop import Schedule, run
from standin import SaggingArms, inputs_of, state_of

ARM = mycobot280()
TARGETS = ARM.targets.sample(np.random.default_rng(8), (3, 2))
ALL = np.ones(3, dtype=bool)


def inputs(position, *, sent=None, time=0.0):
    target, state = TARGETS[:, 0], state_of(position, time)
    return inputs_of(state, target, find_postures(ARM, target, REST, None), position if sent is None else sent, time)


REST = np.tile(ARM.rest, (3, 1))


def final_error(controller, dwell=4.0):
    rec = run(SaggingArms(3), controller, TARGETS, Schedule(dwell=dwell))
    error = np.linalg.norm(tcp_position(ARM, rec.position) - rec.target, axis=-1)
    last = [np.flatnonzero(rec.target_index[:, 0] == k)[-1] for k in range(2)]
    return error[last]


def test_default_sends_the_goal_and_nothing_else():
    controller = make_controller("default", ARM)
    now = inputs(REST)
    controller.reset(now, ALL)
    np.testing.assert_array_equal(controller.command(now), now.goal)
    np.testing.assert_array_equal(controller.command(inputs(REST + 0.2, sent=now.goal, time=5.0)), now.goal)


@pytest.fixture
def no_pull(monkeypatch):
    """The integrator without its pull to rest."""
    monkeypatch.setattr(classical, "REST_GAIN", 0.0)


@pytest.mark.usefixtures("no_pull")
def test_integrator_by_hand():
    sent = REST + 0.05
    command = IntegratorController(ARM).command(inputs(REST, sent=sent))
    tcp, jacobian = position_kinematics(ARM, REST)
    error = TARGETS[:, 0] - tcp
    for b in range(3):
        j = jacobian[b]
        step = np.linalg.solve(j.T @ j + 0.05**2 * np.eye(6), j.T @ error[b])  # the n x n form of equation 11
        step *= min(1.0, np.radians(5.0) / np.abs(step).max())
        distance = np.linalg.norm(error[b])
        np.testing.assert_allclose(command[b], sent[b] + 0.1 * distance / (distance + 0.004) * step, atol=1e-12)


@pytest.mark.usefixtures("no_pull")
def test_integrator_steps_by_the_time_that_passed():
    controller = IntegratorController(ARM)
    moves = []
    for time in (0.0, 0.025, 0.075, 0.075, 9.0):
        moves.append(controller.command(inputs(REST, time=time)) - REST)
    for move, periods in zip(moves, (1, 1, 2, 0, 4), strict=True):  # a long pause counts as 0.1 s
        np.testing.assert_allclose(move, periods * moves[0], atol=1e-12)


def test_integrator_never_leads_by_more_than_its_anti_windup():
    controller = IntegratorController(ARM)
    sent = REST.copy()
    for k in range(400):  # an arm that does not move at all
        sent = controller.command(inputs(REST, sent=sent, time=0.025 * k))
    assert np.abs(sent - REST).max() == pytest.approx(np.radians(15.0))


def test_the_pull_to_rest_leaves_the_tcp_alone():
    q = REST + np.random.default_rng(0).normal(0.0, 0.3, REST.shape)
    seen = dls_step(ARM, q, TARGETS[:, 0])
    motion = null_space(seen.jacobian, ARM.rest - q)
    assert np.abs(motion).max() > 0.05
    np.testing.assert_allclose((seen.jacobian @ motion[..., None])[..., 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(null_space(seen.jacobian, motion), motion, atol=1e-5)


def test_default_misses_by_the_sag_and_integral_action_removes_it():
    default = final_error(make_controller("default", ARM))
    assert (default > 0.01).all()
    for name in ("integrator", "feedforward"):
        assert (final_error(make_controller(name, ARM, stiffness=9.0)) < 5e-4).all(), name


def test_exact_feedforward_leaves_nothing_to_integrate():
    """Where the model is exact the arm settles at the target although nothing is integrated."""
    no_feedback = FeedforwardGains(rate=0.0)
    exact = FeedforwardController(ARM, 6.0, no_feedback, loosen=0.0)
    assert (final_error(exact) < 2e-4).all()
    assert (final_error(FeedforwardController(ARM, 12.0, no_feedback, loosen=0.0)) > 5e-3).all()


def test_feedforward_does_not_push_a_joint_on_its_way():
    controller = FeedforwardController(ARM, gains=FeedforwardGains(forgetting=0.0), loosen=0.0)
    controller.reset(inputs(REST), ALL)
    still = controller.command(inputs(REST, time=0.0))
    pushed = controller.command(inputs(REST, time=0.02)) - still
    assert np.abs(pushed).max() > 1e-3
    way = dls_step(ARM, REST, TARGETS[:, 0]).step
    moving = REST + 0.05 * np.sign(way)  # 2.5 rad/s towards the target
    before = controller.command(inputs(REST, time=0.04))
    after = controller.command(inputs(moving, time=0.06))
    same_way = np.sign(dls_step(ARM, moving, TARGETS[:, 0]).step) == np.sign(way)
    assert same_way.any()
    np.testing.assert_allclose(after[same_way], before[same_way], atol=1e-12)


def test_feedforward_pushes_a_joint_that_sticks_ever_harder_and_takes_that_back_once_it_moves():
    controller, plain = FeedforwardController(ARM), FeedforwardController(ARM, loosen=0.0)
    push, seen = [], inputs(REST)
    for one in (controller, plain):
        one.reset(seen, ALL)
    sent = controller.command(seen), plain.command(seen)
    for k, position in enumerate([REST] * 5 + [REST + 2e-3 * np.sign(dls_step(ARM, REST, TARGETS[:, 0]).step)]):
        seen = inputs(position, time=0.02 * (k + 1))
        sent = tuple(one.command(replace(seen, sent=last)) for one, last in zip((controller, plain), sent, strict=True))
        push.append(np.abs(sent[0] - sent[1]).max())
    assert (np.diff(push[:5]) > 0.9 * 0.02 * LOOSEN).all()
    assert push[5] < 0.2 * push[4]


def test_the_feedforward_winds_nothing_up_that_is_not_sent():
    still = inputs(REST)
    held, free = (FeedforwardController(ARM, gains=FeedforwardGains(fade=1.0)) for _ in range(2))
    commands = []
    for one in (held, free):
        one.reset(still, ALL)
        sent = one.command(still)
        for k in range(1, 200):
            sent = one.command(replace(inputs(REST, time=0.02 * k), sent=REST if one is held else sent))
        commands.append(np.abs(sent - REST).max())
    assert commands[0] < 0.5 * commands[1]


@pytest.mark.usefixtures("no_pull")
def test_the_integrator_moves_with_a_goal_that_moves():
    controller, still = (IntegratorController(ARM) for _ in range(2))
    now = inputs(REST, time=0.025)
    for one in (controller, still):
        one.reset(now, ALL)
        one.command(now)
    later = inputs(REST, time=0.05)
    moved = replace(later, goal=later.goal + 0.02)
    np.testing.assert_allclose(controller.command(moved), still.command(later) + 0.02, atol=1e-12)
