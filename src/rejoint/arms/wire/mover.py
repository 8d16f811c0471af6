"""From what a request asks for to a way of the reference: the same for the emulated arm and for one that is served.

Where neither the vendor's manual nor logs of a real arm settle what the vendor's firmware does, the choice is named.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.wire.computer import ACCELERATION, FULL_SPEED, NO_LINE, NO_SOLUTION
from rejoint.arms.wire.motion import Motion
from rejoint.arms.wire.paths import TimedPath, joint_path, line_path, solve_pose


class Mover:
    """Plans the moves of an arm whose reference begins at ``start`` (n,) [rad]."""

    def __init__(self, arm: Arm, start: Array) -> None:
        self.arm = arm
        self.lower, self.upper = arm.lower.copy(), arm.upper.copy()
        self.fresh = False
        self.error = 0
        self._motion = Motion(start, full_speed=FULL_SPEED, acceleration=ACCELERATION)

    @property
    def planned_angles(self) -> Array:
        """(n,) [rad] where the reference is."""
        return self._motion.reference.copy()

    @property
    def destination(self) -> Array:
        """(n,) [rad] where the last of the planned moves ends."""
        return self._motion.end

    @property
    def paused(self) -> bool:
        """Whether a move is suspended."""
        return self._motion.paused

    def move_joints(self, angles: Array, rate: float) -> bool:
        """Go to ``angles`` (n,) [rad]; False, and an error code, if they break a limit.

        In fresh mode the servos get the goal at once and ramp to it by themselves; otherwise the
        move joins the queue and is interpolated.
        """
        beyond = ~((angles >= self.lower - 1e-9) & (angles <= self.upper + 1e-9))
        if beyond.any():
            self.error = int(np.argmax(beyond)) + 1
            return False
        if not self._is_clear(angles) or not self._ready():
            return False
        if not self.fresh:
            return self._take(joint_path(self.destination, angles, FULL_SPEED), rate, replace=False)
        self._motion.ramp(angles, rate)
        self._ramped(rate * FULL_SPEED, angles)
        return True

    def move_tool(self, pose: Array, rate: float, *, straight: bool) -> bool:
        """Bring the tool to ``pose`` (4, 4); False, and an error code, if no posture does it."""
        start = self.planned_angles if self.fresh else self.destination
        if not straight:
            goal = solve_pose(self.arm, pose, start)
            if goal is None:
                self.error = NO_SOLUTION
                return False
            return self.move_joints(goal, rate)
        path, complete = line_path(self.arm, start, pose, FULL_SPEED)
        if not complete or not self._within_limits(path):
            self.error = NO_LINE
            return False
        if not self._is_clear(path.points[-1]):
            return False
        return self._ready() and self._take(path, rate, replace=self.fresh)

    def jog_joint(self, joint: int, direction: int, rate: float) -> bool:
        """Run one joint until its limit or a stop."""
        goal = self.planned_angles
        goal[joint] = self.upper[joint] if direction > 0 else self.lower[joint]
        path = joint_path(self.planned_angles, np.clip(goal, self.lower, self.upper), FULL_SPEED)
        return self._ready() and self._take(path, rate, replace=True)

    def jog_tool(self, pose: Array, rate: float) -> bool:
        """Run the tool straight towards ``pose`` (4, 4) as far as the arm reaches, or until a stop."""
        path, _ = line_path(self.arm, self.planned_angles, pose, FULL_SPEED)
        inside = np.all((path.points >= self.lower) & (path.points <= self.upper), axis=1)
        reach = len(inside) if inside.all() else int(np.argmin(inside))
        if reach < 2:
            self.error = NO_LINE
            return False
        return self._ready() and self._take(
            TimedPath(points=path.points[:reach], time=path.time[:reach]), rate, replace=True
        )

    def clear_queue(self) -> None:
        """Forget the waiting moves."""
        self._motion.clear_queue()

    def _is_clear(self, angles: Array) -> bool:  # noqa: ARG002 - the vendor's computer does not look
        """Whether nothing is touched at ``angles`` (n,) [rad]; else an error code."""
        return True

    def _ready(self) -> bool:
        """Whether a move may start."""
        return True

    def _ramped(self, speed: float, goal: Array) -> None:
        """Take note that the reference ramps to ``goal`` (n,) [rad] at ``speed`` [rad/s]."""

    def _within_limits(self, path: TimedPath) -> bool:
        return bool(np.all((path.points >= self.lower) & (path.points <= self.upper)))

    def _take(self, path: TimedPath, rate: float, *, replace: bool) -> bool:
        if replace:
            self._motion.follow(path, rate)
        elif not self._motion.enqueue(path, rate):
            return False
        return True
