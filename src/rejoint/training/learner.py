"""The training loop: rollout workers act, skrl's PPO learns."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from rejoint.arms import Array, Mask
from rejoint.training.ppo import Actor, Critic, Ppo, Rollout, join
from rejoint.training.presets import PpoSettings
from rejoint.training.task import ReachTask


class RolloutWorker:
    """The agents of one task with their exploration noise."""

    def __init__(self, task: ReachTask, *, seed: int) -> None:
        self.task = task
        self._exploration = torch.Generator().manual_seed(seed)
        self._observation, self._privileged = (torch.from_numpy(array) for array in task.reset())

    @torch.no_grad()
    def roll(self, actor: Actor, critic: Critic, cycles: int) -> Rollout:
        """Act for some control cycles."""
        rows = []
        for _ in range(cycles):
            action, density = actor.sample(self._observation, self._exploration)
            seen = {
                "observations": self._observation,
                "states": self._privileged,
                "actions": action,
                "log_prob": density,
            }
            found = {name: torch.from_numpy(value) for name, value in self.task.step(action.numpy())._asdict().items()}
            rows.append(seen | found)
            self._observation, self._privileged = found["observation"], found["privileged"]
        rollout = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
        late, final = rollout["truncated"], torch.zeros(rollout["truncated"].shape)
        final[late] = critic.value(*(rollout[f"final_{name}"][late] for name in ("observation", "privileged")))
        return rollout | {"values": critic.value(rollout["observations"], rollout["states"]), "final_value": final}


T = TypeVar("T")

PRECISION = "medium"
"""Of matrix products in PPO: bfloat16 factors, float32 sums; chosen for speed"""


@contextmanager
def setting(get: Callable[[], T], put: Callable[[T], object], value: T) -> Iterator[None]:
    """Hold a setting of the whole process at ``value`` within the block."""
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
        start: Tensor | None = None,
    ) -> None:
        """Take one task per worker; ``threads`` run at once, without effect on the result.

        The actor's weights are ``start``, else random.
        """
        torch.manual_seed(seed)
        size, self.threads = tasks[0].observer.size, threads
        self.settings, self.agents = settings, sum(task.agents for task in tasks)
        self.ends_on_success = tasks[0].ends_on_success
        self.actor = Actor(size, tasks[0].arm.joints, settings.actor_layers, settings.log_std)
        if start is not None:
            torch.nn.utils.vector_to_parameters(start, self.actor.net.parameters())
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
        start, s, done = time.perf_counter(), self.settings, self.iteration
        self.actor.ceiling = float(np.interp(done, (0.0, max(s.ceiling_falls * s.iterations, 1.0)), s.log_std_ceiling))
        rate = float(np.interp(done, (0, max(s.iterations - 1, 1)), (s.learning_rate, s.final_learning_rate)))
        precision = setting(torch.get_float32_matmul_precision, torch.set_float32_matmul_precision, PRECISION)
        with precision, on_threads(LEARNING_THREADS):
            rollout = self._roll()
            self.actor.requires_grad_(done >= s.critic_first)
            losses = self.ppo.learn(rollout, rate, iteration=done)
        last = self.curve[-1] if self.curve else None
        ended = rollout["terminated"] | rollout["truncated"]
        distance = rollout["distance"][ended].numpy()
        success = rollout["terminated"][ended].numpy() if self.ends_on_success else distance < REACHED_DISTANCE
        self.curve.append(
            CurvePoint(
                step=(done + 1) * s.rollout * self.agents,
                reward=float(rollout["reward"].float().mean()),
                **ends(distance, success, last),
                noise=self.actor.log_std.exp().mean().item(),
                learning_rate=rate,
                policy_loss=losses[0],
                value_loss=losses[1],
                wall_s=time.perf_counter() - start + (last.wall_s if last else 0.0),
            )
        )
        return self.curve[-1]

    def _roll(self) -> Rollout:
        """Run all workers, each on one thread; torch's number of threads is per thread."""
        pool = ThreadPoolExecutor(self.threads, initializer=partial(torch.set_num_threads, 1))
        with pool, setting(sys.getswitchinterval, sys.setswitchinterval, SWITCH_INTERVAL):
            cycles = self.settings.rollout
            return join(list(pool.map(lambda worker: worker.roll(self.actor, self.critic, cycles), self.workers)))


def ends(distance: Array, success: Mask, last: CurvePoint | None) -> dict[str, float]:
    """Return success rate and median error of targets that ended at ``distance`` [m]; where none did, the ``last``."""
    if len(distance):
        return {"success_rate": float(success.mean()), "error_mm": 1e3 * float(np.median(distance))}
    return {"success_rate": last.success_rate if last else 0.0, "error_mm": last.error_mm if last else 0.0}
