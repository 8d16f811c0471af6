"""Cameras that look at an emulated arm: rendered images, and a detector of the tool."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Array
from rejoint.control.robot import Robot
from rejoint.control.seeing import Sighting
from rejoint.system.errors import InputError

if TYPE_CHECKING:
    from rejoint.camera.detector import Picture
    from rejoint_lab.cameras.scene import Scene


class EmulatedCamera:
    """Rendered images; noise by seed and number."""

    def __init__(self, scene: Scene, tool: Callable[[], Array], seed: int = 0) -> None:
        """``tool`` returns the tool's pose (4, 4) in the base."""
        self.scene, self._tool, self._seed = scene, tool, seed

    def still(self, number: int) -> Picture:
        """Render image ``number``."""
        return self.scene.shows(self._tool(), (self._seed, number))


LATERAL, DEPTH = 1e-4, 5e-4
"""[m] deviations across and along the line of sight (chosen)"""


@dataclass(eq=False)
class EmulatedEye:
    """Detects the tool of one emulated arm."""

    robot: Robot
    rate: float = 15.0
    """[1/s] images (chosen)"""
    late: float = 0.1
    """[s] from image to detection (chosen)"""
    sight: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """line of sight in the base frame"""
    lateral: float = LATERAL
    depth: float = DEPTH
    hidden: tuple[tuple[float, float], ...] = ()
    """(from, to) [s] robot time of a hidden tool"""
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
        """Newest detection at robot time ``now`` [s], or None."""
        if now >= self._next:
            due = self._next if now - self._next < 1.0 / self.rate else now  # pictures that were not taken are lost
            self._next = due + 1.0 / self.rate
            if not any(start <= now < end for start, end in self.hidden):
                place = self.robot.true_tcp()[0] + self._noise @ self._rng.normal(size=3)
                self._taken.append(Sighting(time=now, place=place))
        ready = [one for one in self._taken if one.time <= now - self.late]
        return ready[-1] if ready else None
