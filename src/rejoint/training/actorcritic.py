"""Actors and critics of SAC, TD3 and DDPG as skrl models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.models.torch import DeterministicMixin, Model
from torch import Tensor, nn

from rejoint.training.ppo import LAST_LAYER_SCALE, perceptron, unbounded

_LOG_STD = (-5.0, 0.5)  # bounds of SAC's noise, before squashing (chosen)
_FIRST_LOG_STD = -1.0  # chosen: about PPO's initial noise


def bounded(size: int) -> gymnasium.spaces.Box:
    """Space of vectors with elements between -1 and 1."""
    return gymnasium.spaces.Box(-1.0, 1.0, (size,), dtype=np.float32)


class BoundedActor(DeterministicMixin, Model):  # type: ignore[misc]
    """Deterministic policy: PPO's perceptron, and tanh."""

    def __init__(self, observation_size: int, joints: int, layers: Sequence[int]) -> None:
        Model.__init__(self, observation_space=unbounded(observation_size), action_space=bounded(joints), device="cpu")
        DeterministicMixin.__init__(self)
        self.net = perceptron((observation_size, *layers, joints))
        _shrink(self.net[-1])

    def compute(self, inputs: dict[str, Tensor], role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Actions (N, n)."""
        return torch.tanh(self.net(inputs["observations"])), {}

    def network(self) -> nn.Sequential:
        """Policy as layers."""
        return nn.Sequential(*self.net, nn.Tanh())


class SquashedActor(Model):  # type: ignore[misc]
    """Gaussian policy through tanh, with noise by observation (Haarnoja et al. 2018, appendix C)."""

    def __init__(self, observation_size: int, joints: int, layers: Sequence[int]) -> None:
        Model.__init__(self, observation_space=unbounded(observation_size), action_space=bounded(joints), device="cpu")
        whole = perceptron((observation_size, *layers, joints))
        self.body, self.mean = nn.Sequential(*list(whole)[:-1]), whole[-1]
        self.log_std = nn.Linear(layers[-1], joints)
        _shrink(self.mean)
        _shrink(self.log_std)
        with torch.no_grad():
            self.log_std.bias.fill_(_FIRST_LOG_STD)
        self.spread = float(np.exp(_FIRST_LOG_STD))
        """mean sigma of the last actions, before tanh"""

    def compute(self, inputs: dict[str, Tensor], role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Mean action before tanh (N, n) and log noise."""
        hidden = self.body(inputs["observations"])
        return self.mean(hidden), {"log_std": self.log_std(hidden).clamp(*_LOG_STD)}

    def act(self, inputs: dict[str, Tensor], *, role: str = "") -> tuple[Tensor, dict[str, Any]]:
        """Sample actions (N, n) and their log-probability (N, 1)."""
        mean, outputs = self.compute(inputs, role)
        log_std = outputs["log_std"]
        normal = torch.distributions.Normal(mean, log_std.exp())
        free = normal.rsample()
        # log(1 - tanh(u)^2) in a form that does not underflow
        squeeze = 2.0 * (np.log(2.0) - free - nn.functional.softplus(-2.0 * free))
        density: Tensor = normal.log_prob(free)  # type: ignore[no-untyped-call]
        log_prob = (density - squeeze).sum(dim=-1, keepdim=True)
        self.spread = float(log_std.detach().exp().mean())
        return torch.tanh(free), {"log_prob": log_prob}

    def network(self) -> nn.Sequential:
        """Mean policy as layers."""
        return nn.Sequential(*list(self.body), self.mean, nn.Tanh())


class ActionCritic(DeterministicMixin, Model):  # type: ignore[misc]
    """Value of an action, an observation and a privileged observation."""

    def __init__(self, observation_size: int, privileged_size: int, joints: int, layers: Sequence[int]) -> None:
        Model.__init__(
            self,
            observation_space=unbounded(observation_size),
            state_space=unbounded(privileged_size),
            action_space=bounded(joints),
            device="cpu",
        )
        DeterministicMixin.__init__(self)
        self.net = perceptron((observation_size + privileged_size + joints, *layers, 1))

    def compute(self, inputs: dict[str, Tensor], role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Values (N, 1)."""
        parts = [inputs["observations"], inputs["states"], inputs["taken_actions"]]
        return self.net(torch.cat(parts, dim=-1)), {}


def _shrink(layer: nn.Module) -> None:
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.mul_(LAST_LAYER_SCALE)
