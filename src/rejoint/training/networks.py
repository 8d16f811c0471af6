"""Actor and critic of PPO, and what other learners build their networks from."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

LAST_LAYER_SCALE = 0.01
"""Factor on the actor's last layer: the untrained policy is the classical law it corrects (chosen)."""


def unbounded(size: int) -> gymnasium.spaces.Box:
    """Space of all vectors of a size."""
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32)


class Actor(nn.Module):
    """Gaussian policy whose noise has a ceiling that the training lowers."""

    def __init__(self, observation_size: int, joints: int, layers: Sequence[int], log_std: float) -> None:
        super().__init__()
        self.net = perceptron((observation_size, *layers, joints))
        with torch.no_grad():
            for parameter in self.net[-1].parameters():
                parameter.mul_(LAST_LAYER_SCALE)
        self.free_log_std = nn.Parameter(torch.full((joints,), log_std))
        self.ceiling = np.inf

    @property
    def log_std(self) -> Tensor:
        """Logarithm (n,) of the exploration noise."""
        return self.free_log_std.clamp(max=self.ceiling)

    def sample(self, observation: Tensor, random: torch.Generator) -> Tensor:
        """Draw actions (N, n) for observations (N, size)."""
        mean: Tensor = self.net(observation)
        return mean + self.log_std.exp() * torch.randn(mean.shape, generator=random)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Logarithm (...) of the density of actions (..., n), less a constant: only differences are of interest."""
        log_std = self.log_std
        deviation = (action - self.net(observation)) * (-log_std).exp()
        return -0.5 * (deviation**2).sum(dim=-1) - log_std.sum()


class Critic(nn.Module):
    """Value of an observation together with the twin's truth."""

    def __init__(self, observation_size: int, truth_size: int, layers: Sequence[int]) -> None:
        super().__init__()
        self.net = perceptron((observation_size + truth_size, *layers, 1))

    def inputs(self, observation: Tensor, truth: Tensor) -> Tensor:
        """Everything that the critic sees (..., size)."""
        return torch.cat([observation, truth], dim=-1)

    def forward(self, observation: Tensor, truth: Tensor) -> Tensor:
        """Values (...)."""
        values: Tensor = self.net(self.inputs(observation, truth))[..., 0]
        return values


def perceptron(sizes: Sequence[int]) -> nn.Sequential:
    """Fully connected layers with ELU between them."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ELU()]
    return nn.Sequential(*layers[:-1])
