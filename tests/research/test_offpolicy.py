import numpy as np
import pytest
import torch

from rejoint.arms import mycobot280
from rejoint.control.controllers.policy import load_policy
from rejoint.training.train import TrainingOptions, policy_graph, train
from rejoint_lab.research.offpolicy import RECIPE, SacLearner, SquashedActor

ARM = mycobot280()


def test_it_leaves_a_policy_that_loads(tmp_path):
    gains = {"p": (32,) * 6}
    options = TrainingOptions(preset=RECIPE, learner=SacLearner, agents=8, iterations=2, servo_gains=gains, seed=3)
    result = train(ARM, None, out=tmp_path, options=options)
    controller = load_policy(result.policy, ARM)
    contract = controller.contract
    assert (contract.preset, contract.seed, contract.servo_gains) == ("sac", 3, gains)
    assert result.steps == 2 * 32 * 8
    assert np.isfinite(result.reward)


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


def test_the_exported_network_is_the_mean_policy():
    import onnxruntime as ort

    actor, x = SquashedActor(10, 6, (16, 8)), np.random.default_rng(1).normal(size=(7, 10)).astype(np.float32)
    session = ort.InferenceSession(policy_graph(actor.network(), 10).SerializeToString())
    mean = torch.tanh(actor.net(torch.from_numpy(x)))
    np.testing.assert_allclose(session.run(None, {"observation": x})[0], mean.detach().numpy(), atol=1e-6)
