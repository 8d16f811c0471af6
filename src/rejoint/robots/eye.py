"""A camera that watches an emulated arm: what it would see of the tool, with its noise, its rate and its delay."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from rejoint.arms import Array
from rejoint.control.robot import Robot
from rejoint.control.seeing import Sighting
from rejoint.system.errors import InputError

LATERAL, DEPTH = 1e-4, 5e-4
"""[m] standard deviations of a sighting across the line of sight and along it (chosen: a board of 60 mm at 0.6 m, found
to 0.1 px in 1080 lines)"""


@dataclass(eq=False)
class EmulatedEye:
    """Sees the tool of one emulated arm; looked at once a control cycle, as a thread with a camera would be."""

    robot: Robot
    rate: float = 15.0
    """[1/s] pictures (chosen: what is left of 30 where a board is looked for in 1080 lines)"""
    late: float = 0.1
    """[s] from a picture to its sighting (chosen: exposure, transfer and finding the board)"""
    sight: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """direction in which it looks, in the frame of the base"""
    lateral: float = LATERAL
    depth: float = DEPTH
    hidden: tuple[tuple[float, float], ...] = ()
    """(from, to) [s] on the robot's clock in which the tool is hidden"""
    seed: int = 0
    _taken: deque[Sighting] = field(default_factory=lambda: deque(maxlen=64), init=False)
    _next: float = field(default=-np.inf, init=False)  # [s] when the next picture is due

    def __post_init__(self) -> None:
        if self.robot.count != 1 or not np.isfinite(self.robot.true_tcp()).all():
            raise InputError(
                f"camera emulated: it sees one arm that is emulated in this process, not {self.robot.address}; give "
                "emulated:WEAR as the robot"
            )
        if not (self.rate > 0.0 and self.late >= 0.0):
            raise InputError(f"camera emulated: expected a positive rate, got {self.rate} 1/s and {self.late} s")
        self._rng = np.random.default_rng(self.seed)
        along = np.array(self.sight) / np.linalg.norm(self.sight)
        self._noise: Array = self.lateral * np.eye(3) + (self.depth - self.lateral) * np.outer(along, along)

    def sighting(self, now: float) -> Sighting | None:
        """Return the newest sighting that has come by robot time ``now`` [s]; None where there is none."""
        if now >= self._next:
            due = self._next if now - self._next < 1.0 / self.rate else now  # pictures that nobody took are lost
            self._next = due + 1.0 / self.rate
            if not any(start <= now < end for start, end in self.hidden):
                place = self.robot.true_tcp()[0] + self._noise @ self._rng.normal(size=3)
                self._taken.append(Sighting(time=now, place=place))
        ready = [one for one in self._taken if one.time <= now - self.late]
        return ready[-1] if ready else None
