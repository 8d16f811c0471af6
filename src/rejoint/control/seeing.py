"""Closing the loop on what is seen: the last millimetres are corrected by a camera, or by anything that sees the tool.

A sighting and what the encoders said when it was taken tell the shift between the two, there and then, whether the arm
stood or still crept. So nothing has to wait for rest: near a target each sighting corrects what the model thinks of the
shift, at whatever rate sightings come, and the aim follows. Where none comes, the aim stays as it is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from rejoint.arms import Array, tcp_position
from rejoint.control.controller import ControlInput
from rejoint.control.correction import MOST, Modelled
from rejoint.control.robot import Mask

SHARE = 0.4
"""Weight of a new sighting against those before it (chosen: noise of single ones is halved, and four are enough)"""
NEAR = 0.015
"""[m] from its aim within which sightings count: the shift farther away is another one (chosen)"""
CHANGE = 2e-4
"""[m] by which an aim changes at least (chosen: noise of sightings, and what an encoder count moves the tool by)"""
JUMP = 0.015
"""[m] from the model beyond which a sighting is not believed (chosen: twice what worn arms miss by; it is a reflection,
or another board)"""
HISTORY = 64
"""Cycles in which the encoders are remembered (chosen: pictures come within a second)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """Where the tool was seen."""

    time: float
    """[s] on the robot's clock when the picture was taken"""
    place: Array
    """(3,) [m] in the frame of the base"""


class Eye(Protocol):
    """Sees the tool of one arm, at a rate of its own; never waits."""

    def sighting(self, now: float) -> Sighting | None:
        """Return the newest sighting at robot time ``now`` [s]; None where there is none yet, or the tool is hidden."""


@dataclass(eq=False)
class Seen(Modelled):
    """Aims of one arm, by the model first and then by what an eye sees of its tool."""

    eye: Eye = field(kw_only=True)
    used: int = field(default=0, init=False)
    """sightings that were believed"""
    _first: Array = field(default_factory=lambda: np.zeros((1, 3)), init=False)  # aim of the model
    _extra: Array = field(default_factory=lambda: np.zeros(3), init=False)  # [m] of shift that the model does not know
    _last: float = field(default=-np.inf, init=False)  # [s] of the newest sighting that was looked at
    _told: deque[tuple[float, Array]] = field(default_factory=lambda: deque(maxlen=HISTORY), init=False)

    def aim(self, target: Array, start: Array, where: Mask) -> Array:
        """Return the aims (1, 3) [m] of the model."""
        self._first, self._extra = super().aim(target, start, where), np.zeros(3)
        return self._first

    def again(self, target: Array, inputs: ControlInput) -> Array | None:
        """Shift the aim by what the newest sighting tells."""
        now, position = float(inputs.state.time[0]), inputs.state.position[0]
        self._told.append((now, position.copy()))
        if not np.isfinite(target).all():
            return None
        seen = self.eye.sighting(now)
        if seen is None or seen.time <= self._last or not self._remembered(seen.time):
            return None
        self._last = seen.time
        then = self._position(seen.time)
        away = float(np.linalg.norm(inputs.target[0] - tcp_position(self.arm, then)))
        unknown = seen.place - tcp_position(self.arm, then) - self.shift(then)
        if away > NEAR or float(np.linalg.norm(unknown)) > JUMP:
            return None
        self._extra += (SHARE if self.used else 1.0) * (unknown - self._extra)
        self.used += 1
        fresh = self._first - self._extra
        changed = float(np.linalg.norm(fresh - inputs.target)) > CHANGE
        return fresh if changed and float(np.linalg.norm(fresh - target)) < MOST else None

    def _remembered(self, time: float) -> bool:
        return self._told[0][0] <= time <= self._told[-1][0]

    def _position(self, time: float) -> Array:
        """Return what the encoders said (n,) [rad] at ``time`` [s]."""
        times = np.array([one for one, _ in self._told])
        places = np.stack([one for _, one in self._told])
        return np.array([np.interp(time, times, column) for column in places.T])
