"""How much time passed between two decisions of a controller: real wires and processors jitter."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.control.law import between
from rejoint.control.robot import Mask

NOMINAL_PERIOD = 0.025
"""[s] assumed before a period has been measured (chosen: middle of the usual 20 to 30 ms)."""

LONGEST_PERIOD = 0.1
"""[s] a longer pause counts as this (chosen: what happened meanwhile is unknown)."""


class Pace:
    """Measures the periods of B arms on their own clocks."""

    def __init__(self) -> None:
        self.last: Array = np.zeros(0)
        """(B,) [s] times of the last joint states"""

    def tick(self, time: Array) -> Array:
        """Return the time (B,) [s] since the last call; ``time`` (B,) [s] is that of the joint state.

        0 where the joint state is the last one again, since it says nothing new.
        """
        if len(self.last) != len(time):
            elapsed = np.full(len(time), NOMINAL_PERIOD)
        else:
            elapsed = between(time - self.last, 0.0, LONGEST_PERIOD)
        self.last = time.copy()
        return elapsed

    def begin(self, time: Array, where: Mask) -> None:
        """Start afresh at ``time`` (B,) [s] for the arms in ``where`` (B,)."""
        self.last = np.where(where, time, self.last) if len(self.last) == len(time) else time.copy()
