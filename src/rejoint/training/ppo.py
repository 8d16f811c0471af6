"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) by skrl, from whole rollouts.

Workers act at the same time, each with its own random numbers; their rollouts go into skrl's memory at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import chain
from typing import NamedTuple

import numpy as np
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from torch import Tensor

from rejoint.training.adam import Adam
from rejoint.training.networks import Actor, Critic
from rejoint.training.presets import PpoSettings


@dataclass(frozen=True, kw_only=True, eq=False)
class Rollout:
    """T control cycles of N agents; default shape (T, N)."""

    observation: Tensor
    privileged: Tensor
    action: Tensor
    log_density: Tensor
    """of the action when taken"""
    value: Tensor
    final_value: Tensor
    """value of the state in which a target timed out; 0 elsewhere"""
    next_observation: Tensor
    """(1, N, size) after the last cycle"""
    next_privileged: Tensor
    """(1, N, size)"""
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    distance: Tensor
    """[m] TCP to target"""

    @property
    def ended(self) -> Tensor:
        """Whether the target ended in this cycle."""
        return self.terminated | self.truncated


class Losses(NamedTuple):
    """Means over the mini-batches of one update."""

    policy: float
    value: float


def join(rollouts: list[Rollout]) -> Rollout:
    """Join the agents of rollouts of the same length."""
    names = [f.name for f in fields(Rollout)]
    return Rollout(**{name: torch.cat([getattr(rollout, name) for rollout in rollouts], dim=1) for name in names})


class Memory(RandomMemory):  # type: ignore[misc]
    """skrl's memory, which copies whole rows into mini-batches, for speed."""

    def sample_by_index(self, names: Sequence[str], *, indexes: Tensor, mini_batches: int = 1) -> list[list[Tensor]]:
        """Rows ``indexes`` (m,) of each tensor in ``mini_batches`` parts."""
        parts = indexes.tensor_split(mini_batches)
        return [[self.tensors_view[name].index_select(0, part) for name in names] for part in parts]


class Ppo(PPO):  # type: ignore[misc]
    """skrl's agent, which learns from given rollouts."""

    def __init__(self, actor: Actor, critic: Critic, settings: PpoSettings, *, agents: int) -> None:
        self.settings = settings
        super().__init__(
            models={},  # for which it would make an optimiser
            memory=Memory(memory_size=settings.rollout, num_envs=agents, device="cpu", replacement=False),
            observation_space=actor.observation_space,
            state_space=critic.state_space,
            action_space=actor.action_space,
            device="cpu",
            cfg=_configuration(settings),
        )
        self.policy, self.value, self.scheduler = actor, critic, None
        self.models.update(policy=actor, value=critic)
        self.optimizer = Adam(chain(actor.parameters(), critic.parameters()))
        self.init()
        self.enable_training_mode(True)

    def learn(self, rollout: Rollout, learning_rate: float, *, iteration: int) -> Losses:
        """Improve both networks by one rollout."""
        columns = {
            "observations": rollout.observation,
            "states": rollout.privileged,
            "actions": rollout.action,
            "log_prob": rollout.log_density[..., None],
            "values": rollout.value[..., None],
            "rewards": self._rewards(rollout)[..., None],
            "terminated": rollout.terminated[..., None],
            "truncated": rollout.truncated[..., None],
        }
        for name, column in columns.items():
            self.memory.set_tensor_by_name(name, column)
        self.memory.filled = True
        self._current_next_observations = rollout.next_observation[0]
        self._current_next_states = rollout.next_privileged[0]
        self.optimizer.learning_rate = learning_rate
        self.enable_models_training_mode(True)
        self.update(timestep=iteration, timesteps=self.settings.iterations)
        self.enable_models_training_mode(False)
        tracked = {name: float(np.mean(values)) for name, values in self.tracking_data.items()}
        self.tracking_data.clear()
        return Losses(tracked["Loss / Policy loss"], tracked["Loss / Value loss"])

    def _rewards(self, rollout: Rollout) -> Tensor:
        """Rewards (T, N); a time-out adds the value of its state."""
        return self.settings.reward_scale * rollout.reward + self.settings.discount * rollout.final_value


def _configuration(settings: PpoSettings) -> PPO_CFG:
    return PPO_CFG(
        rollouts=settings.rollout,
        learning_epochs=settings.epochs,
        mini_batches=settings.mini_batches,
        discount_factor=settings.discount,
        gae_lambda=settings.gae_lambda,
        learning_rate=settings.learning_rate,
        grad_norm_clip=settings.gradient_clip,
        ratio_clip=settings.clip,
        value_clip=0.0,
        entropy_loss_scale=0.0,
        value_loss_scale=settings.value_weight,
        time_limit_bootstrap=True,
        experiment={"write_interval": 0, "checkpoint_interval": 0},
    )
