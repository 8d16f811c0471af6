import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from modelfiles import ur5e
from rejoint.arms import gravity_torque, heights, mycobot280
from rejoint.control.controllers.feedforward import CommandLaw
from rejoint.control.controllers.policy import PolicyController
from rejoint.control.guard import GuardLimits, guard
from rejoint.training.ranges import BroadRanges
from rejoint.training.task import DEFAULT, ReachTask, TaskSettings, residual_reward
from rejoint.training.train import know_stiffness
from rejoint.twin.parameters import RUBBING, nominal_parameters
from rejoint_lab.research.reproduction.campaign import PAPER, PaperRanges, PaperTask, paper_reward
from standin import inputs_of, state_of

ARM = mycobot280()


GOAL = CommandLaw(anchor="goal", stiffness=(6.0,) * 6, loosen=0.0)


def make(agents=8, settings=TaskSettings(law=GOAL), seed=1, **ranges):  # noqa: B008 - frozen
    return ReachTask(ARM, BroadRanges(arm=ARM, **ranges), agents, settings, seed=seed)


class Scripted(PolicyController):
    """Deployment code with a network that plays back actions."""

    def __init__(self, actions, law=GOAL):
        contract = type("Contract", (), {"layout": "residual", "law": law})()
        super().__init__(ARM, None, contract)
        self.actions, self.seen = iter(actions), []

    def act(self, observation):
        self.seen.append(observation.copy())
        return np.clip(next(self.actions), -1.0, 1.0)


@pytest.mark.parametrize("law", [replace(GOAL, authority_floor=0.003), CommandLaw()], ids=["goal", "measured"])
def test_training_and_deployment_see_and_command_the_same_bit_for_bit(law):
    rng = np.random.default_rng(2)
    actions = rng.normal(0.0, 0.8, (25, 6, 6)).astype(np.float32).astype(float)
    task = make(agents=6, settings=TaskSettings(hold_steps=10**9, law=law))
    observation, _ = task.reset()
    controller, limits = Scripted(actions, law), GuardLimits.of(ARM).of_simulation()
    sent = task._sent.copy()
    for cycle, action in enumerate(actions):
        state = state_of(task.simulation.measured.copy(), task.simulation.time.copy())
        now = inputs_of(state, task._aim.copy(), task._goal.copy(), sent, task._since.copy())
        if cycle == 0:
            controller.reset(now, np.ones(6, dtype=bool))
        wanted = controller.command(now)
        sent = guard(limits, wanted, sent, 0 * sent, state, task._period.copy()).command
        np.testing.assert_array_equal(controller.seen[-1], observation)
        observation = task.step(action).observation
        np.testing.assert_array_equal(task._sent, sent)


def test_in_training_an_action_tells_something_at_the_target_too():
    assert GOAL.authority_floor == 0.0 < make().commander.law.authority_floor


@pytest.mark.parametrize("make_arm", [mycobot280, ur5e])
def test_targets_anywhere_are_such_that_the_motors_lift_them_and_the_way_is_clear(make_arm):
    arm, share = make_arm(), 0.6
    ranges = BroadRanges(
        arm=arm, weak_joints=0.0, coulomb=(0.0, 0.0), torque_limit=(share, share), gravity_scale=(1.0, 1.0)
    )
    task = ReachTask(arm, ranges, 200, TaskSettings(anywhere=1.0), seed=1)
    task.reset()
    goal, lifted = task._goal, share * nominal_parameters(arm).torque_limit / (1.0 + RUBBING)
    assert (np.abs(gravity_torque(arm, goal)) < lifted).all(axis=-1).mean() > 0.95
    ways = arm.rest + np.linspace(0.0, 1.0, 20)[:, None, None] * (goal - arm.rest)
    assert (heights(arm, ways)[..., 1:] > 0.0).all(axis=(0, -1)).mean() > 0.95


@pytest.mark.parametrize("make_arm", [mycobot280, ur5e])
def test_the_untrained_law_comes_to_rest_on_the_arms_that_are_drawn(make_arm):
    arm = make_arm()
    ranges = BroadRanges(arm=arm, weak_joints=0.0, coulomb=(0.0, 0.0))
    settings = know_stiffness(DEFAULT, arm, None).task
    task = ReachTask(arm, ranges, 60, dataclasses.replace(settings, anywhere=0.0, targets=1), seed=1)
    task.reset(staggered=False)
    for _ in range(settings.hold_steps):
        transition = task.step(np.zeros((60, arm.joints)))
    assert np.median(transition.distance) < 0.010


