"""Virtual time slowed down to the wall clock, so that programs and people can keep up with it."""

from __future__ import annotations

import time
from collections.abc import Callable

from rejoint.arms import Array
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.system.stopping import pause

BEHIND = 1.0
"""[s] from which lost time is not made up for (chosen: this machine cannot keep up, or was suspended)"""


class WallClock:
    """A robot of virtual time slowed down to ``pace()`` simulated seconds per second, which may change at any time."""

    def __init__(self, robot: Robot, pace: Callable[[], float] = lambda: 1.0) -> None:
        self._robot, self._pace = robot, pace
        self._due: float | None = None  # [s] of the wall clock, until when the last step is to take
        self._time = 0.0  # [s] of the arm that is farthest

    def __getattr__(self, name: str) -> object:
        return getattr(self._robot, name)

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Step, and wait until as much time has passed."""
        state = self._robot.step(command, active)
        now, reached = time.monotonic(), float(state.time.max())
        if self._due is None or now - self._due > BEHIND:
            self._due = now
        else:
            self._due += max(reached - self._time, 0.0) / self._pace()
        self._time = reached
        pause(self._due - now)
        return state
