"""SAC by skrl on the task of PPO, with privileged critics (Haarnoja et al. 2018, arXiv:1812.05905)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.agents.torch.sac import SAC, SAC_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import Model
from torch import Tensor, nn
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from rejoint.arms import Arm
from rejoint.logs.runfolder import RunFolder
from rejoint.system.progress import Progress, no_progress
from rejoint.training.export import export_policy
from rejoint.training.learner import (
    LAST_LAYER_SCALE,
    REACHED_DISTANCE,
    Critic,
    CurvePoint,
    ends,
    on_threads,
    perceptron,
    unbounded,
)
from rejoint.training.presets import DEFAULT, Preset
from rejoint.training.task import ReachTask
from rejoint.training.train import (
    Trainer,
    TrainingResult,
    describe,
    know_stiffness,
    policy_contract,
    training_ranges,
    training_result,
    write_curves,
)
from rejoint.twin.twin import Twin

LEARNING_RATE = 5e-4
_REPORT_EVERY = 32  # control cycles
_LOG_STD = (-5.0, 0.5)  # bounds of the noise, before squashing (chosen)
_FIRST_LOG_STD = -1.0  # chosen: about PPO's initial noise


def bounded(size: int) -> gymnasium.spaces.Box:
    """Space of vectors with elements between -1 and 1."""
    return gymnasium.spaces.Box(-1.0, 1.0, (size,), dtype=np.float32)


class SquashedActor(Model):  # type: ignore[misc]
    """PPO's perceptron and tanh, with Gaussian noise by observation before it (Haarnoja et al. 2018, appendix C)."""

    def __init__(self, observation_size: int, joints: int, layers: Sequence[int]) -> None:
        super().__init__(observation_space=unbounded(observation_size), action_space=bounded(joints), device="cpu")
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
        density: Tensor = squashed.log_prob(action)  # type: ignore[no-untyped-call]
        return action, {"log_prob": density.sum(dim=-1, keepdim=True)}

    def compute(self, inputs: dict[str, Tensor], role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Mean actions (N, n)."""
        return torch.tanh(self.net(inputs["observations"])), {}

    def network(self) -> nn.Sequential:
        """Mean policy as layers."""
        return nn.Sequential(*self.net, nn.Tanh())


@dataclass(frozen=True, kw_only=True)
class OffPolicySettings:
    """Settings beyond those of PPO's preset."""

    preset: Preset = DEFAULT
    cycles: int = 3840
    """two million transitions; chosen"""
    batch: int = 1024
    memory: int = 400
    """control cycles kept"""
    warm_up: int = 32
    """control cycles before the first gradient step"""
    seed: int = 0
    agents: int = 512
    threads: int = 2


def trainer(name: str, seed: int) -> Trainer:  # noqa: ARG001 - the entry point of several learners has a name
    """Trainer of the entry point ``sac``."""
    return partial(train_offpolicy, settings=OffPolicySettings(seed=seed))


def train_offpolicy(
    arm: Arm, twin: Twin | None, out: Path, on_progress: Progress = no_progress, *, settings: OffPolicySettings
) -> TrainingResult:
    """Train and write ``policy.onnx`` and the curves."""
    recipe, files = know_stiffness(settings.preset, arm, twin), RunFolder(out)
    ranges = training_ranges(arm, twin)
    task = ReachTask(arm, ranges, settings.agents, recipe.task, seed=settings.seed, threads=settings.threads)
    torch.manual_seed(settings.seed)
    agent, curve, began = _make_agent(task, settings), list[CurvePoint](), time.perf_counter()
    seen = dict(zip(("observation", "privileged"), map(torch.from_numpy, task.reset()), strict=True))
    with on_threads(1):
        for first in range(0, settings.cycles, _REPORT_EVERY):
            done = []
            for cycle in range(first, min(first + _REPORT_EVERY, settings.cycles)):
                done.append(seen := _interact(agent, task, settings, cycle, seen))
            last, wall_s = curve[-1] if curve else None, time.perf_counter() - began
            curve.append(_point(agent, settings, cycle + 1, done, last, wall_s))
            on_progress((cycle + 1) / settings.cycles, describe(curve[-1]))
    write_curves(files.curves, curve)
    export_policy(files.policy, agent.policy.network(), policy_contract(arm, twin, recipe, settings.seed, "sac"))
    return training_result(files, "sac", settings.seed, curve)


Seen = dict[str, Tensor]
"""`Transition` of a control cycle"""


def _interact(agent: SAC, task: ReachTask, settings: OffPolicySettings, cycle: int, before: Seen) -> Seen:
    clock = {"timestep": cycle, "timesteps": settings.cycles}
    with torch.no_grad():
        action, _ = agent.act(before["observation"], before["privileged"], **clock)
        seen = {name: torch.from_numpy(value) for name, value in task.step(action.numpy())._asdict().items()}
        agent.record_transition(
            observations=before["observation"],
            states=before["privileged"],
            actions=action,
            rewards=(settings.preset.ppo.reward_scale * seen["reward"]).float()[:, None],
            next_observations=seen["final_observation"],
            next_states=seen["final_privileged"],
            terminated=seen["terminated"][:, None],
            truncated=seen["truncated"][:, None],
            infos={},
            **clock,
        )
    agent.post_interaction(**clock)
    return seen


def _point(
    agent: SAC, settings: OffPolicySettings, cycle: int, done: list[Seen], last: CurvePoint | None, wall_s: float
) -> CurvePoint:
    distance = torch.cat([one["distance"][one["truncated"] | one["terminated"]] for one in done]).numpy()
    losses = {key: float(np.mean(values)) for key, values in agent.tracking_data.items() if values}
    agent.tracking_data.clear()
    return CurvePoint(
        step=cycle * settings.agents,
        reward=float(np.mean([one["reward"].mean() for one in done])),
        **ends(distance, distance < REACHED_DISTANCE, last),
        noise=agent.policy.spread,
        learning_rate=LEARNING_RATE,
        policy_loss=losses.get("Loss / Policy loss", 0.0),
        value_loss=losses.get("Loss / Critic loss", 0.0),
        wall_s=wall_s,
    )


def _make_agent(task: ReachTask, settings: OffPolicySettings) -> SAC:
    n, size, privileged, ppo = task.arm.joints, task.observer.size, task.privileged_size, settings.preset.ppo
    models = {"policy": SquashedActor(size, n, ppo.actor_layers)}
    for role in ("critic_1", "target_critic_1", "critic_2", "target_critic_2"):
        models[role] = Critic(size, privileged, n, ppo.critic_layers, taken=True)
    agent = SAC(
        models=models,
        memory=RandomMemory(memory_size=settings.memory, num_envs=task.agents, device="cpu"),
        observation_space=unbounded(size),
        state_space=unbounded(privileged),
        action_space=bounded(n),
        device="cpu",
        cfg=SAC_CFG(
            gradient_steps=2,  # per control cycle
            batch_size=settings.batch,
            discount_factor=ppo.discount,
            polyak=0.01,
            learning_rate=LEARNING_RATE,
            learning_starts=settings.warm_up,
            grad_norm_clip=ppo.gradient_clip,
            initial_entropy_value=0.01,  # chosen: rewards are about 0.1 a cycle
            experiment={"write_interval": 0, "checkpoint_interval": 0},
        ),
    )
    agent.init()
    agent.enable_training_mode(True)
    return agent
