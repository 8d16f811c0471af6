"""Shared trainings, and their policies at the paper's task.

``worn-0`` is Table 3's training on the paper's P and D, ``healthy-0`` on a normal arm's; the number adds to the seed.
``limit-5`` takes the printed largest action, ``noise-5`` also the joint noise, ``literal`` also the last action as
change of joint angles.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.observation import POINT_SCALE, Observation, layout_slots
from rejoint.control.policy import PolicyController
from rejoint.research.reproduction.experiment import SEEDS, Bench
from rejoint.system.errors import RejointError
from rejoint.system.progress import no_progress
from rejoint.training.presets import PAPER, Preset
from rejoint.training.ranges import PaperRanges, Ranges
from rejoint.training.task import ReachTask
from rejoint.training.train import TrainingOptions, train

WORN = tuple(f"worn-{i}" for i in range(SEEDS))
HEALTHY = tuple(f"healthy-{i}" for i in range(SEEDS))
LIMITED, NOISY, LITERAL = "limit-5", "noise-5", "literal"
LITERALLY = (LIMITED, NOISY, LITERAL)

LITERAL_NOISE = float(np.radians(5.0))
"""[rad] sigma of equation 19"""
LITERAL_LIMIT = float(np.radians(5.0))
"""[rad] joint change per frame; Park et al. 2024, section IV-D"""


def recipe(name: str) -> tuple[Preset, int]:
    """Preset and seed increment of a training."""
    kind, _, number = name.rpartition("-")
    if kind == "worn":
        return PAPER, int(number)
    if kind == "healthy":
        return replace(PAPER, name="paper-healthy", ranges="paper-healthy"), int(number)
    law = replace(PAPER.task.law, authority_floor=LITERAL_LIMIT, authority_limit=LITERAL_LIMIT)
    limited = replace(PAPER, name="paper-limit-5", task=replace(PAPER.task, law=law))
    noisy = replace(limited, name="paper-noise-5", joint_noise=LITERAL_NOISE)
    literal = replace(noisy, name="paper-literal", task=replace(noisy.task, layout="equation-16-action"))
    return {LIMITED: limited, NOISY: noisy, LITERAL: literal}[name], 0


def finish_trainings(bench: Bench, names: Sequence[str]) -> None:
    """Run unfinished trainings in ``bench.threads`` processes."""
    missing = [name for name in names if not bench.training(name).policy.exists()]
    if not missing:
        return
    quiet, count = replace(bench, on_progress=no_progress), len(missing)  # a callback cannot go to another process
    context = multiprocessing.get_context("spawn")  # a fork would copy the state of torch and MuJoCo
    with ProcessPoolExecutor(min(bench.threads, count), mp_context=context, initializer=_begin_worker) as pool:
        waiting = [pool.submit(_work, quiet, name) for name in missing]
        try:
            for number, future in enumerate(as_completed(waiting), start=1):
                if problem := future.result():
                    raise RejointError(problem)
                bench.on_progress(number / count, f"{number} of {count} trainings")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in multiprocessing.active_children():  # their checkpoints are at most a few updates old
                worker.terminate()
            raise


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one


def _work(bench: Bench, name: str) -> str:
    try:
        _train(bench, name)
    except RejointError as error:
        return str(error)
    return ""


def _train(bench: Bench, name: str) -> None:
    preset, offset = recipe(name)
    options = TrainingOptions(
        preset=preset,
        seed=bench.seed + offset,
        agents=bench.scale.agents,
        threads=1,
        iterations=bench.scale.updates,
        snapshot_every=bench.scale.snapshot_every,
        resume=True,
    )
    train(bench.arm, None, out=bench.training(name).path, options=options)


_SEED = 1_000_003
"""Seed increment of the evaluated arms"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Episodes:
    """N episodes, one per arm."""

    reward: Array
    """(N,) accumulated"""
    steps: Array
    """(N,) control cycles"""
    reached: Array
    """(N,) 1 or 0"""
    collided: Array
    """(N,) 1 or 0"""
    tcp: Array
    """(T, N, 3) [m], the start first; NaN after the end"""
    target: Array
    """(N, 3) [m]"""


def worn_ranges(arm: Arm) -> Ranges:
    """Arms with the paper's P and D."""
    return PaperRanges(arm=arm, joint_noise=PAPER.joint_noise)


def healthy_ranges(arm: Arm) -> Ranges:
    """Return normal arms."""
    return PaperRanges.healthy(arm, PAPER.joint_noise)


def play(
    controller: PolicyController, ranges: Ranges, arms: int, *, seed: int, noise: float = 0.0, threads: int = 1
) -> Episodes:
    """Run one episode on each of ``arms`` arms; ``noise``: exploration in units of the action."""
    task = ReachTask(controller.arm, ranges, arms, PAPER.task, seed=_SEED + seed, threads=threads)
    rng = np.random.default_rng(seed)
    observation, _ = task.reset(staggered=False)
    target, paths = _point(observation, "target"), [_point(observation, "tcp")]
    going, reward = np.ones(arms, dtype=bool), np.zeros(arms)
    steps, reached, collided = (np.zeros(arms) for _ in range(3))
    while going.any():
        action = controller.act(observation) + rng.normal(0.0, noise, (arms, controller.arm.joints))
        result = task.step(action)
        reward += np.where(going, result.reward, 0.0)
        steps += going
        reached += going & result.terminated
        collided += going & result.collided
        paths.append(np.where(going[:, None], _point(result.final_observation, "tcp"), np.nan))
        going = going & ~(result.terminated | result.truncated)
        observation = result.observation
    return Episodes(reward=reward, steps=steps, reached=reached, collided=collided, tcp=np.stack(paths), target=target)


def _point(observation: Observation, name: str) -> Array:
    """Point (N, 3) [m] in observations of equation 16."""
    begin = 0
    for slot in layout_slots("equation-16", (observation.shape[1] - 10) // 3):
        if slot.name == name:
            break
        begin += slot.size
    return observation[:, begin : begin + 3].astype(float) / POINT_SCALE
