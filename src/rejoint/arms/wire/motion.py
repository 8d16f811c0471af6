"""Where the firmware's reference is and where it is going: newest command wins, or a queue.

Two laws move the reference. A *ramp* moves every joint on its own at the set speed towards the
goal, as the servos do by themselves when a new goal is written to them. A *path* is interpolated
by the firmware, all joints arriving together, with limited acceleration.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from rejoint.arms import Array
from rejoint.arms.wire.paths import TimedPath

MAX_QUEUE = 32
"""Moves kept waiting; further ones are refused (chosen)."""


class Motion:
    """The reference of an arm of n joints; knows no clock, only durations."""

    def __init__(self, start: Array, *, full_speed: float, acceleration: float) -> None:
        self.reference = start.copy()
        """(n,) [rad]"""
        self.goal = start.copy()
        """(n,) [rad] where the present move ends"""
        self.paused = False
        self._full_speed = full_speed
        self._acceleration = acceleration / full_speed
        self.ramp_speed = full_speed
        """[rad/s] of every joint in the present ramp"""
        self._path: TimedPath | None = None
        self._queue: deque[tuple[TimedPath, float]] = deque()
        self._done = 0.0
        self._rate = 0.0
        self._wanted_rate = 1.0

    @property
    def moving(self) -> bool:
        """Whether the reference has not arrived or moves are waiting."""
        return bool(self._queue) or self._path is not None or bool(np.any(self.reference != self.goal))

    @property
    def interpolating(self) -> bool:
        """Whether the firmware itself must write set-points."""
        return self._path is not None

    @property
    def waiting(self) -> int:
        """Number of moves in the queue behind the present one."""
        return len(self._queue)

    @property
    def end(self) -> Array:
        """(n,) [rad] where the last move of the queue ends."""
        return (self._queue[-1][0].points[-1] if self._queue else self.goal).copy()

    def ramp(self, goal: Array, rate: float) -> None:
        """Forget everything else and let every joint run to ``goal`` at ``rate`` (0..1) of full speed."""
        self.hold()
        self.goal = goal.copy()
        self.ramp_speed = rate * self._full_speed

    def follow(self, path: TimedPath, rate: float) -> None:
        """Forget everything else and follow ``path``."""
        self.hold()
        self._begin(path, rate)

    def enqueue(self, path: TimedPath, rate: float) -> bool:
        """Follow ``path`` when all earlier moves are done; False if the queue is full."""
        if self._path is None and not self._queue and not self.moving:
            self._begin(path, rate)
        elif len(self._queue) < MAX_QUEUE:
            self._queue.append((path, rate))
        else:
            return False
        return True

    def hold(self, joint: int | None = None) -> None:
        """Stop where the reference is now: one joint of a ramp, or everything."""
        if joint is not None and self._path is None:
            self.goal[joint] = self.reference[joint]
            return
        self.goal = self.reference.copy()
        self._path, self._rate, self.paused = None, 0.0, False
        self._queue.clear()

    def clear_queue(self) -> None:
        """Forget the waiting moves; finish the present one."""
        self._queue.clear()

    def place(self, joint: int, angle: float) -> None:
        """Put the reference of one joint somewhere else: its servo was moved by hand."""
        self.reference[joint] = self.goal[joint] = angle

    def advance(self, duration: float) -> None:
        """Let ``duration`` [s] pass; short against the motion, for paths are integrated in one step."""
        if self.paused:
            self._rate = 0.0
            return
        if self._path is None:
            reach = self.ramp_speed * duration
            self.reference = self.reference + np.clip(self.goal - self.reference, -reach, reach)
            if self._queue and not np.any(self.reference != self.goal):
                self._begin(*self._queue.popleft())
            return
        self._advance_path(self._path, duration)

    def _begin(self, path: TimedPath, rate: float) -> None:
        self._path, self._done, self._rate, self._wanted_rate = path, 0.0, 0.0, rate
        self.goal = path.points[-1].copy()

    def _advance_path(self, path: TimedPath, duration: float) -> None:
        left = path.duration - self._done
        half = 0.5 * self._acceleration * duration  # the braking distance of a speed that falls in steps
        braking = np.sqrt(half**2 + 2.0 * self._acceleration * max(left, 0.0)) - half
        self._rate = min(self._rate + self._acceleration * duration, self._wanted_rate, braking)
        self._done += self._rate * duration
        if left <= 1e-9 or path.duration - self._done <= 1e-4:
            self.reference = self.goal.copy()
            self._path = None
            if self._queue:
                self._begin(*self._queue.popleft())
        else:
            self.reference = path.at(self._done)
