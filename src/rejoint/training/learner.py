"""PPO on the task: skrl's algorithm in a loop of our own.

The loop is our own so that the value of the state before a new target appears can be bootstrapped,
and so that a training can be interrupted between two updates and continued bit for bit.
"""

from __future__ import annotations

import pickle
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from torch.optim.lr_scheduler import LRScheduler

from rejoint.errors import FileError
from rejoint.runs import write_whole
from rejoint.training.networks import Actor, Critic, unbounded
from rejoint.training.presets import PpoSettings
from rejoint.training.task import ReachTask, Transition

SUCCESS_DISTANCE = 0.010
"""[m] a target counts as reached below this distance at its end; Park et al. 2024, section IV-A."""

_CHECKPOINT_FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """How the training stood after one update."""

    step: int
    """transitions so far"""
    reward: float
    """mean per control cycle, exploration noise included"""
    success_rate: float
    """fraction of the targets that were held (ours) or reached (the paper) at their end"""
    error_mm: float
    """median distance at the end of a target"""
    noise: float
    """standard deviation of the exploration noise"""
    learning_rate: float
    policy_loss: float
    value_loss: float
    wall_s: float
    """time since the training started, pauses not counted"""


class LinearDecay(LRScheduler):
    """Learning rate that falls linearly to a fraction of the initial one over ``steps`` calls."""

    def __init__(self, optimizer: torch.optim.Optimizer, *, steps: int, last_fraction: float) -> None:
        self.steps, self.last_fraction = steps, last_fraction
        super().__init__(optimizer)

    def get_lr(self) -> list[float | torch.Tensor]:
        """Rates of all parameter groups."""
        done = min(self.last_epoch / max(self.steps, 1), 1.0)
        return [rate * (1.0 + done * (self.last_fraction - 1.0)) for rate in self.base_lrs]


