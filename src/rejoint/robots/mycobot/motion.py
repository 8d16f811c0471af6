"""The moving reference of joints.

A *ramp* moves every joint at the set speed; a *path* has limited acceleration and joint arrival.
"""

from collections import deque
from math import ceil, radians
from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, Mask, solve_position, tcp_pose
from rejoint.arms.rotations import Orientation, difference, moved, tool_axis
from rejoint.system.numbers import interpolated

FULL_SPEED = radians(120.0)
"""[rad/s] of the fastest joint at 100 % (chosen: 80 % of the vendor's)"""
ACCELERATION = radians(200.0)
"""[rad/s^2] (vendor's communication protocol page)"""
CARTESIAN_SPEED = 0.1
"""[m/s] on a line (vendor's protocol page)"""
TURN_SPEED = radians(40.0)
"""[rad/s] on a line (same page)"""

_TOLERANCE = 2e-4
"""[m, rad] (chosen)"""
_STEP = 0.005
"""[m] between waypoints (chosen)"""
_TURN_STEP = radians(2.0)
_MAX_JUMP = radians(20.0)
"""[rad] of another branch"""
_STARTS = 24
"""Random start postures (chosen)"""


class TimedPath(NamedTuple):
    """Waypoints and their times at full speed."""

    points: Array
    """(k, n) [rad]"""
    time: Array
    """(k,) [s] from 0"""

    def at(self, time: float) -> Array:
        """Posture (n,) at ``time`` [s]."""
        return interpolated(time, self.time, self.points)

    @property
    def duration(self) -> float:
        """[s] at full speed."""
        return self.time[-1]


def joint_path(start: Array, goal: Array) -> TimedPath:
    """Straight line in joint space, the longest joint at `FULL_SPEED`."""
    turn = np.abs(goal - start).max()
    count = max(1, ceil(turn / _TURN_STEP)) + 1
    return TimedPath(np.linspace(start, goal, count), np.linspace(0.0, turn / FULL_SPEED, count))


def solve_pose(arm: Arm, pose: Array, start: Array) -> Array | None:
    """Posture (n,) of a pose (4, 4) near ``start``, or None."""
    first = _solve(arm, pose, start[None], 100)
    if first is not None:
        return first
    rng = np.random.default_rng(0)
    return _solve(arm, pose, rng.uniform(arm.lower, arm.upper, (_STARTS, arm.joints)), 150, near=start)


def line_path(arm: Arm, start: Array, pose: Array) -> tuple[TimedPath, bool]:
    """Straight tool line from ``start`` as far as possible, and whether it arrives."""
    here = tcp_pose(arm, start)
    change = difference(pose, here)
    length, angle = np.linalg.norm(change.reshape(2, 3), axis=1)
    count = max(1, ceil(length / _STEP), ceil(angle / _TURN_STEP))
    slowest = max(length / CARTESIAN_SPEED, angle / TURN_SPEED) / count
    points, times = [start], [0.0]
    for via in moved(here, np.arange(1, count + 1)[:, None] / count * change):
        point = _solve(arm, via, points[-1][None], 40)
        if point is None or np.abs(point - points[-1]).max() > _MAX_JUMP:
            break
        times.append(times[-1] + max(slowest, np.abs(point - points[-1]).max() / FULL_SPEED))
        points.append(point)
    return TimedPath(np.array(points), np.array(times)), len(points) > count


def _solve(arm: Arm, pose: Array, starts: Array, iterations: int, near: Array | None = None) -> Array | None:
    turn = Orientation(rotation=pose[:3, :3], whole=np.array(True), weight=np.array(1.0), axis=tool_axis(arm))
    found = solve_position(
        arm, pose[:3, 3], starts, turn=turn, tolerance=_TOLERANCE, iterations=iterations, rest_gain=0.0
    )
    if not found.converged.any():
        return None
    good = found.q[found.converged]
    return good[np.argmin(np.abs(good - (starts[0] if near is None else near)).max(axis=1))]


_RISE = ACCELERATION / FULL_SPEED
"""[1/s] by which the rate of a path rises, and falls"""
MAX_QUEUE = 32
"""(chosen)"""


class Motion:
    """The reference of n joints, without a clock."""

    def __init__(self, start: Array) -> None:
        self.reference = start.copy()
        """(n,) [rad]"""
        self.goal = start.copy()
        """(n,) [rad] end of the present move"""
        self.paused = False
        self.ramp_speed = FULL_SPEED
        """[rad/s] in the present ramp"""
        self._path: TimedPath | None = None
        self.queue: deque[tuple[TimedPath, float]] = deque()
        """waiting moves and their rates"""
        self._done, self._rate, self._wanted_rate = 0.0, 0.0, 1.0

    @property
    def moving(self) -> bool:
        """Whether a move is under way or waiting."""
        return bool(self.queue) or self._path is not None or not np.array_equal(self.reference, self.goal)

    @property
    def interpolating(self) -> bool:
        """Whether the firmware writes setpoints."""
        return self._path is not None

    @property
    def end(self) -> Array:
        """(n,) [rad] end of the last move."""
        return (self.queue[-1][0].points[-1] if self.queue else self.goal).copy()

    def ramp(self, goal: Array, rate: float) -> None:
        """Drop all moves; ramp to ``goal`` at ``rate`` (0..1)."""
        self.hold()
        self.goal = goal.copy()
        self.ramp_speed = rate * FULL_SPEED

    def enqueue(self, path: TimedPath, rate: float, *, now: bool = False) -> bool:
        """Queue ``path``, or drop all moves before; False: the queue is full."""
        if now:
            self.hold()
        if not self.moving:
            self._begin(path, rate)
        elif len(self.queue) < MAX_QUEUE:
            self.queue.append((path, rate))
        else:
            return False
        return True

    def hold(self, joint: int | None = None) -> None:
        """Stop one joint of a ramp, or everything."""
        if joint is not None and self._path is None:
            self.goal[joint] = self.reference[joint]
            return
        self.goal = self.reference.copy()
        self._path, self._rate, self.paused = None, 0.0, False
        self.queue.clear()

    def place(self, joints: Mask | int | slice, angles: Array | float) -> None:
        """Set the references of ``joints`` moved by hand."""
        self.reference[joints] = self.goal[joints] = angles

    def advance(self, duration: float) -> None:
        """Advance by a short ``duration`` [s]."""
        if self.paused:
            self._rate = 0.0
            return
        if self._path is None:
            reach = self.ramp_speed * duration
            self.reference = self.reference + np.clip(self.goal - self.reference, -reach, reach)
        else:
            left = self._path.duration - self._done
            half = 0.5 * _RISE * duration  # the braking distance of a speed that falls in steps
            braking = np.sqrt(half**2 + 2.0 * _RISE * max(left, 0.0)) - half
            self._rate = min(self._rate + _RISE * duration, self._wanted_rate, braking)
            self._done += self._rate * duration
            if left <= 1e-9 or self._path.duration - self._done <= 1e-4:
                self.reference, self._path = self.goal.copy(), None
            else:
                self.reference = self._path.at(self._done)
        if self._path is None and self.queue and np.array_equal(self.reference, self.goal):
            self._begin(*self.queue.popleft())

    def _begin(self, path: TimedPath, rate: float) -> None:
        self._path, self._done, self._rate, self._wanted_rate = path, 0.0, 0.0, rate
        self.goal = path.points[-1].copy()
