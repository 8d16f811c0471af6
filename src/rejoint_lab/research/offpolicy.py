"""SAC by skrl on the task of PPO, with privileged critics (Haarnoja et al. 2018, arXiv:1812.05905)."""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skrl.agents.torch.sac import SAC, SAC_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import Model
from torch import Tensor, nn
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from rejoint.arms import Arm
from rejoint.control.servogains import ServoGains
from rejoint.logs.runfolder import RunFolder
from rejoint.system.progress import Progress, no_progress
from rejoint.training.learner import (
    LAST_LAYER_SCALE,
    Critic,
    CurvePoint,
    Rollout,
    next_point,
    on_one_thread,
    perceptron,
    stacked,
    step,
)
from rejoint.training.ranges import training_ranges
from rejoint.training.task import DEFAULT, ReachTask
from rejoint.training.train import (
    Trainer,
    TrainingResult,
    describe,
    finish_training,
    know_stiffness,
    policy_contract,
)
from rejoint.twin.twin import Twin

CYCLES, AGENTS = 3840, 512
"""Two million transitions; chosen"""
_REPORT_EVERY = 32  # control cycles
_LOG_STD = (-5.0, 0.5)  # bounds of the noise, before squashing (chosen)
_FIRST_LOG_STD = -1.0  # chosen: about PPO's initial noise


class SquashedActor(Model):  # type: ignore[misc]
    """PPO's perceptron and tanh, with Gaussian noise by observation before it (Haarnoja et al. 2018, appendix C)."""

    def __init__(self, observation_size: int, joints: int, layers: Sequence[int]) -> None:
        super().__init__(observation_space=observation_size, action_space=joints, device="cpu")
        self.net = perceptron((observation_size, *layers, joints))
        self.log_std = nn.Linear(layers[-1], joints)
        with torch.no_grad():
            for parameter in (*self.net[-1].parameters(), *self.log_std.parameters()):
                parameter.mul_(LAST_LAYER_SCALE)
            self.log_std.bias.fill_(_FIRST_LOG_STD)
        self.spread = float(np.exp(_FIRST_LOG_STD))
        """mean sigma of the last actions, before tanh"""

    def act(self, inputs: dict[str, Tensor], *, role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Sample actions (N, n) and their log-probability (N, 1)."""
        hidden = self.net[:-1](inputs["observations"])
        sigma = self.log_std(hidden).clamp(*_LOG_STD).exp()
        self.spread = float(sigma.detach().mean())
        squashed = TransformedDistribution(Normal(self.net[-1](hidden), sigma), TanhTransform(cache_size=1))
        action = squashed.rsample()
        density = squashed.log_prob(action)  # type: ignore[no-untyped-call]
        return action, {"log_prob": density.sum(dim=-1, keepdim=True)}

    compute = act

    def network(self) -> nn.Sequential:
        """Mean policy as layers."""
        return nn.Sequential(*self.net, nn.Tanh())


def trainer(name: str, seed: int) -> Trainer:  # noqa: ARG001 - the entry point of several learners has a name
    """Trainer of the entry point ``sac``."""
    return partial(train_offpolicy, seed=seed)


def train_offpolicy(
    arm: Arm,
    twin: Twin | None,
    out: Path,
    on_progress: Progress = no_progress,
    servo_gains: ServoGains | None = None,
    *,
    seed: int,
    cycles: int = CYCLES,
    agents: int = AGENTS,
) -> TrainingResult:
    """Train and write ``policy.onnx`` and the curves."""
    recipe = know_stiffness(replace(DEFAULT, name="sac"), arm, twin)
    task = ReachTask(arm, training_ranges(arm, twin), agents, recipe.task, seed=seed, threads=2)
    torch.manual_seed(seed)
    agent, curve, done, began = _make_agent(task), list[CurvePoint](), list[Rollout](), time.perf_counter()
    seen = dict(zip(("observation", "privileged"), map(torch.from_numpy, task.reset()), strict=True))
    with on_one_thread():
        for cycle in range(cycles):
            before, clock = seen, {"timestep": cycle, "timesteps": cycles}
            with torch.no_grad():
                action, _ = agent.act(before["observation"], before["privileged"], **clock)
                seen = step(task, action)
                agent.record_transition(
                    observations=before["observation"],
                    states=before["privileged"],
                    actions=action,
                    rewards=(DEFAULT.ppo.reward_scale * seen["reward"]).float()[:, None],
                    next_observations=seen["final_observation"],
                    next_states=seen["final_privileged"],
                    terminated=seen["terminated"][:, None],
                    truncated=seen["truncated"][:, None],
                    infos={},
                    **clock,
                )
            agent.post_interaction(**clock)
            agent.tracking_data.clear()
            done.append(seen)
            if len(done) == _REPORT_EVERY or cycle + 1 == cycles:
                seconds = time.perf_counter() - began
                curve.append(next_point(stacked(done), curve, noise=agent.policy.spread, seconds=seconds))
                done, began = [], time.perf_counter()
                on_progress((cycle + 1) / cycles, describe(curve[-1]))
    contract = policy_contract(arm, twin, recipe, seed, servo_gains)
    return finish_training(RunFolder(out), agent.policy.network(), contract, curve)


def _make_agent(task: ReachTask) -> SAC:
    n, size, privileged, ppo = task.arm.joints, task.observer.size, task.privileged_size, DEFAULT.ppo
    models = {"policy": SquashedActor(size, n, ppo.actor_layers)}
    for role in ("critic_1", "target_critic_1", "critic_2", "target_critic_2"):
        models[role] = Critic(size, privileged, n, ppo.critic_layers, taken=True)
    agent = SAC(
        models=models,
        memory=RandomMemory(memory_size=400, num_envs=task.agents, device="cpu"),
        observation_space=size,
        state_space=privileged,
        action_space=n,
        device="cpu",
        cfg=SAC_CFG(
            gradient_steps=2,  # per control cycle
            batch_size=1024,
            discount_factor=ppo.discount,
            polyak=0.01,
            learning_rate=5e-4,
            learning_starts=32,
            grad_norm_clip=ppo.gradient_clip,
            target_entropy=-n,
            initial_entropy_value=0.01,  # chosen: rewards are about 0.1 a cycle
            experiment={"write_interval": 0, "checkpoint_interval": 0},
        ),
    )
    agent.init()
    agent.enable_training_mode(True)
    return agent
