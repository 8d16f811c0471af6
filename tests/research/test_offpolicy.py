import numpy as np
import pytest
import torch

from rejoint.arms import mycobot280
from rejoint.control.controllers.policy import load_policy
from rejoint.training.export import policy_graph
from rejoint_lab.research.offpolicy import ALGORITHMS, BoundedActor, OffPolicySettings, SquashedActor, train_offpolicy

ARM = mycobot280()


def quick(name, **changes):
    return OffPolicySettings(algorithm=name, cycles=6, memory=8, warm_up=2, batch=16, agents=8, threads=1, **changes)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_leaves_a_policy_that_loads(name, tmp_path):
    result = train_offpolicy(ARM, None, out=tmp_path, settings=quick(name, seed=3))
    controller = load_policy(result.policy, ARM)
    assert (controller.contract.preset, controller.contract.seed) == (name, 3)
    assert result.steps == 6 * 8
    assert np.isfinite(result.reward)


def test_a_training_is_a_function_of_its_seed(tmp_path):
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
        actor.net[-1].bias.fill_(0.4)
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
    np.testing.assert_allclose(session.run(None, {"observation": x})[0], mean.detach().numpy(), atol=1e-6)
