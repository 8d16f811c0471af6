"""The training loop: rollout workers act, skrl's PPO learns; interruptible after every update."""

from __future__ import annotations

import io
import pickle
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from rejoint.system.errors import FileError, first_line
from rejoint.system.files import MEGABYTE, digest, read_bounded, write_whole
from rejoint.training.ppo import Actor, Adam, Critic, Losses, Ppo, Rollout, join
from rejoint.training.presets import PpoSettings
from rejoint.training.task import ReachTask, Transition
from rejoint.training.warmstart import WarmStart, take_over


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


T = TypeVar("T")

PRECISION = "medium"
"""Of matrix products in PPO: bfloat16 factors where the processor has them, float32 sums; chosen for speed"""


@contextmanager
def setting(get: Callable[[], T], put: Callable[[T], object], value: T) -> Iterator[None]:
    """Hold a setting of the whole process at ``value`` within the block: no trainings side by side in threads."""
    before = get()
    put(value)
    try:
        yield
    finally:
        put(before)


def on_threads(count: int) -> AbstractContextManager[None]:
    """Let torch compute on ``count`` threads within the block."""
    return setting(torch.get_num_threads, torch.set_num_threads, count)


REACHED_DISTANCE = 0.010
"""[m] of a reached target at its end; Park et al. 2024, section IV-A"""

SWITCH_INTERVAL = 1e-4
"""[s] until a waiting worker gets Python's lock; chosen: about the Python time between physics steps"""

LEARNING_THREADS = 1
"""Of torch; chosen: more are slower beside other programs"""

_CHECKPOINT_FORMAT = 6

_MAGIC = b"rejoint checkpoint "
_RESTART = "delete it, or train with --fresh"

CHECKPOINT_MOST = 2000 * MEGABYTE
"""Largest checkpoint; chosen"""


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """State of the training after one update."""

    step: int
    """transitions"""
    reward: float
    """mean per control cycle, with exploration noise"""
    success_rate: float
    """fraction of the targets held (ours) or reached (the paper) at their end"""
    error_mm: float
    """median at the end of a target"""
    noise: float
    """sigma of the exploration noise"""
    learning_rate: float
    policy_loss: float
    value_loss: float
    wall_s: float
    """without pauses"""


