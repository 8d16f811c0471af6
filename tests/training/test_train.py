import dataclasses
import sys

import numpy as np
import onnx
import onnxruntime as ort
import pyarrow.parquet as pq
import pytest
import torch
from onnx import numpy_helper
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

from rejoint.arms import mycobot280
from rejoint.control.contract import INPUT, OUTPUT
from rejoint.control.policy import load_policy
from rejoint.logs.runfolder.outputs import Outputs
from rejoint.system.errors import FileError, InputError
from rejoint.training.export import policy_graph
from rejoint.training.learner import Learner
from rejoint.training.networks import Actor, Critic, perceptron
from rejoint.training.ppo import Ppo, Rollout, join
from rejoint.training.presets import DEFAULT, PAPER, PpoSettings, load_preset
from rejoint.training.ranges import BroadRanges
from rejoint.training.task import ReachTask, TaskSettings
from rejoint.training.train import TrainingOptions, train

ARM = mycobot280()
SMALL = dataclasses.replace(
    DEFAULT,
    task=TaskSettings(hold_steps=8),
    ppo=PpoSettings(rollout=8, iterations=6, mini_batches=2, epochs=2, actor_layers=(16,), critic_layers=(16,)),
)


def options(**changes) -> TrainingOptions:
    return dataclasses.replace(TrainingOptions(preset=SMALL, agents=16, threads=1, checkpoint_every=2), **changes)


def small_learner(seed=0, **ppo) -> Learner:
    tasks = [ReachTask(ARM, BroadRanges(arm=ARM), 8, SMALL.task, seed=seed + k) for k in range(2)]
    return Learner(tasks, dataclasses.replace(SMALL.ppo, **ppo), seed=seed)


def weights(network) -> np.ndarray:
    return np.concatenate([p.detach().numpy().ravel() for p in network.parameters()])


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
    assert sorted(path.name for path in Outputs(tmp_path).folder.glob("*.p*")) == ["curves.parquet"]


def test_tensorboard_shows_the_curves(tmp_path):
    result = train(ARM, None, out=tmp_path, options=options(iterations=2))
    events = EventAccumulator(str(Outputs(tmp_path).folder)).Reload()
    rewards = [(event.step, event.value) for event in events.Scalars("training/reward")]
    rows = pq.read_table(result.curves).to_pylist()
    assert [step for step, _ in rewards] == [row["step"] for row in rows]
    np.testing.assert_allclose([value for _, value in rewards], [row["reward"] for row in rows], rtol=1e-6)


def test_a_training_is_a_function_of_its_seed(tmp_path):
    policies = [
        train(ARM, None, out=tmp_path / name, options=options(iterations=2, seed=seed)).policy.read_bytes()
        for name, seed in (("a", 5), ("b", 5), ("c", 6))
    ]
    assert policies[0] == policies[1] != policies[2]


def test_the_policy_does_not_depend_on_the_number_of_threads(tmp_path):
    policies = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        result = train(ARM, None, out=tmp_path / str(threads), options=options(agents=512, threads=threads))
        policies.append(result.policy.read_bytes())
    assert policies[0] == policies[1]


def test_workers_leave_python_s_switching_as_they_found_it():
    before, seen = sys.getswitchinterval(), []
    task = ReachTask(ARM, BroadRanges(arm=ARM), 4, SMALL.task, seed=0)
    learner, step = Learner([task], SMALL.ppo, seed=0), task.step
    task.step = lambda action: seen.append(sys.getswitchinterval()) or step(action)
    learner.iterate()
    assert max(seen) < before
    assert sys.getswitchinterval() == before


class InterruptedTrainingError(Exception):
    pass


UPDATES = 6


def updates_into(seen):
    """Return progress that notes the number of updates."""
    return lambda share, _: seen.append(round(share * UPDATES))


def interrupt_after(iterations):
    def on_progress(share, what):
        if round(share * UPDATES) == iterations:
            raise InterruptedTrainingError

    return on_progress


def test_an_interrupted_training_resumes_to_the_same_policy(tmp_path):
    whole = train(ARM, None, out=tmp_path / "whole", options=options())
    with pytest.raises(InterruptedTrainingError):
        train(ARM, None, out=tmp_path / "cut", options=options(), on_progress=interrupt_after(5))
    assert not Outputs(tmp_path / "cut").policy.exists()
    seen = []
    resumed = train(ARM, None, out=tmp_path / "cut", options=options(resume=True), on_progress=updates_into(seen))
    assert seen == [5, 6]  # the checkpoint is that of the fourth update
    assert resumed.policy.read_bytes() == whole.policy.read_bytes()
    assert resumed.steps == whole.steps
    assert resumed.reward == whole.reward


