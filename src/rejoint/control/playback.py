"""Motions without a target, through the one control loop: trajectories that are played, and ways to a posture."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rejoint.arms import Array
from rejoint.control.controller import ControlInput
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import OnCycle, Recording
from rejoint.control.robot import Mask, Robot
from rejoint.control.runstate import in_force


def play(
    robot: Robot,
    trajectory: Callable[[Array], Array],
    duration: float,
    *,
    limits: GuardLimits | None = None,
    on_cycle: OnCycle | None = None,
) -> Recording:
    """Send ``trajectory(time)`` for ``duration`` [s], without a target.

    ``trajectory`` turns times since the start (B,) [s] into commands (B, n) [rad]. Loop and guard
    are those of `run`: a trajectory faster than the guard allows is slowed down, not followed.
    """
    targets = np.full((robot.count, 1, 3), np.nan)
    return run(robot, Playback(trajectory), targets, Schedule(dwell=duration), limits=limits, on_cycle=on_cycle)


def move(
    robot: Robot,
    posture: Array,
    *,
    sent: Array | None = None,
    speed: float = 0.5,
    settle: float = 1.0,
    limits: GuardLimits | None = None,
    give_up: Callable[[ControlInput], Mask] | None = None,
    on_cycle: OnCycle | None = None,
) -> Recording:
    """Bring every arm to ``posture`` (n,) [rad] at ``speed`` [rad/s] of its farthest joint and wait ``settle`` [s].

    The way starts at the last command ``sent`` (B, n) [rad], by default at the measured position, as it does for an
    arm that is no longer where that command left it.
    The default speed is chosen: a fifth of what the joints can do. ``give_up`` is that of a `Schedule`.
    """
    state = robot.read()
    start = np.array(state.position if sent is None else in_force(state, sent), dtype=float)
    way = posture - start
    duration = max(float(np.abs(way).max()) / speed, 1e-3)

    def trajectory(time: Array) -> Array:
        return start + np.minimum(time / duration, 1.0)[:, None] * way

    schedule = Schedule(dwell=duration + settle, sent=start, give_up=give_up)
    nowhere = np.full((robot.count, 1, 3), np.nan)
    return run(robot, Playback(trajectory), nowhere, schedule, limits=limits, on_cycle=on_cycle)


class Playback:
    """Controller that follows a trajectory by the clock."""

    name = "playback"

    def __init__(self, trajectory: Callable[[Array], Array]) -> None:
        self._trajectory = trajectory

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Do nothing: the clock is that of the inputs."""

    def command(self, inputs: ControlInput) -> Array:
        """Return the trajectory's posture (B, n) [rad] at this time."""
        return self._trajectory(inputs.since_target)
