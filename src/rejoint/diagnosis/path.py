"""Building a piecewise linear joint trajectory, segment by segment."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from rejoint.arms import Array
from rejoint.diagnosis.segments import Segment


class CommandPath:
    """Knots of a trajectory that grows from a start posture (n,) [rad] at time 0."""

    def __init__(self, start: Array) -> None:
        self._time = [0.0]
        self._position = [np.array(start, dtype=float)]
        self._segments: list[Segment] = []

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Segments so far."""
        return tuple(self._segments)

    @property
    def end(self) -> Array:
        """(n,) [rad] where the trajectory has come to."""
        return self._position[-1]

    @contextmanager
    def segment(self, name: str, kind: str, joints: tuple[int, ...] = ()) -> Iterator[None]:
        """Give what is added inside the ``with`` block a name."""
        start = self._time[-1]
        yield
        self._segments.append(Segment(name=name, kind=kind, start=start, stop=self._time[-1], joints=joints))

    def wait(self, duration: float) -> None:
        """Stay for ``duration`` [s]."""
        self._add(duration, self._position[-1])

    def travel(self, goal: Array, speed: float) -> None:
        """Go straight to ``goal`` (n,) [rad]; the joint with the longest way moves at ``speed`` [rad/s]."""
        self._add(float(np.abs(goal - self._position[-1]).max()) / speed, goal)

    def follow(self, time: Array, position: Array) -> None:
        """Append samples (K,) [s] from 0 and (K, n) [rad] that begin at the present posture."""
        begin = self._time[-1]
        self._time.extend((begin + time[1:]).tolist())
        self._position.extend(position[1:])

    def knots(self) -> tuple[Array, Array]:
        """Return times (K,) [s] and positions (K, n) [rad] so far."""
        return np.array(self._time), np.array(self._position)

    def _add(self, duration: float, goal: Array) -> None:
        if duration > 0.0:
            self._time.append(self._time[-1] + duration)
            self._position.append(np.array(goal, dtype=float))


def smooth_ramp(time: Array) -> Array:
    """Go from 0 at time 0 to 1 after a second without a kink; any shape."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(time, 0.0, 1.0))