class Learner:
    """Networks, algorithm and agents of one training."""

    def __init__(
        self,
        tasks: Sequence[ReachTask],
        settings: PpoSettings,
        *,
        seed: int,
        threads: int = 1,
        start: WarmStart | None = None,
    ) -> None:
        """Take one task per worker; ``threads`` run at once, without effect on the result.

        The actor's weights are those of ``start``, else random.
        """
        torch.manual_seed(seed)
        size, self.threads = tasks[0].observer.size, threads
        self.settings, self.agents = settings, sum(task.agents for task in tasks)
        self.ends_on_success = tasks[0].settings.ends_on_success
        self.actor = Actor(size, tasks[0].arm.joints, settings.actor_layers, settings.log_std)
        if start is not None:
            take_over(self.actor.net, start)
        self.critic = Critic(size, tasks[0].privileged_size, tasks[0].arm.joints, settings.critic_layers)
        self.workers = [RolloutWorker(task, seed=len(tasks) * seed + k) for k, task in enumerate(tasks)]
        self.ppo = Ppo(self.actor, self.critic, settings, agents=self.agents)
        self.curve: list[CurvePoint] = []

    @property
    def iteration(self) -> int:
        """Number of updates."""
        return len(self.curve)

    def iterate(self) -> CurvePoint:
        """Run one rollout and one update."""
        start, s = time.perf_counter(), self.settings
        self.actor.ceiling = _ceiling(s, self.iteration)
        rate = _learning_rate(s, self.iteration)
        precision = setting(torch.get_float32_matmul_precision, torch.set_float32_matmul_precision, PRECISION)
        with precision, on_threads(LEARNING_THREADS):
            rollout = self._roll()
            self.actor.requires_grad_(self.iteration >= s.critic_first)
            losses = self.ppo.learn(rollout, rate, iteration=self.iteration)
        point = self._point(rollout, losses, rate, time.perf_counter() - start)
        self.curve.append(point)
        return point

    def _roll(self) -> Rollout:
        """Run all workers, each on one thread; torch's number of threads is per thread."""
        pool, cycles = (
            ThreadPoolExecutor(self.threads, initializer=partial(torch.set_num_threads, 1)),
            self.settings.rollout,
        )
        with pool, setting(sys.getswitchinterval, sys.setswitchinterval, SWITCH_INTERVAL):
            rolled = pool.map(lambda worker: worker.roll(self.actor, self.critic, cycles), self.workers)
            return join(list(rolled))

    def save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write a checkpoint for the training ``identity``."""
        content = {
            "format": _CHECKPOINT_FORMAT,
            "identity": identity,
            "modules": {name: module.state_dict() for name, module in self._modules().items()},
            "random": torch.get_rng_state(),
            "workers": [_tensors(worker.state()) for worker in self.workers],
            "curve": [asdict(point) for point in self.curve],
        }
        write_whole(path, lambda temporary: _save(content, temporary))

    def load(self, path: Path, identity: dict[str, Any]) -> bool:
        """Continue from a checkpoint; False if it is of another training, FileError if damaged.

        A checkpoint holds tensors and plain data, no code.
        """
        try:
            content = torch.load(io.BytesIO(_unsealed(path)), map_location="cpu", weights_only=True)
            if content["format"] != _CHECKPOINT_FORMAT or content["identity"] != identity:
                return False
            for name, module in self._modules().items():
                module.load_state_dict(content["modules"][name])
            torch.set_rng_state(content["random"])
            for worker, state in zip(self.workers, content["workers"], strict=True):
                worker.load_state(state | {"task": _arrays(state["task"])})
            self.curve = [CurvePoint(**point) for point in content["curve"]]
        except (
            OSError,
            LookupError,
            RuntimeError,
            TypeError,
            ValueError,
            AttributeError,
            EOFError,
            pickle.UnpicklingError,
        ) as error:
            raise FileError(path, f"damaged checkpoint ({first_line(error)})", _RESTART) from error
        return True

    def _modules(self) -> dict[str, torch.nn.Module | Adam]:
        return {"actor": self.actor, "critic": self.critic, "optimizer": self.ppo.optimizer}

    def _point(self, rollout: Rollout, losses: Losses, rate: float, wall_s: float) -> CurvePoint:
        ended = rollout.ended
        distance = rollout.distance[ended].numpy()
        success = rollout.terminated[ended].numpy() if self.ends_on_success else distance < REACHED_DISTANCE
        last = self.curve[-1] if self.curve else None
        return CurvePoint(
            step=(self.iteration + 1) * self.settings.rollout * self.agents,
            reward=float(rollout.reward.mean()),
            success_rate=float(success.mean()) if len(success) else (last.success_rate if last else 0.0),
            error_mm=1e3 * float(np.median(distance)) if len(distance) else (last.error_mm if last else 0.0),
            noise=self.actor.log_std.exp().mean().item(),
            learning_rate=rate,
            policy_loss=losses.policy,
            value_loss=losses.value,
            wall_s=wall_s + (last.wall_s if last else 0.0),
        )


def _save(content: dict[str, Any], path: Path) -> None:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    data = buffer.getvalue()
    path.write_bytes(_MAGIC + digest(data) + b"\n" + data)


def _unsealed(path: Path) -> bytes:
    head, _, data = read_bounded(path, CHECKPOINT_MOST, _RESTART).partition(b"\n")
    if head != _MAGIC + digest(data):
        raise FileError(path, "damaged checkpoint (it is not what was written)", _RESTART)
    return data


def _learning_rate(settings: PpoSettings, iteration: int) -> float:
    done = iteration / max(settings.iterations - 1, 1)
    return settings.learning_rate + done * (settings.final_learning_rate - settings.learning_rate)


def _ceiling(settings: PpoSettings, iteration: int) -> float:
    first, last = settings.log_std_ceiling
    return first + (last - first) * min(iteration / max(settings.ceiling_falls * settings.iterations, 1.0), 1.0)


def _tensors(state: dict[str, Any]) -> dict[str, Any]:
    task = {name: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for name, v in state["task"].items()}
    return state | {"task": task}


def _arrays(state: dict[str, Any]) -> dict[str, Any]:
    return {name: value.numpy() if isinstance(value, torch.Tensor) else value for name, value in state.items()}
