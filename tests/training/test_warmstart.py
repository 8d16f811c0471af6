"""Trainings that begin at the policy from the shelf."""

import numpy as np
import pytest
from test_ranges import make_twin

from rejoint.arms import load_arm
from rejoint.control.controllers.catalogue import shelf_path, shelf_policy
from rejoint.control.controllers.policy import Policy, probe_observations
from rejoint.training.task import DEFAULT
from rejoint.training.train import TrainingOptions, network_weights, train

ARM = load_arm("mycobot280")
FIRST = DEFAULT.warm.critic_first


def options(**changes):
    return TrainingOptions(**{"agents": 8, "iterations": FIRST + 1} | changes)


def answers(path):
    return np.array(Policy.load(path).contract.probe)


@pytest.mark.parametrize("name", ["mycobot280", "so101"])
def test_the_weights_of_a_file_give_the_answers_that_it_records(name):
    policy = shelf_policy(load_arm(name))
    values = probe_observations(policy.contract.observation_size)
    weights = network_weights(policy.content)
    for matrix, more in zip(weights[:-2:2], weights[1:-2:2], strict=True):
        values = values @ matrix.T + more
        values = np.where(values > 0.0, values, np.expm1(values))  # ELU
    values = np.clip(values @ weights[-2].T + weights[-1], -1.0, 1.0)
    np.testing.assert_allclose(values, policy.contract.probe, atol=1e-5)


def test_a_training_on_a_twin_begins_at_the_shelf_and_lets_the_critic_learn_first(tmp_path):
    kept = answers(shelf_path(ARM.name))
    train(ARM, make_twin(), out=tmp_path / "first", options=options(iterations=FIRST))
    np.testing.assert_array_equal(answers(tmp_path / "first" / "policy.onnx"), kept)
    train(ARM, make_twin(), out=tmp_path / "then", options=options())
    moved = np.abs(answers(tmp_path / "then" / "policy.onnx") - kept)
    assert 1e-4 < moved.max() < 0.3
    train(ARM, make_twin(), out=tmp_path / "random", options=options(preset="scratch", iterations=1))
    assert np.abs(answers(tmp_path / "random" / "policy.onnx")).mean() < 0.1  # hardly more than the law alone