class Learner:
    """Networks, algorithm and task of one training."""

    def __init__(self, task: ReachTask, settings: PpoSettings, *, seed: int) -> None:
        torch.manual_seed(seed)
        n, size = task.arm.joints, task.observer.size
        self.task, self.settings = task, settings
        self.actor = Actor(size, n, settings.actor_layers, settings.log_std)
        self.critic = Critic(size, task.truth_size, n, settings.critic_layers)
        self.agent = PPO(
            models={"policy": self.actor, "value": self.critic},
            memory=RandomMemory(memory_size=settings.rollout, num_envs=task.agents, device="cpu"),
            observation_space=unbounded(size),
            state_space=unbounded(task.truth_size),
            action_space=unbounded(n),
            device="cpu",
            cfg=_configuration(settings),
        )
        self.agent.init()
        self.agent.enable_training_mode(True)
        self.curve: list[CurvePoint] = []
        self._wall_before = 0.0
        self._observation, self._truth = (torch.from_numpy(array) for array in task.reset())

    @property
    def iteration(self) -> int:
        """Updates done so far."""
        return len(self.curve)

    def iterate(self) -> CurvePoint:
        """Run one rollout and one update."""
        start, s = time.perf_counter(), self.settings
        self.actor.ceiling = _ceiling(s, self.iteration)
        rewards, ends, successes = [], [], []
        for _ in range(s.rollout):
            transition = self._interact()
            ended = transition.truncated | transition.terminated
            rewards.append(transition.reward.mean())
            ends.append(transition.distance[ended])
            held = transition.distance[ended] < SUCCESS_DISTANCE
            successes.append(transition.terminated[ended] if self.task.settings.ends_on_success else held)
        end, success = np.concatenate(ends), np.concatenate(successes)
        tracked, self._wall_before = self.agent.tracking_data, self._wall_before + time.perf_counter() - start
        last = self.curve[-1] if self.curve else None
        point = CurvePoint(
            step=(self.iteration + 1) * s.rollout * self.task.agents,
            reward=float(np.mean(rewards)),
            success_rate=float(success.mean()) if len(end) else (last.success_rate if last else 0.0),
            error_mm=float(np.median(end)) * 1e3 if len(end) else (last.error_mm if last else 0.0),
            noise=float(np.mean(tracked["Policy / Standard deviation"])),
            learning_rate=float(self.agent.optimizer.param_groups[0]["lr"]),
            policy_loss=float(np.mean(tracked["Loss / Policy loss"])),
            value_loss=float(np.mean(tracked["Loss / Value loss"])),
            wall_s=self._wall_before,
        )
        tracked.clear()
        self.curve.append(point)
        return point

    def save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write a checkpoint; ``identity`` names what it belongs to."""
        content = {
            "format": _CHECKPOINT_FORMAT,
            "identity": identity,
            "modules": {name: module.state_dict() for name, module in self.agent.checkpoint_modules.items()},
            "scheduler": self.agent.scheduler.state_dict(),
            "random": torch.get_rng_state(),
            "curve": [asdict(point) for point in self.curve],
            "observation": self._observation,
            "truth": self._truth,
            "task": {name: _tensor(value) for name, value in self.task.state().items()},
        }
        write_whole(path, lambda temporary: torch.save(content, temporary))

    def load(self, path: Path, identity: dict[str, Any]) -> bool:
        """Continue from a checkpoint; False where it belongs to another training, FileError if damaged."""
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
            if content["format"] != _CHECKPOINT_FORMAT or content["identity"] != identity:
                return False
            for name, module in self.agent.checkpoint_modules.items():
                module.load_state_dict(content["modules"][name])
            self.agent.scheduler.load_state_dict(content["scheduler"])
            self.task.load_state({name: _plain(value) for name, value in content["task"].items()})
            self._observation, self._truth = content["observation"], content["truth"]
            self.curve = [CurvePoint(**point) for point in content["curve"]]
            torch.set_rng_state(content["random"])
        except (OSError, EOFError, KeyError, RuntimeError, TypeError, ValueError, pickle.UnpicklingError) as error:
            raise FileError(path, "damaged checkpoint", "delete it and train again") from error
        self._wall_before = self.curve[-1].wall_s if self.curve else 0.0
        return True

    def _interact(self) -> Transition:
        """One control cycle of all agents, recorded; the last one of a rollout updates the networks."""
        total = self.settings.rollout * self.settings.iterations
        clock = {"timestep": self.iteration, "timesteps": total}
        observation, truth = self._observation, self._truth
        with torch.no_grad():
            action, _ = self.agent.act(observation, truth, **clock)
            transition = self.task.step(action.numpy())
            self.agent.record_transition(
                observations=observation,
                states=truth,
                actions=action,
                rewards=_column((self.settings.reward_scale * transition.reward).astype(np.float32)),
                next_observations=torch.from_numpy(transition.final_observation),
                next_states=torch.from_numpy(transition.final_truth),
                terminated=_column(transition.terminated),
                truncated=_column(transition.truncated),
                infos={},
                **clock,
            )
        self._observation = torch.from_numpy(transition.observation)
        self._truth = torch.from_numpy(transition.truth)
        self.agent.post_interaction(**clock)
        return transition


def _configuration(settings: PpoSettings) -> PPO_CFG:
    updates = settings.iterations * settings.epochs  # skrl advances the schedule once per epoch
    decay = {"steps": updates, "last_fraction": settings.final_learning_rate / settings.learning_rate}
    return PPO_CFG(
        rollouts=settings.rollout,
        learning_epochs=settings.epochs,
        mini_batches=settings.mini_batches,
        discount_factor=settings.discount,
        gae_lambda=settings.gae_lambda,
        learning_rate=settings.learning_rate,
        learning_rate_scheduler=LinearDecay,
        learning_rate_scheduler_kwargs=decay,
        grad_norm_clip=settings.gradient_clip,
        ratio_clip=settings.clip,
        value_clip=0.0,
        entropy_loss_scale=0.0,
        value_loss_scale=settings.value_weight,
        time_limit_bootstrap=True,
        experiment={"write_interval": 0, "checkpoint_interval": 0},
    )


def _ceiling(settings: PpoSettings, iteration: int) -> float:
    first, last = settings.log_std_ceiling
    return first + (last - first) * min(iteration / max(settings.ceiling_falls * settings.iterations, 1.0), 1.0)


def _tensor(value: object) -> object:
    """Array as a tensor: a checkpoint of tensors and plain data can be read without running code in it."""
    return torch.from_numpy(value) if isinstance(value, np.ndarray) else value


def _plain(value: object) -> object:
    return value.numpy() if isinstance(value, torch.Tensor) else value


def _column(values: np.ndarray[Any, Any]) -> torch.Tensor:
    return torch.from_numpy(values)[:, None]