def test_a_checkpoint_of_another_training_is_neither_continued_nor_lost(tmp_path):
    with pytest.raises(InterruptedTrainingError):
        train(ARM, None, out=tmp_path, options=options(), on_progress=interrupt_after(3))
    seen = []
    train(ARM, None, out=tmp_path, options=options(resume=True, seed=9), on_progress=updates_into(seen))
    assert seen == [1, 2, 3, 4, 5, 6]
    kept = list(Outputs(tmp_path).folder.glob("checkpoint-*.pt"))
    assert len(kept) == 1
    kept[0].rename(Outputs(tmp_path).checkpoint)
    train(ARM, None, out=tmp_path, options=options(resume=True), on_progress=updates_into(seen))
    assert seen[6:] == [3, 4, 5, 6]


def test_after_a_damaged_checkpoint_a_training_begins_anew_and_says_so(tmp_path, caplog):
    with pytest.raises(InterruptedTrainingError):
        train(ARM, None, out=tmp_path / "damaged", options=options(), on_progress=interrupt_after(3))
    path = Outputs(tmp_path / "damaged").checkpoint
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    seen = []
    changes = {"options": options(resume=True), "on_progress": updates_into(seen)}
    again = train(ARM, None, out=tmp_path / "damaged", **changes)
    assert seen == [1, 2, 3, 4, 5, 6]
    (line,) = [record.getMessage() for record in caplog.records if record.name == "rejoint"]
    assert line.startswith(f"{path}: damaged checkpoint (it is not what was written)")
    assert line.endswith("the training begins anew")
    whole = train(ARM, None, out=tmp_path / "whole", options=options())
    assert again.policy.read_bytes() == whole.policy.read_bytes()


def test_a_training_folder_that_cannot_be_written_is_named(tmp_path):
    Outputs(tmp_path).folder.write_bytes(b"a file where a folder should be")
    with pytest.raises(FileError, match="training: cannot be written"):
        train(ARM, None, out=tmp_path, options=options())


def test_exported_network_agrees_with_the_trained_one():
    torch.manual_seed(0)
    network = perceptron((50, 128, 64, 6))
    session = ort.InferenceSession(policy_graph(network, 50, 6).SerializeToString())
    observations = np.random.default_rng(0).normal(0.0, 3.0, (500, 50)).astype(np.float32)
    with torch.no_grad():
        expected = network(torch.from_numpy(observations)).clamp(-1.0, 1.0).numpy()
    got = session.run((OUTPUT,), {INPUT: observations})[0]
    assert np.abs(got - expected).max() <= 1e-5
    assert (np.abs(expected) < 1.0).mean() > 0.5  # the clip does not hide the comparison


def test_torch_multiplies_coarsely_while_it_trains_and_not_a_moment_longer(tmp_path):
    learner, seen = small_learner(), []
    look = lambda *_: seen.append((torch.get_float32_matmul_precision(), torch.get_num_threads()))  # noqa: E731
    hooks = [net.register_forward_pre_hook(look) for net in (learner.actor.net, learner.critic.net)]
    torch.set_num_threads(2)
    learner.iterate()
    assert {precision for precision, _ in seen} == {"medium"}
    assert {threads for _, threads in seen} == {1}
    assert (torch.get_float32_matmul_precision(), torch.get_num_threads()) == ("highest", 2)
    for hook in hooks:
        hook.remove()
    learner.workers[0].task.step = lambda _: 1 / 0
    with pytest.raises(ZeroDivisionError):
        learner.iterate()
    assert (torch.get_float32_matmul_precision(), torch.get_num_threads()) == ("highest", 2)


def test_after_a_training_its_exported_network_is_compared_in_full_precision(tmp_path):
    precisions = []
    watch = lambda *_: precisions.append(torch.get_float32_matmul_precision())  # noqa: E731
    result = train(ARM, None, out=tmp_path, options=options(iterations=2), on_progress=watch)
    assert precisions == ["highest"] * 2
    layers = [numpy_helper.to_array(tensor) for tensor in onnx.load(result.policy).graph.initializer][:4]
    network = perceptron((75, 16, 6))
    with torch.no_grad():
        for parameter, layer in zip(network.parameters(), layers, strict=True):
            parameter.copy_(torch.from_numpy(layer.copy()))
        seen = np.random.default_rng(0).normal(0.0, 3.0, (500, 75)).astype(np.float32)
        expected = network(torch.from_numpy(seen)).clamp(-1.0, 1.0).numpy()
    assert np.abs(load_policy(result.policy, ARM).act(seen) - expected).max() <= 1e-5


