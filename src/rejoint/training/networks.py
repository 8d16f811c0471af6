"""Actor and critic as skrl models."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from torch import Tensor, nn

LAST_LAYER_SCALE = 0.01
"""Factor on the actor's last layer: the untrained policy is the classical law it corrects (chosen)."""


def unbounded(size: int) -> gymnasium.spaces.Box:
    """Space of all vectors of a size."""
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32)


class Actor(GaussianMixin, Model):  # type: ignore[misc]
    """Gaussian policy whose noise has a ceiling that the training lowers."""

    def __init__(self, observation_size: int, joints: int, layers: Sequence[int], log_std: float) -> None:
        Model.__init__(
            self, observation_space=unbounded(observation_size), action_space=unbounded(joints), device="cpu"
        )
        GaussianMixin.__init__(self, clip_log_std=False, reduction="sum")
        self.net = perceptron((observation_size, *layers, joints))
        with torch.no_grad():
            for parameter in self.net[-1].parameters():
                parameter.mul_(LAST_LAYER_SCALE)
        self.log_std = nn.Parameter(torch.full((joints,), log_std))
        self.ceiling = np.inf

    def compute(self, inputs: dict[str, Tensor], role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Mean action and logarithm of the noise, as skrl asks for them."""
        return self.net(inputs["observations"]), {"log_std": self.log_std.clamp(max=self.ceiling)}


class Critic(DeterministicMixin, Model):  # type: ignore[misc]
    """Value of an observation together with the twin's truth."""

    def __init__(self, observation_size: int, truth_size: int, joints: int, layers: Sequence[int]) -> None:
        Model.__init__(
            self,
            observation_space=unbounded(observation_size),
            state_space=unbounded(truth_size),
            action_space=unbounded(joints),
            device="cpu",
        )
        DeterministicMixin.__init__(self)
        self.net = perceptron((observation_size + truth_size, *layers, 1))

    def compute(self, inputs: dict[str, Tensor], role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Values (N, 1), as skrl asks for them."""
        return self.net(torch.cat([inputs["observations"], inputs["states"]], dim=-1)), {}


def perceptron(sizes: Sequence[int]) -> nn.Sequential:
    """Fully connected layers with ELU between them."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ELU()]
    return nn.Sequential(*layers[:-1])
