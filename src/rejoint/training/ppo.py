"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) by skrl, from whole rollouts.

Workers act at the same time, each with its own random numbers; their rollouts go into skrl's memory at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import chain
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, Model
from torch import Tensor, nn
from torch.nn import Parameter
from torch.optim.adam import adam

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


BETA1, BETA2, EPS = 0.9, 0.999, 1e-8
"""The paper's"""


@dataclass(frozen=True, eq=False)
class _Moments:
    step: Tensor
    """number of gradients"""
    exp_avg: Tensor
    exp_avg_sq: Tensor


class Adam:
    """An optimiser for skrl."""

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self._parameters = list(parameters)
        self._moments: dict[int, _Moments] = {}
        self.learning_rate = 1e-3

    def zero_grad(self) -> None:
        """Clear all gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update the parameters that have a gradient."""
        moved: list[Tensor] = []
        gradients, moments = [], []
        for k, parameter in enumerate(self._parameters):
            if parameter.grad is None:
                continue
            if k not in self._moments:
                self._moments[k] = _Moments(torch.zeros(()), torch.zeros_like(parameter), torch.zeros_like(parameter))
            moved.append(parameter)
            gradients.append(parameter.grad)
            moments.append(self._moments[k])
        adam(
            moved,
            gradients,
            [m.exp_avg for m in moments],
            [m.exp_avg_sq for m in moments],
            [],
            [m.step for m in moments],
            fused=True,
            amsgrad=False,
            beta1=BETA1,
            beta2=BETA2,
            lr=self.learning_rate,
            weight_decay=0.0,
            eps=EPS,
            maximize=False,
        )

    def state_dict(self) -> dict[str, Any]:
        """Checkpoint with the names of torch's optimiser."""
        return {"state": {k: dict(vars(moments)) for k, moments in self._moments.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self._moments = {
            k: _Moments(**{name: value.clone() for name, value in one.items()}) for k, one in state["state"].items()
        }


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
