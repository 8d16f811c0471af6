"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) by skrl, from whole rollouts."""

import itertools
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import Model
from torch import Tensor, nn

from rejoint.system.records import value_type
from rejoint.training.task import PpoSettings, ReachTask

LAST_LAYER_SCALE = 0.01
"""Factor on the actor's last layer, so that the untrained policy is the classical law; chosen"""


class Actor(Model):  # type: ignore[misc]
    """Gaussian policy with a falling noise ceiling.

    Faster than skrl's own, which samples for each density.
    """

    def __init__(self, observation_size: int, joints: int, layers: Sequence[int], log_std: float) -> None:
        super().__init__(observation_space=observation_size, action_space=joints, device="cpu")
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

    def act(self, inputs: dict[str, Tensor], *, role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Mean action (..., n) and log density (..., 1) of the actions taken."""
        mean = self.net(inputs["observations"])
        apart = (inputs["taken_actions"] - mean) * (-self.log_std).exp()
        return mean, {"log_prob": self._log_density(apart)[..., None]}

    compute = act  # which skrl wants, but does not call

    def distribution(self, *, role: str = "") -> torch.distributions.Normal:  # noqa: ARG002
        """Distribution of the noise alone, whose width skrl reports."""
        log_std = self.log_std.detach()
        return torch.distributions.Normal(torch.zeros_like(log_std), log_std.exp())

    def sample(self, observation: Tensor, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw actions (N, n) for observations (N, size), with log densities (N,)."""
        mean: Tensor = self.net(observation)
        apart = torch.randn(mean.shape, generator=random)
        return mean + self.log_std.exp() * apart, self._log_density(apart)

    def _log_density(self, apart: Tensor) -> Tensor:
        constant = self.log_std.sum() + 0.5 * apart.shape[-1] * np.log(2.0 * np.pi)
        return -0.5 * (apart**2).sum(dim=-1) - constant


class Critic(Model):  # type: ignore[misc]
    """Value of an observation and a privileged observation, and of an action if it is ``taken``."""

    def __init__(
        self, observation_size: int, privileged_size: int, joints: int, layers: Sequence[int], *, taken: bool = False
    ) -> None:
        super().__init__(
            observation_space=observation_size,
            state_space=privileged_size,
            action_space=joints,
            device="cpu",
        )
        self._inputs = ("observations", "states", *["taken_actions"] * taken)
        self.net = perceptron((observation_size + privileged_size + taken * joints, *layers, 1))

    def act(self, inputs: dict[str, Tensor], *, role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Values (..., 1)."""
        return self.net(torch.cat([inputs[name] for name in self._inputs], dim=-1)), {}

    compute = act

    def value(self, observation: Tensor, privileged: Tensor) -> Tensor:
        """Values (...)."""
        values: Tensor = self.act({"observations": observation, "states": privileged})[0][..., 0]
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
                value_loss_scale=1.0,
                time_limit_bootstrap=True,
                experiment={"write_interval": 0, "checkpoint_interval": 0},
            ),
        )
        self.optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], fused=True)
        self.init()

    def learn(self, rollout: Rollout, learning_rate: float) -> None:
        """Improve both networks by one rollout."""
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
        self.update(timestep=0, timesteps=0)  # which nothing here depends on
        self.tracking_data.clear()


def step(task: ReachTask, action: Tensor) -> Rollout:
    """`Transition` of one control cycle with actions (N, n)."""
    return {name: torch.from_numpy(value) for name, value in task.step(action.numpy())._asdict().items()}


def stacked(cycles: Sequence[Rollout]) -> Rollout:
    """Put control cycles together."""
    return {name: torch.stack([cycle[name] for cycle in cycles]) for name in cycles[0]}


@contextmanager
def on_one_thread(precision: str) -> Iterator[None]:
    """Let torch multiply with this ``precision`` on one thread; chosen: more are slower beside other programs."""
    threads, usual = torch.get_num_threads(), torch.get_float32_matmul_precision()
    torch.set_num_threads(1)
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.set_float32_matmul_precision(usual)


CEILING_FALLS = 0.8
"""Share of a training at whose end the ceiling of the noise is lowest; chosen"""

REACHED_DISTANCE = 0.010
"""[m] of a reached target at its end; Park et al. 2024, section IV-A"""


@value_type
class CurvePoint:
    """State of the training after one update."""

    step: int = 0
    """transitions"""
    reward: float = 0.0
    """mean per control cycle, with exploration noise"""
    success_rate: float = 0.0
    """fraction of the targets held (ours) or reached (the paper) at their end"""
    error_mm: float = 0.0
    """median at the end of a target"""
    noise: float = 0.0
    """sigma of the exploration noise"""
    wall_s: float = 0.0
    """without pauses"""


class Learner:
    """Networks, algorithm and agents of one training."""

    precision = "medium"
    """of matrix products: bfloat16 factors, float32 sums; chosen for speed"""

    def __init__(self, task: ReachTask, settings: PpoSettings, *, seed: int, start: Tensor | None = None) -> None:
        """Begin with the actor's weights ``start``, else with random ones."""
        torch.manual_seed(seed)
        self.task, self.settings, self.curve = task, settings, list[CurvePoint]()
        self._seen = dict(zip(("observation", "privileged"), map(torch.from_numpy, task.reset()), strict=True))
        self._make_networks(seed, start)

    def _make_networks(self, seed: int, start: Tensor | None) -> None:
        size, joints, settings = self.task.observer.size, self.task.arm.joints, self.settings
        self.actor = Actor(size, joints, settings.actor_layers, settings.log_std)
        if start is not None:
            torch.nn.utils.vector_to_parameters(start, self.actor.net.parameters())
        self.critic = Critic(size, self.task.privileged_size, joints, settings.critic_layers)
        self._exploration = torch.Generator().manual_seed(seed)
        self.ppo = Ppo(self.actor, self.critic, settings, agents=self.task.agents)

    @property
    def network(self) -> nn.Sequential:
        """The mean policy."""
        return self.actor.net

    def iterate(self) -> CurvePoint:
        """Run one rollout and one update; where no target ended, success and error are those of before."""
        start, last = time.perf_counter(), self.curve[-1] if self.curve else CurvePoint()
        with on_one_thread(self.precision):
            seen, noise = self.learn()
        ended = seen["terminated"] | seen["truncated"]
        distance = seen["distance"][ended].numpy()
        success = seen["terminated"][ended].numpy() if self.task.ends_on_success else distance < REACHED_DISTANCE
        point = CurvePoint(
            step=last.step + seen["reward"].numel(),
            reward=float(seen["reward"].float().mean()),
            success_rate=float(success.mean()) if len(distance) else last.success_rate,
            error_mm=1e3 * float(np.median(distance)) if len(distance) else last.error_mm,
            noise=noise,
            wall_s=last.wall_s + time.perf_counter() - start,
        )
        self.curve.append(point)
        return point

    def learn(self) -> tuple[Rollout, float]:
        """Run one rollout and one update; returns what was seen, and the mean sigma of the noise."""
        s, done = self.settings, len(self.curve)
        self.actor.ceiling = float(np.interp(done, (0.0, max(CEILING_FALLS * s.iterations, 1.0)), s.log_std_ceiling))
        rate = float(np.interp(done, (0, max(s.iterations - 1, 1)), (s.learning_rate, s.final_learning_rate)))
        rollout = self.roll()
        self.actor.requires_grad_(done >= s.critic_first)
        self.ppo.learn(rollout, rate)
        return rollout, self.actor.log_std.exp().mean().item()

    @torch.no_grad()
    def roll(self) -> Rollout:
        """Act for the control cycles of a rollout, with exploration noise."""
        rows, critic = [], self.critic
        for _ in range(self.settings.rollout):
            seen = {"observations": self._seen["observation"], "states": self._seen["privileged"]}
            action, density = self.actor.sample(seen["observations"], self._exploration)
            self._seen = step(self.task, action)
            rows.append(seen | {"actions": action, "log_prob": density} | self._seen)
        rollout = stacked(rows)
        late, final = rollout["truncated"], torch.zeros(rollout["truncated"].shape)
        final[late] = critic.value(rollout["final_observation"][late], rollout["final_privileged"][late])
        return rollout | {"values": critic.value(rollout["observations"], rollout["states"]), "final_value": final}