def test_only_perceptrons_are_exported():
    with pytest.raises(TypeError, match="type ReLU"):
        policy_graph(nn.Sequential(nn.Linear(3, 2), nn.ReLU()), 3, 2)


def test_the_untrained_policy_hardly_acts():
    torch.manual_seed(0)
    actor = Actor(50, 6, (128, 64), -0.7)
    assert actor.net(torch.randn(100, 50)).abs().max() < 0.02
    assert torch.allclose(actor.log_std, torch.tensor(-0.7))
    actor.ceiling = -1.5
    assert torch.allclose(actor.log_std, torch.tensor(-1.5))


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


def test_the_critic_sees_privileged_observations():
    critic = Critic(50, 56, 6, (16,))
    observations, privileged = torch.zeros(1, 50), torch.zeros(1, 56)
    other = privileged.clone()
    other[0, 7] = 1.0
    first, second = critic.value(observations, privileged), critic.value(observations, other)
    assert first.shape == (1,)
    assert first.item() != second.item()


def rollout(cycles, agents, **tensors) -> Rollout:
    """A rollout of zeros but for what is given."""
    shape = (cycles, agents)
    zeros = {name: torch.zeros(shape) for name in ("log_density", "value", "final_value", "reward", "distance")}
    zeros |= {name: torch.zeros(shape, dtype=torch.bool) for name in ("terminated", "truncated")}
    zeros |= {name: torch.zeros((*shape, 2)) for name in ("observation", "privileged", "action")}
    zeros |= {name: torch.zeros((1, agents, 2)) for name in ("next_observation", "next_privileged")}
    return Rollout(**(zeros | tensors))


def returns(seen: Rollout, next_value: float, **changes) -> torch.Tensor:
    """Taught returns less values (T, N), where the critic gives ``next_value`` to the state after the last."""
    settings = dataclasses.replace(SMALL.ppo, rollout=len(seen.reward), mini_batches=1, **changes)
    critic = Critic(2, 2, 2, (4,))
    with torch.no_grad():
        for parameter in critic.net.parameters():
            parameter.zero_()
        critic.net[-1].bias.fill_(next_value)
    ppo = Ppo(Actor(2, 2, (4,), -0.7), critic, settings, agents=seen.reward.shape[1])
    ppo.learn(seen, 1e-3, iteration=0)
    return ppo.memory.get_tensor_by_name("returns")[..., 0] - seen.value


def test_advantages_worked_by_hand():
    # One agent, three cycles; after the second one the target times out in a state of value 4.
    column = lambda *values: torch.tensor(values)[:, None]  # noqa: E731
    seen = rollout(
        3, 1, reward=column(1.0, 2.0, 3.0), truncated=column(False, True, False), value=column(10.0, 20.0, 30.0),
        final_value=column(0.0, 4.0, 0.0),
    )  # fmt: skip
    got = returns(seen, 8.0, discount=0.5, gae_lambda=0.8, reward_scale=2.0)
    third = 6.0 + 0.5 * 8.0 - 30.0
    second = 4.0 + 0.5 * 4.0 - 20.0
    first = 2.0 + 0.5 * 20.0 - 10.0 + 0.5 * 0.8 * second
    np.testing.assert_allclose(got.ravel(), [first, second, third], rtol=1e-6)


def test_success_has_no_value_beyond_it():
    done = torch.tensor([[True, False], [False, False]])
    seen = rollout(2, 2, terminated=done)
    np.testing.assert_allclose(returns(seen, 8.0, discount=0.5, gae_lambda=1.0), [[0.0, 2.0], [4.0, 4.0]])


def test_agents_of_workers_stand_side_by_side():
    mark = lambda first: first + 10.0 * torch.arange(3)[:, None] + torch.arange(2)  # noqa: E731 - agent + 10 cycle
    both = join([rollout(3, 2, reward=mark(0.0)), rollout(3, 2, reward=mark(2.0))])
    np.testing.assert_array_equal(both.reward, np.arange(4) + 10.0 * np.arange(3)[:, None])
    assert both.next_observation.shape == (1, 4, 2)


def test_time_outs_are_bootstrapped_from_the_state_before_the_new_target():
    learner = small_learner()
    worker, seen = learner.workers[0], []
    step = worker.task.step
    worker.task.step = lambda action: seen.append(step(action)) or seen[-1]
    rolled = worker.roll(learner.actor, learner.critic, SMALL.ppo.rollout)
    assert rolled.truncated.any()
    assert not rolled.terminated.any()
    for t, n in rolled.truncated.nonzero().tolist():
        with torch.no_grad():
            value = learner.critic.value(
                *(torch.from_numpy(a[n]) for a in (seen[t].final_observation, seen[t].final_privileged))
            )
        np.testing.assert_allclose(rolled.final_value[t, n].item(), value.item(), rtol=1e-4)
        assert (seen[t].final_observation[n] != seen[t].observation[n]).any()
    assert not rolled.final_value[~rolled.truncated].any()


