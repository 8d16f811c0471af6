"""Counting what a stage costs while it drives an arm."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import cast

import numpy as np

from rejoint.arms import Array
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.logs.runfolder.effort import StageCost, add
from rejoint.logs.runfolder.folder import RunFolder


@dataclass(eq=False)
class Meter:
    """Counts what the robots that it watches do; arms that move side by side in virtual time cost nothing."""

    moving: float = 0.0
    travel: float = 0.0

    def watch(self, robot: Robot) -> Robot:
        """Return the robot as one whose motion is counted."""
        return cast(Robot, _Metered(robot, self)) if robot.count == 1 else robot


class _Metered:
    """One arm whose motion is counted."""

    def __init__(self, robot: Robot, meter: Meter) -> None:
        self._robot, self._meter = robot, meter
        self._before: tuple[float, Array] | None = None

    def __getattr__(self, name: str) -> object:
        return getattr(self._robot, name)

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Pass the command on."""
        state = self._robot.step(command, active)
        now = float(state.time[0]), state.position[0].copy()
        if self._before is not None:
            self._meter.moving += max(now[0] - self._before[0], 0.0)
            turned = np.abs(now[1] - self._before[1])
            self._meter.travel += float(turned[np.isfinite(turned)].sum())
        self._before = now
        return state


@contextmanager
def metered(folder: RunFolder | None, name: str) -> Iterator[Meter]:
    """Count the motion of a stage, and add it to what the run in ``folder`` has cost, also where the stage fails."""
    meter = Meter()
    try:
        yield meter
    finally:
        if folder is not None and meter.moving > 0.0:
            add(folder, StageCost(name=name, moving=meter.moving, travel=meter.travel))
