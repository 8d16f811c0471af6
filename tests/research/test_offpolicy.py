from pathlib import Path

import numpy as np
import pytest
import torch

from rejoint.arms import mycobot280
from rejoint.control.policy import load_policy
from rejoint.research.offpolicy import ALGORITHMS, OffPolicySettings, algorithm, noise_at, train_offpolicy
from rejoint.system.errors import InputError
from rejoint.training.actorcritic import ActionCritic, BoundedActor, SquashedActor
from rejoint.training.export import policy_graph

ARM = mycobot280()


def quick(name: str, **changes: float) -> OffPolicySettings:
    return OffPolicySettings(
        algorithm=algorithm(name), cycles=6, memory=8, warm_up=2, batch=16, agents=8, threads=1, **changes
    )


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_leaves_a_policy_that_loads(name, tmp_path: Path):
    result = train_offpolicy(ARM, None, out=tmp_path, settings=quick(name, seed=3))
    controller = load_policy(result.policy, ARM)
    assert (controller.contract.preset, controller.contract.seed) == (name, 3)
    assert result.steps == 6 * 8
    assert np.isfinite(result.reward)


def test_a_training_is_a_function_of_its_seed(tmp_path: Path):
    policies = []
    for folder, seed in (("a", 1), ("b", 1), ("c", 2)):
        train_offpolicy(ARM, None, out=tmp_path / folder, settings=quick("td3", seed=seed))
        policies.append(load_policy(tmp_path / folder / "policy.onnx", ARM))
    x = np.random.default_rng(0).normal(size=(5, policies[0].contract.observation_size)).astype(np.float32)
    np.testing.assert_array_equal(policies[0].act(x), policies[1].act(x))
    assert np.abs(policies[0].act(x) - policies[2].act(x)).max() > 1e-6


def test_the_squashed_density_integrates_to_one():
    # One joint: the density of the action over (-1, 1) from samples' log-probabilities, by importance weighting.
    torch.manual_seed(0)
    actor = SquashedActor(3, 1, (8,))
    with torch.no_grad():
        actor.mean.bias.fill_(0.4)
        actor.log_std.bias.fill_(0.0)
        action, outputs = actor.act({"observations": torch.zeros(200_000, 3)})
    # E[1 / p(a)] over the policy's own actions is the length of the interval they live in
    weights = torch.exp(-outputs["log_prob"])
    assert float(weights[action.abs() < 0.9].sum() / len(action)) == pytest.approx(1.8, rel=0.02)


@pytest.mark.parametrize("kind", [BoundedActor, SquashedActor])
def test_the_exported_network_is_the_mean_policy(kind):
    import onnxruntime as ort

    actor, x = kind(10, 6, (16, 8)), np.random.default_rng(1).normal(size=(7, 10)).astype(np.float32)
    session = ort.InferenceSession(policy_graph(actor.network(), 10, 6).SerializeToString())
    mean, _ = actor.compute({"observations": torch.from_numpy(x)})
    mean = mean if kind is BoundedActor else torch.tanh(mean)
    np.testing.assert_allclose(session.run(None, {"observation": x})[0], mean.detach().numpy(), atol=1e-6)


def test_an_untrained_actor_leaves_the_classical_law_alone():
    for actor in (BoundedActor(10, 6, (16, 8)), SquashedActor(10, 6, (16, 8))):
        with torch.no_grad():
            assert float(actor.network()(torch.randn(100, 10)).abs().max()) < 0.05


def test_the_critic_sees_action_and_privileged_observation():
    critic = ActionCritic(4, 3, 2, (8,))
    parts = {"observations": torch.zeros(1, 4), "states": torch.zeros(1, 3), "taken_actions": torch.zeros(1, 2)}
    before = critic.compute(parts)[0].item()
    for name, size in (("states", 3), ("taken_actions", 2)):
        assert critic.compute(parts | {name: torch.ones(1, size)})[0].item() != before


def test_the_noise_falls_to_its_end():
    settings = OffPolicySettings(algorithm="td3", cycles=100, noise=(0.3, 0.1))
    assert [round(noise_at(settings, cycle), 3) for cycle in (0, 50, 100, 200)] == [0.3, 0.2, 0.1, 0.1]


def test_unknown_learners_are_refused():
    with pytest.raises(InputError, match="sac, td3, ddpg"):
        algorithm("a3c")