def test_a_rollout_holds_what_was_seen_done_and_got():
    learner = small_learner()
    worker, actions, seen = learner.workers[1], [], []
    step = worker.task.step
    first = worker.state()["observation"].clone()

    def watch(action):
        actions.append(action.copy())
        seen.append(step(action))
        return seen[-1]

    worker.task.step = watch
    rolled = worker.roll(learner.actor, learner.critic, SMALL.ppo.rollout)
    np.testing.assert_array_equal(rolled.observation[0], first)
    np.testing.assert_array_equal(rolled.observation[1:], [transition.observation for transition in seen[:-1]])
    np.testing.assert_array_equal(rolled.action, actions)
    np.testing.assert_allclose(rolled.reward, [transition.reward for transition in seen], rtol=1e-6)
    with torch.no_grad():
        told = learner.actor.act({"observations": rolled.observation, "taken_actions": rolled.action})[1]["log_prob"]
    np.testing.assert_allclose(rolled.log_density, told[..., 0], atol=1e-4)


def test_learning_rate_falls_linearly_to_its_last_value():
    learner = small_learner(learning_rate=1e-3, final_learning_rate=1e-4)
    rates = []
    for _ in range(6):
        assert learner.iterate().learning_rate == learner.ppo.optimizer.learning_rate
        rates.append(learner.curve[-1].learning_rate)
    np.testing.assert_allclose(rates, 1e-3 - 0.9e-3 * np.arange(6) / 5, rtol=1e-9)


def test_the_noise_stays_below_its_falling_ceiling():
    learner = small_learner(log_std=-0.3, log_std_ceiling=(-0.4, -2.0), ceiling_falls=0.5)
    noise = [learner.iterate().noise for _ in range(6)]
    ceilings = np.exp([-0.4, -0.4 - 1.6 / 3, -0.4 - 3.2 / 3, -2.0, -2.0, -2.0])
    assert (noise <= ceilings + 1e-6).all()
    np.testing.assert_allclose(noise[0], ceilings[0], rtol=1e-5)


def test_learning_improves_the_reward():
    # The same arms and targets before and after: what changes is the policy alone.
    preset = dataclasses.replace(
        DEFAULT,
        task=TaskSettings(hold_steps=40),
        ppo=PpoSettings(rollout=16, iterations=12, actor_layers=(64,), critic_layers=(64,)),
    )
    learner = Learner([ReachTask(ARM, BroadRanges(arm=ARM), 128, preset.task, seed=0)], preset.ppo, seed=0)

    def mean_reward() -> float:
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
    for _ in range(12):
        learner.iterate()
    assert mean_reward() > before + 0.05


def test_presets_are_found_by_name():
    assert load_preset("paper") is PAPER
    with pytest.raises(InputError, match="default, paper"):
        load_preset("papr")


def test_the_paper_s_preset_has_the_paper_s_table_3():
    ppo, task = PAPER.ppo, PAPER.task
    assert (ppo.epochs, ppo.mini_batches, ppo.clip, ppo.gae_lambda, ppo.discount) == (8, 8, 0.1, 0.95, 0.99)
    assert ppo.rollout * ppo.iterations == 5000
    assert len(ppo.actor_layers) == len(ppo.critic_layers) == 3
    assert (task.hold_steps, task.ends_on_success, task.law.anchor) == (250, True, "measured")
    assert ppo.agents == 512


def test_a_policy_of_the_paper_s_preset_can_be_deployed(tmp_path):
    result = train(ARM, None, out=tmp_path, options=TrainingOptions(preset="paper", agents=8, threads=1, iterations=1))
    contract = load_policy(result.policy, ARM).contract
    assert (contract.layout, contract.law.anchor, contract.observation_size) == ("equation-16", "measured", 28)


def test_snapshots_show_the_policy_on_its_way(tmp_path):
    result = train(ARM, None, out=tmp_path, options=options(snapshot_every=2))
    folder = Outputs(tmp_path)
    probes = [load_policy(folder.snapshot(k), ARM).contract.probe for k in (0, 2, 4)]
    probes.append(load_policy(result.policy, ARM).contract.probe)
    assert not folder.snapshot(1).exists()
    assert np.abs(probes[0]).max() < 0.05  # untrained: the classical law alone
    assert len(set(probes)) == 4
    again = train(ARM, None, out=tmp_path / "plain", options=options())
    assert load_policy(again.policy, ARM).contract.probe == probes[3]  # keeping them changes nothing
