"""A rollout worker: some of the agents, which act alone for a whole rollout.

One worker's networks run while another simulates. Each has its own random numbers.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rejoint.training.networks import Actor, Critic
from rejoint.training.ppo import Rollout
from rejoint.training.task import ReachTask, Transition


class RolloutWorker:
    """The agents of one task with their exploration noise."""

    def __init__(self, task: ReachTask, *, seed: int) -> None:
        self.task = task
        self._exploration = torch.Generator().manual_seed(seed)
        self._observation, self._privileged = (torch.from_numpy(array) for array in task.reset())

    @torch.no_grad()
    def roll(self, actor: Actor, critic: Critic, cycles: int) -> Rollout:
        """Act for some control cycles."""
        self.task.prepare(cycles)
        observations, seen_by_critic, actions, densities, transitions = [], [], [], [], []
        for _ in range(cycles):
            action, density = actor.sample(self._observation, self._exploration)
            transition = self.task.step(action.numpy())
            observations.append(self._observation)
            seen_by_critic.append(self._privileged)
            actions.append(action)
            densities.append(density)
            transitions.append(transition)
            self._observation, self._privileged = map(torch.from_numpy, (transition.observation, transition.privileged))
        observation, privileged, action = map(torch.stack, (observations, seen_by_critic, actions))
        return Rollout(
            observation=observation,
            privileged=privileged,
            action=action,
            log_density=torch.stack(densities),
            value=critic.value(observation, privileged),
            final_value=_final_values(critic, transitions),
            next_observation=self._observation[None],
            next_privileged=self._privileged[None],
            reward=_stack(transitions, "reward").float(),
            terminated=_stack(transitions, "terminated"),
            truncated=_stack(transitions, "truncated"),
            distance=_stack(transitions, "distance"),
        )

    def state(self) -> dict[str, Any]:
        """State for a checkpoint."""
        return {
            "exploration": self._exploration.get_state(),
            "observation": self._observation,
            "privileged": self._privileged,
            "task": self.task.state(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state`, bit for bit."""
        self._exploration.set_state(state["exploration"])
        self._observation, self._privileged = state["observation"], state["privileged"]
        self.task.load_state(state["task"])


def _stack(transitions: list[Transition], name: str) -> Tensor:
    return torch.stack([torch.from_numpy(getattr(transition, name)) for transition in transitions])


def _final_values(critic: Critic, transitions: list[Transition]) -> Tensor:
    """Values (T, N) of time-out states."""
    late = _stack(transitions, "truncated")
    ends = [
        [torch.from_numpy(array[t.truncated]) for array in (t.final_observation, t.final_privileged)]
        for t in transitions
    ]
    values = torch.zeros(late.shape)
    values[late] = critic.value(*(torch.cat(parts) for parts in zip(*ends, strict=True)))
    return values
