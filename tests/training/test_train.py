import dataclasses

import numpy as np
import onnxruntime as ort
import pyarrow.parquet as pq
import torch

from rejoint.arms import mycobot280
from rejoint.control.controllers.feedforward import CommandLaw
from rejoint.control.controllers.policy import INPUT, OUTPUT, load_policy
from rejoint.logs.runfolder import RunFolder
from rejoint.training.learner import Actor, Critic, Learner, Ppo, perceptron
from rejoint.training.ranges import BroadRanges
from rejoint.training.task import DEFAULT, PpoSettings, ReachTask, TaskSettings
from rejoint.training.train import TrainingOptions, policy_graph, train

ARM = mycobot280()
SMALL = dataclasses.replace(
    DEFAULT,
    task=TaskSettings(hold_steps=8),
    ppo=PpoSettings(rollout=8, iterations=6, mini_batches=2, epochs=2, actor_layers=(16,), critic_layers=(16,)),
)


def options(**changes):
    return dataclasses.replace(TrainingOptions(preset=SMALL, agents=16), **changes)


def test_a_training_leaves_a_policy_that_drives_and_its_curves(tmp_path):
    seen = []
    result = train(ARM, None, out=tmp_path, options=options(), on_progress=lambda *report: seen.append(report))
    assert [share for share, _ in seen] == [k / 6 for k in range(1, 7)]
    assert all("success" in text and "mm" in text for _, text in seen)
    controller = load_policy(result.policy, ARM)
    assert (controller.contract.preset, controller.contract.seed) == ("default", 0)
    assert (controller.contract.min_period, controller.contract.max_period) == (0.018, 0.055)
    rows = pq.read_table(result.curves).to_pylist()
    assert [row["step"] for row in rows] == [16 * 8 * k for k in range(1, 7)]
    assert result.steps == rows[-1]["step"]
    assert all(np.isfinite(list(row.values())).all() for row in rows)
    assert sorted(path.name for path in RunFolder(tmp_path).training.glob("*.p*")) == ["curves.parquet"]


def test_a_training_is_a_function_of_its_seed(tmp_path):
    policies = [
        train(ARM, None, out=tmp_path / name, options=options(iterations=2, seed=seed)).policy.read_bytes()
        for name, seed in (("a", 5), ("b", 5), ("c", 6))
    ]
    assert policies[0] == policies[1] != policies[2]


def test_exported_network_agrees_with_the_trained_one():
    torch.manual_seed(0)
    network = perceptron((50, 128, 64, 6))
    session = ort.InferenceSession(policy_graph(network, 50).SerializeToString())
    observations = np.random.default_rng(0).normal(0.0, 3.0, (500, 50)).astype(np.float32)
    with torch.no_grad():
        expected = network(torch.from_numpy(observations)).clamp(-1.0, 1.0).numpy()
    got = session.run((OUTPUT,), {INPUT: observations})[0]
    assert np.abs(got - expected).max() <= 1e-5
    assert (np.abs(expected) < 1.0).mean() > 0.5  # the clip does not hide the comparison


def test_the_density_of_actions_is_that_of_the_noise():
    torch.manual_seed(0)
    actor = Actor(5, 3, (8,), -0.7)
    observation = torch.randn(1, 5)
    draws = [actor.sample(observation, torch.Generator().manual_seed(seed)) for seed in range(4000)]
    actions, densities = (torch.cat(parts).detach() for parts in zip(*draws, strict=True))
    with torch.no_grad():
        normal = torch.distributions.Normal(actor.net(observation), actor.log_std.exp())
        told = actor.act({"observations": observation, "taken_actions": actions}, role="policy")[1]["log_prob"]
        assert torch.allclose(told[:, 0], normal.log_prob(actions).sum(dim=-1), atol=1e-5)
        assert torch.allclose(told[:, 0], densities, atol=1e-5)
    np.testing.assert_allclose(actions.std(dim=0).numpy(), np.exp(-0.7), rtol=0.05)