def test_a_new_target_begins_as_a_deployed_reset_does():
    task = make(agents=5, settings=TaskSettings(hold_steps=4, targets=1000))
    task.reset()
    for _ in range(3):
        transition = task.step(np.full((5, 6), 0.3))
    ended = transition.truncated
    while not ended.any():
        transition = task.step(np.full((5, 6), 0.3))
        ended = transition.truncated
    controller = Scripted([np.zeros((5, 6))])
    state = state_of(task.simulation.measured, task.simulation.time)
    now = inputs_of(state, task._aim, task._goal, task._sent, task._since)
    controller.reset(now, np.ones(5, dtype=bool))
    controller.command(now)
    kept = np.ones(controller.seen[0].shape[1], dtype=bool)
    kept[56] = False  # the period of the wire, which a controller that has only begun does not know
    np.testing.assert_array_equal(controller.seen[0][ended][:, kept], transition.observation[ended][:, kept])
    assert (transition.observation[ended] != transition.final_observation[ended]).any(axis=1).all()
    np.testing.assert_array_equal(transition.observation[~ended], transition.final_observation[~ended])


def test_measurements_are_old_and_quantised():
    settings = TaskSettings(hold_steps=10**9, jitter=0.0)
    task = make(agents=3, settings=settings, readback_delay=(0.020, 0.020), period=(0.020, 0.020))
    task.reset()
    before = task.simulation.twins.qpos.copy()
    for _ in range(10):
        task.step(np.full((3, 6), 0.5))
        # Exactly one period old: the positions at the end of the cycle before, in encoder steps.
        counts = task.simulation.measured / ARM.encoder_step
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
        assert np.abs(task.simulation.measured - before).max() <= 0.5 * ARM.encoder_step + 1e-12
        before = task.simulation.twins.qpos.copy()


def test_every_agent_has_its_own_period():
    task = make(agents=200, settings=TaskSettings(hold_steps=10**9))
    task.reset()
    periods = []
    for _ in range(30):
        before = task.simulation.time.copy()
        task.step(np.zeros((200, 6)))
        np.testing.assert_allclose(task.simulation.time - before, task._period)
        np.testing.assert_allclose(task.simulation.twins.timestep * 6, task._period)
        periods.append(task._period.copy())
    periods = np.array(periods)
    assert periods.min() >= 0.018
    assert periods.max() <= 0.055
    assert np.ptp(periods.mean(axis=0)) > 0.025  # between agents
    assert (np.ptp(periods, axis=0) / periods.mean(axis=0) > 0.1).all()  # within an agent


def test_targets_end_as_time_outs_and_arms_are_exchanged_after_three():
    task = make(agents=40, settings=TaskSettings(hold_steps=5, targets=3))
    task.reset()
    exchanged = np.zeros(40, dtype=int)
    for _ in range(30):
        delay = task.simulation.latency.command_delay.copy()
        transition = task.step(np.zeros((40, 6)))
        assert not transition.terminated.any()
        changed = task.simulation.latency.command_delay != delay
        assert (transition.truncated | ~changed).all()
        exchanged += changed
    assert (exchanged == 2).all()  # 30 cycles are two episodes of 15, wherever an agent began


def test_residual_reward_worked_by_hand():
    got = residual_reward(np.array([0.0, 0.003, 1.0]), np.array([0.0, 0.2, 5.0]), np.zeros((3, 6)))
    near = -0.03 + 0.4 * np.exp(-0.3) + 0.5 * np.exp(-1.0) + 0.4 * np.exp(-3.0) - 0.04 * np.exp(-0.15)
    np.testing.assert_allclose(got, [1.3, near, -1.0], atol=1e-6)
    effort = residual_reward(np.zeros(1), np.zeros(1), np.array([[0.5, -1.0, 9.0, 0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(effort, 1.3 - 0.02 * (0.25 + 1.0 + 2.0))


def test_paper_reward_worked_by_hand():
    no, yes = np.array([False]), np.array([True])
    speed = np.array([[0.6, -0.6, 0.0, 0.0, 0.0, 0.0]])
    distance = np.array([0.07])
    np.testing.assert_allclose(paper_reward(distance, speed, no, no, no), -0.7 - 0.02)
    np.testing.assert_allclose(paper_reward(distance, speed, yes, no, yes), -0.72 - 10.0 - 5.0)
    np.testing.assert_allclose(paper_reward(np.array([0.004]), 0 * speed, no, yes, no), -0.04 + 10.0)


def test_the_paper_s_episode_ends_with_success():
    task = PaperTask(ARM, PaperRanges(arm=ARM, joint_noise=0.0), 64, PAPER.task, seed=0)
    observation, _ = task.reset()
    assert observation.shape == (64, 28)
    reached = np.zeros(64, dtype=int)
    for _ in range(60):
        transition = task.step(np.zeros((64, 6)))
        reached += transition.terminated
        assert (transition.distance[transition.terminated] < 0.005).all()
        assert (transition.reward[transition.terminated] > 8.0).all()
    assert (reached > 0).mean() > 0.2  # the stiffer arms reach targets below them without any policy
