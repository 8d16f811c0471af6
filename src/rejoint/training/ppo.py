"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347): what is learned from one rollout.

Actor and critic share neither weights nor loss, so each goes through the rollout by itself: two jobs that can run on
two cores, with the same result as one after the other.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor, nn

from rejoint.training.networks import Actor, Critic
from rejoint.training.presets import PpoSettings


@dataclass(frozen=True, kw_only=True, eq=False)
class Rollout:
    """T control cycles of N agents; tensors have the leading shape (T, N) where nothing else is said."""

    observation: Tensor
    truth: Tensor
    action: Tensor
    log_prob: Tensor
    """of the actions when they were taken"""
    value: Tensor
    final_value: Tensor
    """value of the state in which a target timed out, before the next one appeared; 0 elsewhere"""
    next_value: Tensor
    """(1, N) value of the state after the last cycle"""
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    distance: Tensor
    """[m] between TCP and target"""

    @property
    def ended(self) -> Tensor:
        """Whether the target ended in this cycle, in one way or the other."""
        return self.terminated | self.truncated


class Losses(NamedTuple):
    """Means over the mini-batches of one update."""

    policy: float
    value: float


def join(rollouts: list[Rollout]) -> Rollout:
    """Put the agents of several rollouts of the same length side by side."""
    names = [f.name for f in fields(Rollout)]
    return Rollout(**{name: torch.cat([getattr(rollout, name) for rollout in rollouts], dim=1) for name in names})


def advantages(rollout: Rollout, settings: PpoSettings) -> Tensor:
    """Generalised advantage estimates (T, N); Schulman et al. 2016, arXiv:1506.02438.

    A time-out is no failure: its return goes on with the value of the state that it cut off.
    """
    reward = settings.reward_scale * rollout.reward + settings.discount * rollout.final_value
    goes_on = settings.discount * (~rollout.ended).float()
    following = torch.cat([rollout.value[1:], rollout.next_value])
    surprise = reward + goes_on * following - rollout.value
    result, after = torch.empty_like(surprise), torch.zeros_like(surprise[0])
    for t in reversed(range(len(surprise))):
        after = surprise[t] + settings.gae_lambda * goes_on[t] * after
        result[t] = after
    return result


class Ppo:
    """Optimisers of an actor and a critic."""

    def __init__(self, actor: Actor, critic: Critic, settings: PpoSettings, *, seed: int) -> None:
        self.actor, self.critic, self.settings = actor, critic, settings
        self.actor_optimizer = torch.optim.Adam(actor.parameters(), lr=settings.learning_rate, fused=True)
        self.critic_optimizer = torch.optim.Adam(critic.parameters(), lr=settings.learning_rate, fused=True)
        self.shuffling = torch.Generator().manual_seed(seed)

    def update(self, rollout: Rollout, learning_rate: float, workers: Executor) -> Losses:
        """Improve both networks by one rollout."""
        s, advantage = self.settings, advantages(rollout, self.settings)
        returns = (advantage + rollout.value).flatten()
        advantage = ((advantage - advantage.mean()) / (advantage.std() + 1e-8)).flatten()
        batches = [
            batch
            for _ in range(s.epochs)
            for batch in torch.randperm(len(returns), generator=self.shuffling).chunk(s.mini_batches)
        ]
        for optimizer in (self.actor_optimizer, self.critic_optimizer):
            optimizer.param_groups[0]["lr"] = learning_rate
        policy = workers.submit(self._improve_actor, rollout, advantage, batches)
        value = workers.submit(self._improve_critic, rollout, returns, batches)
        return Losses(policy.result(), value.result())

    def _improve_actor(self, rollout: Rollout, advantage: Tensor, batches: list[Tensor]) -> float:
        observation, action = rollout.observation.flatten(0, 1), rollout.action.flatten(0, 1)
        before, clip, total = rollout.log_prob.flatten(), self.settings.clip, 0.0
        for batch in batches:
            gain = advantage[batch]
            ratio = (self.actor.log_prob(observation[batch], action[batch]) - before[batch]).exp()
            loss = -torch.minimum(gain * ratio, gain * ratio.clamp(1.0 - clip, 1.0 + clip)).mean()
            total += self._descend(loss, self.actor, self.actor_optimizer)
        return total / len(batches)

    def _improve_critic(self, rollout: Rollout, returns: Tensor, batches: list[Tensor]) -> float:
        seen, total = self.critic.inputs(rollout.observation, rollout.truth).flatten(0, 1), 0.0
        for batch in batches:
            error = self.critic.net(seen[batch])[:, 0] - returns[batch]
            total += self._descend(self.settings.value_weight * (error**2).mean(), self.critic, self.critic_optimizer)
        return total / len(batches)

    def _descend(self, loss: Tensor, network: nn.Module, optimizer: torch.optim.Optimizer) -> float:
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self.settings.gradient_clip > 0.0:
            nn.utils.clip_grad_norm_(network.parameters(), self.settings.gradient_clip)
        optimizer.step()
        return loss.item()
