"""SAC by skrl on the task of PPO, with privileged critics (Haarnoja et al. 2018, arXiv:1812.05905)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skrl.agents.torch.sac import SAC, SAC_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import Model
from torch import Tensor, nn
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from rejoint.arms import Arm
from rejoint.control.servogains import ServoGains
from rejoint.system.progress import Progress
from rejoint.training.learner import LAST_LAYER_SCALE, Critic, Learner, Rollout, perceptron, stacked, step
from rejoint.training.task import DEFAULT, ReachTask
from rejoint.training.train import Trainer, TrainingOptions, TrainingResult, train
from rejoint.twin.twin import Twin

_LOG_STD = (-5.0, 0.5)  # bounds of the noise, before squashing (chosen)
_FIRST_LOG_STD = -1.0  # chosen: about PPO's initial noise


class SquashedActor(Model):  # type: ignore[misc]
    """PPO's perceptron and tanh, with Gaussian noise by observation before it (Haarnoja et al. 2018, appendix C)."""

    def __init__(self, observation_size: int, joints: int, layers: Sequence[int]) -> None:
        super().__init__(observation_space=observation_size, action_space=joints, device="cpu")
        self.net = perceptron((observation_size, *layers, joints))
        self.log_std = nn.Linear(layers[-1], joints)
        with torch.no_grad():
            for parameter in (*self.net[-1].parameters(), *self.log_std.parameters()):
                parameter.mul_(LAST_LAYER_SCALE)
            self.log_std.bias.fill_(_FIRST_LOG_STD)
        self.spread = float(np.exp(_FIRST_LOG_STD))
        """mean sigma of the last actions, before tanh"""

    def act(self, inputs: dict[str, Tensor], *, role: str = "") -> tuple[Tensor, dict[str, Any]]:  # noqa: ARG002
        """Sample actions (N, n) and their log-probability (N, 1)."""
        hidden = self.net[:-1](inputs["observations"])
        sigma = self.log_std(hidden).clamp(*_LOG_STD).exp()
        self.spread = float(sigma.detach().mean())
        squashed = TransformedDistribution(Normal(self.net[-1](hidden), sigma), TanhTransform(cache_size=1))
        action = squashed.rsample()
        density = squashed.log_prob(action)  # type: ignore[no-untyped-call]
        return action, {"log_prob": density.sum(dim=-1, keepdim=True)}

    compute = act

    def network(self) -> nn.Sequential:
        """Mean policy as layers."""
        return nn.Sequential(*self.net, nn.Tanh())


class SacLearner(Learner):
    """Networks, algorithm and agents of one training by SAC, from random weights."""

    precision = "highest"

    def _make_networks(self, seed: int, start: Tensor | None) -> None:  # noqa: ARG002
        self.agent = _make_agent(self.task)

    @property
    def network(self) -> nn.Sequential:
        """Mean policy as layers."""
        return self.agent.policy.network()

    @torch.no_grad()
    def learn(self) -> tuple[Rollout, float]:
        """Update both networks after each control cycle."""
        agent, done, cycles = self.agent, list[Rollout](), self.settings.rollout
        for cycle in range(len(self.curve) * cycles, (len(self.curve) + 1) * cycles):
            before, clock = self._seen, {"timestep": cycle, "timesteps": self.settings.iterations * cycles}
            action, _ = agent.act(before["observation"], before["privileged"], **clock)
            self._seen = seen = step(self.task, action)
            agent.record_transition(
                observations=before["observation"],
                states=before["privileged"],
                actions=action,
                rewards=(self.settings.reward_scale * seen["reward"]).float()[:, None],
                next_observations=seen["final_observation"],
                next_states=seen["final_privileged"],
                terminated=seen["terminated"][:, None],
                truncated=seen["truncated"][:, None],
                infos={},
                **clock,
            )
            with torch.enable_grad():
                agent.post_interaction(**clock)
            agent.tracking_data.clear()
            done.append(seen)
        return stacked(done), agent.policy.spread


RECIPE = replace(DEFAULT, name="sac", ppo=replace(DEFAULT.ppo, agents=512, iterations=120, rollout=32), warm=None)
"""Two million transitions; chosen"""


def trainer(name: str, seed: int) -> Trainer:  # noqa: ARG001 - the entry point of several learners has a name
    """Trainer of the entry point ``sac``."""

    def train_offpolicy(
        arm: Arm, twin: Twin | None, out: Path, on_progress: Progress, servo_gains: ServoGains | None
    ) -> TrainingResult:
        options = TrainingOptions(preset=RECIPE, seed=seed, servo_gains=servo_gains, learner=SacLearner)
        return train(arm, twin, out=out, options=options, on_progress=on_progress)

    return train_offpolicy


def _make_agent(task: ReachTask) -> SAC:
    n, size, privileged, ppo = task.arm.joints, task.observer.size, task.privileged_size, DEFAULT.ppo
    models = {"policy": SquashedActor(size, n, ppo.actor_layers)}
    for role in ("critic_1", "target_critic_1", "critic_2", "target_critic_2"):
        models[role] = Critic(size, privileged, n, ppo.critic_layers, taken=True)
    agent = SAC(
        models=models,
        memory=RandomMemory(memory_size=400, num_envs=task.agents, device="cpu"),
        observation_space=size,
        state_space=privileged,
        action_space=n,
        device="cpu",
        cfg=SAC_CFG(
            gradient_steps=2,  # per control cycle
            batch_size=1024,
            discount_factor=ppo.discount,
            polyak=0.01,
            learning_rate=5e-4,
            learning_starts=32,
            grad_norm_clip=ppo.gradient_clip,
            target_entropy=-n,
            initial_entropy_value=0.01,  # chosen: rewards are about 0.1 a cycle
            experiment={"write_interval": 0, "checkpoint_interval": 0},
        ),
    )
    agent.init()
    agent.enable_training_mode(True)
    return agent