def rollout(cycles, agents, **tensors):
    """A rollout of zeros but for what is given."""
    shape = (cycles, agents)
    zeros = {name: torch.zeros(shape) for name in ("log_prob", "values", "final_value", "reward", "distance")}
    zeros |= {name: torch.zeros(shape, dtype=torch.bool) for name in ("terminated", "truncated")}
    vectors = ("observations", "states", "actions", "observation", "privileged")
    return zeros | {name: torch.zeros((*shape, 2)) for name in vectors} | tensors


def returns(seen, next_value, **changes):
    """Taught returns less values (T, N), where the critic gives ``next_value`` to the state after the last."""
    settings = dataclasses.replace(SMALL.ppo, rollout=len(seen["reward"]), mini_batches=1, **changes)
    critic = Critic(2, 2, 2, (4,))
    with torch.no_grad():
        for parameter in critic.net.parameters():
            parameter.zero_()
        critic.net[-1].bias.fill_(next_value)
    ppo = Ppo(Actor(2, 2, (4,), -0.7), critic, settings, agents=seen["reward"].shape[1])
    ppo.learn(seen, 1e-3)
    return ppo.memory.get_tensor_by_name("returns")[..., 0] - seen["values"]


def test_advantages_worked_by_hand():
    # One agent, three cycles; after the second one the target times out in a state of value 4.
    column = lambda *values: torch.tensor(values)[:, None]  # noqa: E731
    seen = rollout(
        3,
        1,
        reward=column(1.0, 2.0, 3.0),
        truncated=column(False, True, False),
        values=column(10.0, 20.0, 30.0),
        final_value=column(0.0, 4.0, 0.0),
    )
    got = returns(seen, 8.0, discount=0.5, gae_lambda=0.8, reward_scale=2.0)
    third = 6.0 + 0.5 * 8.0 - 30.0
    second = 4.0 + 0.5 * 4.0 - 20.0
    first = 2.0 + 0.5 * 20.0 - 10.0 + 0.5 * 0.8 * second
    np.testing.assert_allclose(got.ravel(), [first, second, third], rtol=1e-6)


def test_time_outs_are_bootstrapped_from_the_state_before_the_new_target():
    task, seen = ReachTask(ARM, BroadRanges(arm=ARM), 16, SMALL.task, seed=0), []
    learner = Learner(task, SMALL.ppo, seed=0)
    step = task.step
    task.step = lambda action: seen.append(step(action)) or seen[-1]
    rolled = learner.roll()
    assert rolled["truncated"].any()
    assert not rolled["terminated"].any()
    for t, n in rolled["truncated"].nonzero().tolist():
        with torch.no_grad():
            value = learner.critic.value(
                *(torch.from_numpy(a[n]) for a in (seen[t].final_observation, seen[t].final_privileged))
            )
        np.testing.assert_allclose(rolled["final_value"][t, n].item(), value.item(), rtol=1e-4)
        assert (seen[t].final_observation[n] != seen[t].observation[n]).any()
    assert not rolled["final_value"][~rolled["truncated"]].any()


def test_learning_improves_the_reward():
    # The same arms and targets before and after: what changes is the policy alone.
    preset = dataclasses.replace(
        DEFAULT,
        task=TaskSettings(hold_steps=40, law=CommandLaw(authority_floor=0.2, authority_limit=0.2)),
        ppo=PpoSettings(rollout=16, iterations=20, actor_layers=(64,), critic_layers=(64,)),
    )
    learner = Learner(ReachTask(ARM, BroadRanges(arm=ARM), 128, preset.task, seed=0), preset.ppo, seed=0)

    def mean_reward():
        task = ReachTask(ARM, BroadRanges(arm=ARM), 128, preset.task, seed=99)
        observation, _ = task.reset()
        rewards = []
        for _ in range(40):
            with torch.no_grad():
                action = learner.actor.net(torch.from_numpy(observation)).numpy()
            transition = task.step(action)
            observation = transition.observation
            rewards.append(transition.reward.mean())
        return float(np.mean(rewards))

    before = mean_reward()
    for _ in range(20):
        learner.iterate()
    assert mean_reward() > before + 0.05
