"""Cameras that look at an emulated arm: rendered images, and a detector of the tool."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Array
from rejoint.control.robot import Robot
from rejoint.control.seeing import Sighting

if TYPE_CHECKING:
    from rejoint.camera.detector import Picture
    from rejoint.camera.rig import Rig


class EmulatedCamera:
    """Rendered images; noise by seed and number."""

    def __init__(self, rig: Rig, tool: Callable[[], Array], seed: int = 0) -> None:
        """``tool`` returns the tool's pose (4, 4) in the base."""
        self._rig, self._tool, self._seed = rig, tool, seed

    def still(self, number: int) -> Picture:
        """Render image ``number``."""
        from rejoint_lab.cameras.scene import render

        return render(self._rig, self._tool(), (self._seed, number))


RATE, LATE = 15.0, 0.1
"""[1/s] images, and [s] from an image to its detection (chosen)"""
DEVIATION = np.array([5e-4, 1e-4, 1e-4])
"""[m] of a detection in the base frame, along the line of sight and across (chosen)"""


class EmulatedEye:
    """Detects the tool of one emulated arm."""

    def __init__(self, robot: Robot, seed: int = 0) -> None:
        self._robot, self._rng = robot, np.random.default_rng(seed)
        self._taken: deque[Sighting] = deque(maxlen=64)
        self._due = -np.inf  # [s] of the next image

    def sighting(self, now: float) -> Sighting | None:
        """Newest detection at robot time ``now`` [s], or None."""
        if now >= self._due:
            self._due = (self._due if now - self._due < 1.0 / RATE else now) + 1.0 / RATE  # missed images are lost
            place = self._robot.true_tcp()[0] + DEVIATION * self._rng.normal(size=3)
            self._taken.append(Sighting(time=now, place=place))
        ready = [one for one in self._taken if one.time <= now - LATE]
        return ready[-1] if ready else None
