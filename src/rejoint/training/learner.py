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

from rejoint.arms import Array
from rejoint.control.robot import Mask
from rejoint.system.errors import FileError, first_line
from rejoint.system.files import MEGABYTE, digest, read_bounded, write_whole
from rejoint.training.export import WarmStart
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

    def state(self) -> dict[str, Any]:
        """State for a checkpoint."""
        return {
            "exploration": self._exploration.get_state(),
            "observation": self._observation,
            "privileged": self._privileged,
            "task": {
                name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
                for name, value in self.task.state().items()
            },
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state`, bit for bit."""
        self._exploration.set_state(state["exploration"])
        self._observation, self._privileged = state["observation"], state["privileged"]
        self.task.load_state(state["task"])


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

_CHECKPOINT_FORMAT = 8

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
            torch.nn.utils.vector_to_parameters(start.vector, self.actor.net.parameters())
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

    def save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write a checkpoint for the training ``identity``."""
        content = {
            "format": _CHECKPOINT_FORMAT,
            "identity": identity,
            "modules": {name: module.state_dict() for name, module in self._modules().items()},
            "random": torch.get_rng_state(),
            "workers": [worker.state() for worker in self.workers],
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
                worker.load_state(state)
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

    def _modules(self) -> dict[str, torch.nn.Module | torch.optim.Optimizer]:
        return {"actor": self.actor, "critic": self.critic, "optimizer": self.ppo.optimizer}


def ends(distance: Array, success: Mask, last: CurvePoint | None) -> dict[str, float]:
    """Return success rate and median error of targets that ended at ``distance`` [m]; where none did, the ``last``."""
    if len(distance):
        return {"success_rate": float(success.mean()), "error_mm": 1e3 * float(np.median(distance))}
    return {"success_rate": last.success_rate if last else 0.0, "error_mm": last.error_mm if last else 0.0}


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
