"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) by skrl, from whole rollouts.

Workers act at the same time, each with its own random numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, Model
from torch import Tensor, nn

from rejoint.training.presets import PpoSettings

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
        constant = self.log_std.sum() + 0.5 * apart.shape[-1] * np.log(2.0 * np.pi)
        return -0.5 * (apart**2).sum(dim=-1) - constant


class Critic(DeterministicMixin, Model):  # type: ignore[misc]
    """Value of an observation and a privileged observation, and of an action if it is ``taken``."""

    def __init__(
        self, observation_size: int, privileged_size: int, joints: int, layers: Sequence[int], *, taken: bool = False
    ) -> None:
        spaces = {"observation_space": unbounded(observation_size), "action_space": unbounded(joints)}
        Model.__init__(self, **spaces, state_space=unbounded(privileged_size), device="cpu")
        DeterministicMixin.__init__(self)
        self._inputs = ("observations", "states", *["taken_actions"] * taken)
        self.net = perceptron((observation_size + privileged_size + taken * joints, *layers, 1))

    def compute(self, inputs: dict[str, Tensor], role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Values (..., 1)."""
        return self.net(torch.cat([inputs[name] for name in self._inputs], dim=-1)), {}

    def value(self, observation: Tensor, privileged: Tensor) -> Tensor:
        """Values (...); thread-safe."""
        values: Tensor = self.compute({"observations": observation, "states": privileged})[0][..., 0]
        return values


def perceptron(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers with in-place ELU between them."""
    layers = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ELU(inplace=True)]
    return nn.Sequential(*layers[:-1])


Rollout = dict[str, Tensor]
"""T control cycles of N agents by column, (T, N, ...): those of skrl, the fields of a `Transition`, and ``final_value``
of the state in which a target timed out, else 0"""


class Ppo(PPO):  # type: ignore[misc]
    """skrl's agent, which learns from given rollouts."""

    def __init__(self, actor: Actor, critic: Critic, settings: PpoSettings, *, agents: int) -> None:
        self.settings = settings
        super().__init__(
            models={"policy": actor, "value": critic},
            memory=RandomMemory(memory_size=settings.rollout, num_envs=agents, device="cpu", replacement=False),
            observation_space=actor.observation_space,
            state_space=critic.state_space,
            action_space=actor.action_space,
            device="cpu",
            cfg=PPO_CFG(
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
            ),
        )
        self.optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], fused=True)
        self.init()
        self.enable_training_mode(True)

    def learn(self, rollout: Rollout, learning_rate: float, *, iteration: int) -> tuple[float, float]:
        """Improve both networks by one rollout; returns the mean losses of policy and value."""
        settings = self.settings
        # a time-out adds the value of its state
        rewards = settings.reward_scale * rollout["reward"].float() + settings.discount * rollout["final_value"]
        for name in ("observations", "states", "actions", "log_prob", "values", "rewards", "terminated", "truncated"):
            column = rewards if name == "rewards" else rollout[name]
            self.memory.set_tensor_by_name(name, column if column.ndim == 3 else column[..., None])
        self.memory.filled = True
        self._current_next_observations = rollout["observation"][-1]
        self._current_next_states = rollout["privileged"][-1]
        self.optimizer.param_groups[0]["lr"] = learning_rate
        self.enable_models_training_mode(True)
        self.update(timestep=iteration, timesteps=settings.iterations)
        self.enable_models_training_mode(False)
        policy, value = (float(np.mean(self.tracking_data[f"Loss / {name} loss"])) for name in ("Policy", "Value"))
        self.tracking_data.clear()
        return policy, value


def join(rollouts: Sequence[Rollout]) -> Rollout:
    """Join the agents of rollouts of the same length."""
    return {name: torch.cat([rollout[name] for rollout in rollouts], dim=1) for name in rollouts[0]}
