"""Robots that wrap another one."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rejoint.arms import Arm, Array
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.system.stopping import pause

BEHIND = 1.0
"""[s] of lost time that is not made up for (chosen)"""


class RobotWrapper:
    """Passes everything to ``robot``, also optional methods."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - such as `rejoint.control.servogains.Tunable`
        return getattr(self._robot, name)

    @property
    def arm(self) -> Arm:
        """Kinematics, limits and masses."""
        return self._robot.arm

    @property
    def address(self) -> str:
        """Robot address."""
        return self._robot.address

    @property
    def count(self) -> int:
        """Number of arms."""
        return self._robot.count

    def read(self) -> JointState:
        """Read."""
        return self._robot.read()

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Step."""
        return self._robot.step(command, active)

    def true_tcp(self) -> Array:
        """(B, 3) [m]."""
        return self._robot.true_tcp()

    def stop(self) -> None:
        """Hold."""
        self._robot.stop()

    def close(self) -> None:
        """Close."""
        self._robot.close()


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
