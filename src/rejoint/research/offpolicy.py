"""SAC, TD3 and DDPG by skrl on the task of PPO, with privileged critics.

Haarnoja et al. 2018, arXiv:1812.05905; Fujimoto et al. 2018, arXiv:1802.09477; Lillicrap et al. 2016, arXiv:1509.02971.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from skrl.agents.torch import Agent
from skrl.agents.torch.ddpg import DDPG, DDPG_CFG
from skrl.agents.torch.sac import SAC, SAC_CFG
from skrl.agents.torch.td3 import TD3, TD3_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import Model
from skrl.resources.noises.torch import GaussianNoise
from torch import nn

from rejoint.arms import Arm
from rejoint.logs.runfolder.folder import Outputs
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.training.actorcritic import ActionCritic, BoundedActor, SquashedActor, bounded
from rejoint.training.export import export_policy
from rejoint.training.learner import REACHED_DISTANCE, CurvePoint, on_threads
from rejoint.training.ppo import unbounded
from rejoint.training.presets import DEFAULT, Preset
from rejoint.training.task import ReachTask, Transition
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

Algorithm = Literal["sac", "td3", "ddpg"]
ALGORITHMS: tuple[Algorithm, ...] = ("sac", "td3", "ddpg")

AGENTS = 512
_REPORT_EVERY = 32  # control cycles


@dataclass(frozen=True, kw_only=True)
class OffPolicySettings:
    """Settings beyond those of PPO's preset."""

    algorithm: Algorithm
    preset: Preset = DEFAULT
    cycles: int = 3840
    """two million transitions; chosen"""
    gradient_steps: int = 2
    """per control cycle"""
    batch: int = 1024
    memory: int = 400
    """control cycles kept"""
    warm_up: int = 32
    """control cycles before the first gradient step"""
    learning_rate: float = 5e-4
    polyak: float = 0.01
    noise: tuple[float, float] = (0.3, 0.05)
    """sigma of the exploration noise (TD3, DDPG), first and last"""
    seed: int = 0
    agents: int = AGENTS
    threads: int = 2


@dataclass(kw_only=True, eq=False)
class _ReportWindow:
    rewards: list[float] = field(default_factory=list)
    ends: list[Any] = field(default_factory=list)


class OffPolicyLearner:
    """Networks, algorithm and task of one training."""

    def __init__(self, task: ReachTask, settings: OffPolicySettings) -> None:
        torch.manual_seed(settings.seed)
        self.task, self.settings = task, settings
        self.agent = _make_agent(task, settings)
        self.agent.init()
        self.agent.enable_training_mode(True)
        self.curve: list[CurvePoint] = []
        self._cycle = 0
        self._observation, self._privileged = (torch.from_numpy(array) for array in task.reset())

    @property
    def cycle(self) -> int:
        """Control cycles so far."""
        return self._cycle

    def network(self) -> nn.Sequential:
        """Network of the mean action."""
        actor: BoundedActor | SquashedActor = self.agent.policy
        return actor.network()

    def learn(self) -> CurvePoint:
        """Run until the next report."""
        start, window = time.perf_counter(), _ReportWindow()
        for _ in range(min(_REPORT_EVERY, self.settings.cycles - self._cycle)):
            transition = self._interact()
            window.rewards.append(float(transition.reward.mean()))
            window.ends.append(transition.distance[transition.truncated | transition.terminated])
        end = np.concatenate(window.ends)
        before = self.curve[-1] if self.curve else None
        tracked = self.agent.tracking_data
        point = CurvePoint(
            step=self._cycle * self.task.agents,
            reward=float(np.mean(window.rewards)),
            success_rate=float((end < REACHED_DISTANCE).mean()) if len(end) else before.success_rate if before else 0.0,
            error_mm=float(np.median(end)) * 1e3 if len(end) else before.error_mm if before else 0.0,
            noise=self._noise(),
            learning_rate=self.settings.learning_rate,
            policy_loss=_mean(tracked, "Loss / Policy loss"),
            value_loss=_mean(tracked, "Loss / Critic loss"),
            wall_s=(before.wall_s if before else 0.0) + time.perf_counter() - start,
        )
        tracked.clear()
        self.curve.append(point)
        return point

    def _interact(self) -> Transition:
        clock = {"timestep": self._cycle, "timesteps": self.settings.cycles}
        observation, privileged = self._observation, self._privileged
        with torch.no_grad():
            action, _ = self.agent.act(observation, privileged, **clock)
            transition = self.task.step(action.numpy())
            scaled = (self.settings.preset.ppo.reward_scale * transition.reward).astype(np.float32)
            self.agent.record_transition(
                observations=observation,
                states=privileged,
                actions=action,
                rewards=torch.from_numpy(scaled)[:, None],
                next_observations=torch.from_numpy(transition.final_observation),
                next_states=torch.from_numpy(transition.final_privileged),
                terminated=torch.from_numpy(transition.terminated)[:, None],
                truncated=torch.from_numpy(transition.truncated)[:, None],
                infos={},
                **clock,
            )
        self._observation, self._privileged = (
            torch.from_numpy(transition.observation),
            torch.from_numpy(transition.privileged),
        )
        self.agent.post_interaction(**clock)
        self._cycle += 1
        return transition

    def _noise(self) -> float:
        actor = self.agent.policy
        return actor.spread if isinstance(actor, SquashedActor) else noise_at(self.settings, self._cycle)


