"""Policies in the paper's own task: one episode per arm, with reward and steps as its Fig. 12 counts them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.observation import POINT_SCALE, Observation, layout_slots
from rejoint.control.policy import PolicyController
from rejoint.training.presets import PAPER
from rejoint.training.ranges import PaperRanges, Ranges
from rejoint.training.task import ReachTask

_SEED = 1_000_003
"""Added to the seed of arms that policies are judged on, so that they are others than those of the training."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Episodes:
    """N episodes, one per arm."""

    reward: Array
    """(N,) accumulated"""
    steps: Array
    """(N,) control cycles until the target was reached, the arm collided, or time was out"""
    reached: Array
    """(N,) 1 or 0"""
    collided: Array
    """(N,) 1 or 0"""
    tcp: Array
    """(T, N, 3) [m] TCP after each cycle, the start first; NaN after an episode's end"""
    target: Array
    """(N, 3) [m]"""


def worn_ranges(arm: Arm) -> Ranges:
    """Arms as the paper's P and D make them."""
    return PaperRanges(arm=arm, joint_noise=PAPER.joint_noise)


def healthy_ranges(arm: Arm) -> Ranges:
    """Return the same task on a normal arm."""
    return PaperRanges.healthy(arm, PAPER.joint_noise)


def play(
    controller: PolicyController, ranges: Ranges, arms: int, *, seed: int, noise: float = 0.0, threads: int = 1
) -> Episodes:
    """Run one episode on each of ``arms`` arms drawn from ``ranges``.

    ``noise`` is the standard deviation of exploration in units of the action; without it the policy is the one
    that is deployed.
    """
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
    return Episodes(
        reward=reward, steps=steps, reached=reached, collided=collided, tcp=np.stack(paths), target=target
    )  # fmt: skip


def _point(observation: Observation, name: str) -> Array:
    """One of the points (N, 3) [m] in observations of equation 16."""
    begin = 0
    for slot in layout_slots("equation-16", (observation.shape[1] - 10) // 3):
        if slot.name == name:
            break
        begin += slot.size
    return observation[:, begin : begin + 3].astype(float) / POINT_SCALE
