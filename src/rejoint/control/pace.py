"""How much time passed between two decisions of a controller: real wires and processors jitter."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array

NOMINAL_PERIOD = 0.025
"""[s] assumed before a period has been measured (chosen: middle of the usual 20 to 30 ms)."""

LONGEST_PERIOD = 0.1
"""[s] a longer pause counts as this (chosen: what happened meanwhile is unknown)."""


class Pace:
    """Measures the periods of B arms on their own clocks."""

    def __init__(self) -> None:
        self._last: Array = np.zeros(0)

    def tick(self, time: Array) -> Array:
        """Return the time (B,) [s] since the last call; ``time`` (B,) [s] is that of the joint state.

        0 where the joint state is the last one again, since it says nothing new.
        """
        if len(self._last) != len(time):
            elapsed = np.full(len(time), NOMINAL_PERIOD)
        else:
            elapsed = np.clip(time - self._last, 0.0, LONGEST_PERIOD)
        self._last = time.copy()
        return elapsed
