"""Robots that wrap another one."""

from __future__ import annotations

import time
from collections.abc import Callable

from rejoint.arms import Array
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.system.stopping import pause

BEHIND = 1.0
"""[s] of lost time that is not made up for (chosen)"""


class RobotWrapper:
    """Passes on to ``robot``; what else that can do finds `rejoint.control.robot.part_of`."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.arm, self.address, self.count = robot, robot.arm, robot.address, robot.count

    def read(self) -> JointState:
        """Read."""
        return self.robot.read()

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Step."""
        return self.robot.step(command, active)

    def true_tcp(self) -> Array:
        """(B, 3) [m]."""
        return self.robot.true_tcp()

    def stop(self) -> None:
        """Hold."""
        self.robot.stop()

    def close(self) -> None:
        """Close."""
        self.robot.close()


class WallClock(RobotWrapper):
    """Slows virtual time to ``pace()`` simulated seconds per second."""

    def __init__(self, robot: Robot, pace: Callable[[], float] = lambda: 1.0) -> None:
        super().__init__(robot)
        self._pace = pace
        self._due: float | None = None  # [s] of the wall clock, until when the last step is to take
        self._time = 0.0  # [s] of the arm that is farthest

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Step, and wait for the time."""
        state = super().step(command, active)
        now, reached = time.monotonic(), float(state.time.max())
        if self._due is None or now - self._due > BEHIND:
            self._due = now
        else:
            self._due += max(reached - self._time, 0.0) / self._pace()
        self._time = reached
        pause(self._due - now)
        return state
