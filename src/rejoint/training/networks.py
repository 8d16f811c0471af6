"""Actor and critic of PPO as skrl models, and shared parts of networks."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.models.torch import DeterministicMixin, Model
from torch import Tensor, nn

LAST_LAYER_SCALE = 0.01
"""Factor on the actor's last layer, so that the untrained policy is the classical law; chosen"""


def unbounded(size: int) -> gymnasium.spaces.Box:
    """Space of all vectors of a size."""
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32)


class Actor(Model):  # type: ignore[misc]
    """Gaussian policy with a falling noise ceiling.

    Faster than skrl's own, which samples for each density.
    """

    def __init__(self, observation_size: int, joints: int, layers: Sequence[int], log_std: float) -> None:
        spaces = {"observation_space": unbounded(observation_size), "action_space": unbounded(joints)}
        Model.__init__(self, **spaces, device="cpu")
        self.net = perceptron((observation_size, *layers, joints))
        with torch.no_grad():
            for parameter in self.net[-1].parameters():
                parameter.mul_(LAST_LAYER_SCALE)
        self.free_log_std = nn.Parameter(torch.full((joints,), log_std))
        self.ceiling = np.inf

    @property
    def log_std(self) -> Tensor:
        """Log exploration noise (n,)."""
        return self.free_log_std.clamp(max=self.ceiling)

    def compute(self, inputs: dict[str, Tensor], role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Mean action (..., n) and log noise."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}

    def act(self, inputs: dict[str, Tensor], *, role: str = "") -> tuple[Tensor, dict[str, Any]]:
        """Mean action (..., n) and log density (..., 1) of the actions taken."""
        mean, outputs = self.compute(inputs, role)
        apart = (inputs["taken_actions"] - mean) * (-outputs["log_std"]).exp()
        return mean, {"log_prob": self._log_density(apart)[..., None]}

    def distribution(self, *, role: str = "") -> torch.distributions.Normal:  # noqa: ARG002
        """Distribution of the noise alone, whose width skrl reports."""
        log_std = self.log_std.detach()
        return torch.distributions.Normal(torch.zeros_like(log_std), log_std.exp())

    def sample(self, observation: Tensor, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw actions (N, n) for observations (N, size), with log densities (N,); thread-safe."""
        mean: Tensor = self.net(observation)
        apart = torch.randn(mean.shape, generator=random)
        return mean + self.log_std.exp() * apart, self._log_density(apart)

    def _log_density(self, apart: Tensor) -> Tensor:
        """Log densities (...) of actions ``apart`` (..., n) sigma from the mean."""
        constant = self.log_std.sum() + 0.5 * apart.shape[-1] * np.log(2.0 * np.pi)
        return -0.5 * (apart**2).sum(dim=-1) - constant


class Critic(DeterministicMixin, Model):  # type: ignore[misc]
    """Value of an observation and a privileged observation."""

    def __init__(self, observation_size: int, privileged_size: int, joints: int, layers: Sequence[int]) -> None:
        spaces = {"observation_space": unbounded(observation_size), "action_space": unbounded(joints)}
        Model.__init__(self, **spaces, state_space=unbounded(privileged_size), device="cpu")
        DeterministicMixin.__init__(self)
        self.net = perceptron((observation_size + privileged_size, *layers, 1))

    def compute(self, inputs: dict[str, Tensor], role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Values (..., 1)."""
        return self.net(torch.cat([inputs["observations"], inputs["states"]], dim=-1)), {}

    def value(self, observation: Tensor, privileged: Tensor) -> Tensor:
        """Values (...); thread-safe."""
        values: Tensor = self.compute({"observations": observation, "states": privileged})[0][..., 0]
        return values


def perceptron(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers with in-place ELU between them."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ELU(inplace=True)]
    return nn.Sequential(*layers[:-1])
