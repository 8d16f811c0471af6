"""From requests to a moving reference.

A *ramp* moves every joint at the set speed; a *path* has limited acceleration and joint arrival.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, solve_position, tcp_pose
from rejoint.arms import Mask as Mask
from rejoint.arms.rotations import Orientation, difference, moved, tool_axis

FULL_SPEED = float(np.radians(120.0))
"""[rad/s] of the fastest joint at 100 % (chosen: 80 % of the vendor's)"""
ACCELERATION = float(np.radians(200.0))
"""[rad/s^2] (vendor's communication protocol page)"""
NO_SOLUTION, NO_LINE, COLLISION = 32, 33, 16
"""Error codes of the vendor's ``get_error_information``; 1..6: joint over its limit; 16: any contact"""
ARRIVED_ANGLE, ARRIVED_LENGTH = float(np.radians(1.0)), 0.003
"""[rad], [m] (chosen)"""


def at_angles(here: Array, angles: Array) -> bool:
    """Whether ``here`` (n,) [rad] is within a degree of ``angles``."""
    return bool((np.abs(here - angles) < ARRIVED_ANGLE).all())


def at_place(here: Array, pose: Array) -> bool:
    """Whether ``here`` (4, 4) is within 3 mm and a degree of ``pose``."""
    shift, turn = np.linalg.norm(difference(here, pose).reshape(2, 3), axis=1)
    return bool(shift < ARRIVED_LENGTH and turn < ARRIVED_ANGLE)


class Sensed(NamedTuple):
    """What the servos measure, (n,) each."""

    speed: Array
    """[rad/s]"""
    current: Array
    """[A]"""
    voltage: Array
    """[V]"""
    temperature: Array
    """[deg C]"""
    alarms: NDArray[np.uint8]
    """status bits"""


class Mover(ABC):
    """Computer of an arm of n joints, at ``start`` (n,) [rad]."""

    powered = True

    def __init__(self, arm: Arm, start: Array) -> None:
        self.arm = arm
        self.enabled: Mask = np.ones(arm.joints, dtype=bool)
        """(n,)"""
        self.lower, self.upper = arm.lower.copy(), arm.upper.copy()
        self.fresh = False
        """a new move replaces the present one, else is queued"""
        self.error = 0
        """as in ``get_error_information``"""
        self._motion = Motion(start)

    @property
    @abstractmethod
    def angles(self) -> Array:
        """(n,) [rad] measured."""

    @property
    @abstractmethod
    def moving(self) -> bool:
        """Whether a move is under way."""

    @property
    @abstractmethod
    def sensed(self) -> Sensed:
        """What else is measured."""

    @abstractmethod
    def stop(self, joint: int | None = None) -> None:
        """Hold: one joint, or the arm."""

    def pause(self) -> None:
        """Hold where the reference is, until `resume`."""
        self._motion.paused = True

    def resume(self) -> None:
        """Continue."""
        self._motion.paused = False

    def power(self, on: bool) -> None:  # noqa: B027 - nothing is a sensible answer
        """Power all servos."""

    def enable(self, wanted: Mask) -> None:  # noqa: B027 - nothing is a sensible answer
        """Hold with the servos in ``wanted`` (n,); release the others."""

    def calibrate(self, joint: int) -> None:  # noqa: B027 - nothing is a sensible answer
        """Set a joint's zero here."""

    @property
    def pose(self) -> Array:
        """(4, 4) TCP pose."""
        return tcp_pose(self.arm, self.angles)

    def in_position(self, angles: Array) -> bool:
        """Whether the arm is at ``angles`` (n,) [rad], as `at_angles`."""
        return at_angles(self.angles, angles)

    def at_pose(self, pose: Array) -> bool:
        """Whether the TCP is at ``pose`` (4, 4), as `at_place`."""
        return at_place(self.pose, pose)

    @property
    def planned_angles(self) -> Array:
        """(n,) [rad]."""
        return self._motion.reference.copy()

    @property
    def destination(self) -> Array:
        """(n,) [rad]."""
        return self._motion.end

    @property
    def paused(self) -> bool:
        """Whether a move is suspended."""
        return self._motion.paused

    def clear_queue(self) -> None:
        """Drop waiting moves."""
        self._motion.queue.clear()

    def move_joints(self, angles: Array, rate: float) -> bool:
        """Move to ``angles`` (n,) [rad]; False beyond a limit."""
        inside = (angles >= self.lower - 1e-9) & (angles <= self.upper + 1e-9)
        if not inside.all():
            self.error = int(np.argmin(inside)) + 1
            return False
        if not self._is_clear(angles) or not self._ready():
            return False
        if not self.fresh:
            return self._motion.enqueue(joint_path(self.destination, angles), rate)
        self._motion.ramp(angles, rate)
        self._write(rate * FULL_SPEED, angles)
        return True

    def move_tool(self, pose: Array, rate: float, *, straight: bool, turned: bool = True) -> bool:
        """Bring the tool to ``pose`` (4, 4); False, and an error code, where no posture does.

        Without ``turned`` orientation is kept where possible.
        """
        start = self.planned_angles if self.fresh else self.destination
        if not straight:
            goal = self._posture(pose, start, turned=turned)
            if goal is None:
                self.error = NO_SOLUTION
            return goal is not None and self.move_joints(goal, rate)
        path, complete = line_path(self.arm, start, pose)
        if not complete or self._reach(path) < len(path.points):
            self.error = NO_LINE
            return False
        if not self._is_clear(path.points[-1]) or not self._ready():
            return False
        return self._motion.enqueue(path, rate, now=self.fresh)

    def jog_joint(self, joint: int, forwards: int, rate: float) -> bool:
        """Run one joint to its limit or a stop."""
        goal = self.planned_angles
        goal[joint] = self.upper[joint] if forwards else self.lower[joint]
        path = joint_path(self.planned_angles, np.clip(goal, self.lower, self.upper))
        return self._ready() and self._motion.enqueue(path, rate, now=True)

    def jog_tool(self, pose: Array, rate: float) -> bool:
        """Run the tool straight to ``pose`` (4, 4)."""
        path, _ = line_path(self.arm, self.planned_angles, pose)
        reach = self._reach(path)
        if reach < 2:
            self.error = NO_LINE
            return False
        within = TimedPath(path.points[:reach], path.time[:reach])
        return self._ready() and self._motion.enqueue(within, rate, now=True)

    def _posture(self, pose: Array, start: Array, *, turned: bool) -> Array | None:  # noqa: ARG002 - always turned here
        """Return a posture (n,) [rad] for a pose (4, 4), or None."""
        return solve_pose(self.arm, pose, start)

    def _is_clear(self, angles: Array) -> bool:  # noqa: ARG002 - the vendor's computer does not look
        """Whether ``angles`` (n,) [rad] are clear; else sets an error code."""
        return True

    def _ready(self) -> bool:
        return True

    def _write(self, speed: float, goal: Array) -> None:  # noqa: B027 - nothing is a sensible answer
        """Send a ramp to ``goal`` (n,) [rad] at ``speed`` [rad/s] to the servos."""

    def _reach(self, path: TimedPath) -> int:
        inside: Mask = np.all((path.points >= self.lower) & (path.points <= self.upper), axis=1)
        return int(np.argmin(np.append(inside, False)))


CARTESIAN_SPEED = 0.1
"""[m/s] on a line (vendor's protocol page)"""
TURN_SPEED = np.radians(40.0)
"""[rad/s] on a line (same page)"""

_TOLERANCE = 2e-4
"""[m, rad] (chosen)"""
_STEP = 0.005
"""[m] between waypoints (chosen)"""
_TURN_STEP = np.radians(2.0)
_MAX_JUMP = np.radians(20.0)
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
        return np.array([np.interp(time, self.time, column) for column in self.points.T])

    @property
    def duration(self) -> float:
        """[s] at full speed."""
        return float(self.time[-1])


def joint_path(start: Array, goal: Array) -> TimedPath:
    """Straight line in joint space, the longest joint at `FULL_SPEED`."""
    return TimedPath(np.stack([start, goal]), np.array([0.0, np.abs(goal - start).max() / FULL_SPEED]))


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
    count = max(1, int(np.ceil(max(length / _STEP, angle / _TURN_STEP))))
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
    good: Array = found.q[found.converged]
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
            self._advance_path(self._path, duration)
        if self._path is None and self.queue and np.array_equal(self.reference, self.goal):
            self._begin(*self.queue.popleft())

    def _begin(self, path: TimedPath, rate: float) -> None:
        self._path, self._done, self._rate, self._wanted_rate = path, 0.0, 0.0, rate
        self.goal = path.points[-1].copy()

    def _advance_path(self, path: TimedPath, duration: float) -> None:
        left = path.duration - self._done
        half = 0.5 * _RISE * duration  # the braking distance of a speed that falls in steps
        braking = np.sqrt(half**2 + 2.0 * _RISE * max(left, 0.0)) - half
        self._rate = min(self._rate + _RISE * duration, self._wanted_rate, braking)
        self._done += self._rate * duration
        if left <= 1e-9 or path.duration - self._done <= 1e-4:
            self.reference, self._path = self.goal.copy(), None
        else:
            self.reference = path.at(self._done)
