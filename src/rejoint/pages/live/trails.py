"""What is left of the last seconds: the trail of the tool, where its target went, and the error over time."""

from __future__ import annotations

from collections import deque

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.pages.live.ring import Records

TRAIL = 400
"""Points of a trail (chosen: at `APART` that is 0.8 m, more than one sees at a time)"""
APART = 2e-3
"""[m] between points of a trail (chosen: the eye does not see the corners)"""
MOVES = 5
"""Points of its way from which a target is one that moves: others are aimed at anew by a little (chosen)"""
SPAN, EVERY = 30.0, 0.1
"""[s] length of the curve, and between its points (chosen: seven targets; a window of a browser has no more pixels)"""


class Trails:
    """Keeps what a page draws of one arm besides its posture."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._tool: deque[Array] = deque(maxlen=TRAIL)
        self._target: deque[Array] = deque(maxlen=TRAIL)
        self._curve: deque[tuple[float, float, float]] = deque(maxlen=round(SPAN / EVERY))
        self._run, self._begun, self._next = -1.0, 0.0, -np.inf
        self.errors = (np.nan, np.nan)
        """[m] newest encoder error and true error; NaN where there is no target, or nobody knows"""

    def follow(self, records: Records) -> None:
        """Take over what came since the last call."""
        if not len(records):
            return
        tool = tcp_position(self._arm, records.position)
        error = np.linalg.norm(records.aim - tool, axis=-1)
        true = np.linalg.norm(records.target - records.true_tcp, axis=-1)
        for k in range(len(records)):
            now = self._clock(float(records.run[k]), float(records.time[k]))
            _extend(self._tool, tool[k])
            _extend(self._target, records.aim[k])
            if now >= self._next:
                self._curve.append((now, error[k], true[k]))
                self._next = now + EVERY
        self.errors = float(error[-1]), float(true[-1])

    @property
    def tool(self) -> Array:
        """(P, 3) [m] trail of the tool, by the encoders."""
        return np.array(self._tool).reshape(-1, 3)

    @property
    def target(self) -> Array:
        """(P, 3) [m] way of an aim that moves; one that jumps leaves none."""
        return np.array(self._target).reshape(-1, 3)

    @property
    def moves(self) -> bool:
        """Whether the target moves."""
        return len(self._target) > MOVES

    @property
    def curve(self) -> tuple[Array, Array, Array]:
        """(M,) [s] since the beginning, (M,) [m] encoder error, (M,) [m] true error; NaN where there is none."""
        t, error, true = np.array(self._curve).reshape(-1, 3).T
        return t, error, true

    def _clock(self, run: float, time: float) -> float:
        """Return the time [s] on a clock that goes on over runs, each of which may have another one."""
        if run != self._run:
            last = self._curve[-1][0] if self._curve else 0.0
            self._run, self._begun = run, time - last
        return time - self._begun


def _extend(trail: deque[Array], point: Array) -> None:
    """Add a point that is far enough from the last; what jumps farther than it could move begins a new trail."""
    if not np.isfinite(point).all():
        return
    way = np.inf if not trail else float(np.linalg.norm(point - trail[-1]))
    if way > 25.0 * APART:
        trail.clear()
    if way > APART:
        trail.append(point.copy())