def train_offpolicy(
    arm: Arm, twin: Twin | None, *, out: Path, settings: OffPolicySettings, on_progress: Progress = no_progress
) -> TrainingResult:
    """Train and write ``policy.onnx`` and the curves."""
    recipe, files = know_stiffness(settings.preset, arm, twin), Outputs(out)
    ranges = training_ranges(arm, twin, recipe)
    task = ReachTask(arm, ranges, settings.agents, recipe.task, seed=settings.seed, threads=settings.threads)
    learner = OffPolicyLearner(task, settings)
    while learner.cycle < settings.cycles:
        with on_threads(1):
            point = learner.learn()
        on_progress(learner.cycle / settings.cycles, describe(point))
    name = settings.algorithm
    write_curves(files.curves, learner.curve)
    export_policy(files.policy, learner.network(), policy_contract(arm, twin, recipe, settings.seed, name))
    return training_result(files, name, settings.seed, learner.curve)


def trainer(name: str, seed: int) -> Trainer:
    """Trainer of an algorithm; InputError for unknown ones."""
    settings = OffPolicySettings(algorithm=algorithm(name), seed=seed)
    return lambda arm, twin, out, on_progress: train_offpolicy(
        arm, twin, out=out, settings=settings, on_progress=on_progress
    )


def algorithm(name: str) -> Algorithm:
    """Check the name of an algorithm; InputError lists them."""
    for known in ALGORITHMS:
        if known == name:
            return known
    raise InputError(f"no learner is called {name!r}; known: ppo, {', '.join(ALGORITHMS)}")


def noise_at(settings: OffPolicySettings, cycle: int) -> float:
    """Exploration noise of TD3 and DDPG."""
    first, last = settings.noise
    return first + (last - first) * min(cycle / settings.cycles, 1.0)


def _make_agent(task: ReachTask, settings: OffPolicySettings) -> Agent:
    n, size, privileged = task.arm.joints, task.observer.size, task.privileged_size
    ppo, kind = settings.preset.ppo, settings.algorithm
    actor: Model = (SquashedActor if kind == "sac" else BoundedActor)(size, n, ppo.actor_layers)
    critics = 1 if kind == "ddpg" else 2
    suffixes = [""] if critics == 1 else ["_1", "_2"]
    models: dict[str, Model] = {"policy": actor}
    for suffix in suffixes:
        for role in ("critic", "target_critic"):
            models[f"{role}{suffix}"] = ActionCritic(size, privileged, n, ppo.critic_layers)
    if kind != "sac":
        models["target_policy"] = BoundedActor(size, n, ppo.actor_layers)
    algorithm = {"sac": SAC, "td3": TD3, "ddpg": DDPG}[kind]
    return algorithm(
        models=models,
        memory=RandomMemory(memory_size=settings.memory, num_envs=task.agents, device="cpu"),
        observation_space=unbounded(size),
        state_space=unbounded(privileged),
        action_space=bounded(n),
        device="cpu",
        cfg=_configuration(settings),
    )


def _configuration(settings: OffPolicySettings) -> SAC_CFG | TD3_CFG | DDPG_CFG:
    shared: dict[str, Any] = {
        "gradient_steps": settings.gradient_steps,
        "batch_size": settings.batch,
        "discount_factor": settings.preset.ppo.discount,
        "polyak": settings.polyak,
        "learning_rate": settings.learning_rate,
        "learning_starts": settings.warm_up,
        "grad_norm_clip": settings.preset.ppo.gradient_clip,
        "experiment": {"write_interval": 0, "checkpoint_interval": 0},
    }
    if settings.algorithm == "sac":
        return SAC_CFG(**shared, initial_entropy_value=0.01)  # chosen: rewards are about 0.1 a cycle
    noisy = {
        "exploration_noise": GaussianNoise,
        "exploration_noise_kwargs": {"mean": 0.0, "std": 1.0},
        "exploration_scheduler": lambda timestep, timesteps: noise_at(settings, timestep),  # noqa: ARG005
    }
    if settings.algorithm == "ddpg":
        return DDPG_CFG(**shared, **noisy)
    smoothing = {"smooth_regularization_noise_kwargs": {"mean": 0.0, "std": 0.1}, "smooth_regularization_clip": 0.2}
    return TD3_CFG(**shared, **noisy, smooth_regularization_noise=GaussianNoise, **smoothing)


def _mean(tracked: dict[str, list[float]], name: str) -> float:
    values = tracked.get(name, [])
    return float(np.mean(values)) if values else 0.0
