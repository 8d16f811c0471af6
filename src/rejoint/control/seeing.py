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

from rejoint.arms import Array, position_kinematics, tcp_position
from rejoint.arms.displacement import FLOATING
from rejoint.control.controller import ControlInput
from rejoint.control.correction import MOST, Modelled
from rejoint.control.robot import Mask

NOISE = 0.3e-3
"""[m] standard deviation of each coordinate that a sighting has at least, and where nobody knows it (chosen: between
what a board of 60 mm at 0.6 m has across the line of sight and along it)"""
UNKNOWN = 3e-3
"""[m] by which the model may be wrong before anything was seen (chosen: twice what calibrations leave)"""
DRIFT = 0.2e-3
"""[m/sqrt(s)] by which that changes while the arm stands or is shaken (chosen)"""
RATTLE = 12e-3
"""[rad/sqrt(s)] by which a link that floats wanders in its play (chosen: worn bases coast at 5 mm/s)"""
ALONG = 0.1
"""share of a motion of the tool by which the shift changes on the way (chosen)"""
NEAR = 0.015
"""[m] from its aim within which sightings count: the shift farther away is another one (chosen)"""
CHANGE = 2e-4
"""[m] by which an aim changes at least (chosen: noise of sightings, and what an encoder count moves the tool by)"""
JUMP = 0.015
"""[m] from the model beyond which a sighting is not believed (chosen: twice what worn arms miss by; it is a reflection,
or another board)"""
HISTORY = 64
"""Cycles in which the encoders are remembered (chosen: pictures come within a second)"""
SHIFTED, ALIKE = 3e-3, 3
"""[m] by which the tool is seen to one side of the model, and targets at which it is, from which camera or board were
more likely moved (chosen: what calibrations leave differs from target to target, and has 1.5 mm)"""
ENOUGH = 2
"""sightings at a target before they are acted on otherwise than by the aim (chosen: one may be wrong)"""
FRESH = 0.6
"""[s] for which a sighting is news (chosen: a few pictures may be lost)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """Where the tool was seen."""

    time: float
    """[s] when the picture was taken; on the robot's clock where it is for a loop"""
    place: Array
    """(3,) [m] of the TCP in the frame of the base"""
    sigma: float = np.nan
    """[m] standard deviation of each coordinate from picture to picture; NaN where nobody knows"""


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
    visits: list[tuple[int, float | None]] = field(default_factory=list, init=False)
    """of each target so far: sightings that were believed, and the error [m] by the last of them, averaged; None where
    the tool was not seen"""
    beyond: list[Array] = field(default_factory=list, init=False)
    """(3,) [m] of each target that was seen: the tool, as seen there last, less where the model has it"""
    _target: Array = field(default_factory=lambda: np.full(3, np.nan), init=False)
    _extra: Array = field(default_factory=lambda: np.zeros(3), init=False)  # [m] of shift that the model does not know
    _spread: Array = field(default_factory=lambda: np.eye(3), init=False)  # (3, 3) [m^2] its covariance
    _place: Array = field(default_factory=lambda: np.zeros(3), init=False)  # [m] by the encoders, at the last of them
    _count: int = field(default=0, init=False)  # sightings believed at this target
    _last: float = field(default=-np.inf, init=False)  # [s] of the newest sighting that was looked at
    _believed: float = field(default=-np.inf, init=False)  # [s] of the newest that was believed
    _told: deque[tuple[float, Array]] = field(default_factory=lambda: deque(maxlen=HISTORY), init=False)

    def aim(self, target: Array, start: Array, where: Mask) -> Array:
        """Return the aims (1, 3) [m] of the model."""
        self._target, self._extra, self._count = target[0].copy(), np.zeros(3), 0
        self.visits.append((0, None))
        return super().aim(target, start, where)

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
        place = tcp_position(self.arm, then)
        away = float(np.linalg.norm(inputs.target[0] - place))
        unknown = seen.place - place - self.shift(then)
        if away > NEAR or float(np.linalg.norm(unknown)) > JUMP:
            return None
        self._count += 1
        self._learn(unknown, then, seen)
        self.used += 1
        if self._count > 1:
            self.beyond.pop()
        self.beyond.append(self._extra)
        left = target[0] - place - self.shift(then) - self._extra
        self.visits[-1] = self._count, float(np.linalg.norm(left))
        fresh = target[0] - self.shift(position) - self._extra
        changed = float(np.linalg.norm(fresh - inputs.target)) > CHANGE
        return fresh[None] if changed and float(np.linalg.norm(fresh - target)) < MOST else None

    def missing(self, inputs: ControlInput) -> Array | None:
        """Return how far (3,) [m] the tool still has to go, by the eye; None where it has seen nothing of late."""
        position, now = inputs.state.position[0], float(inputs.state.time[0])
        if self._count < ENOUGH or now - self._believed > FRESH:
            return None
        return np.asarray(self._target - tcp_position(self.arm, position) - self.shift(position) - self._extra)

    def shifted(self) -> float | None:
        """Return how far [m] the tool is seen to one side of the model at all targets alike; None where it is not."""
        if len(self.beyond) < ALIKE:
            return None
        side = np.mean(self.beyond, axis=0)
        apart = np.linalg.norm(np.array(self.beyond) - side, axis=1)
        far = float(np.linalg.norm(side))
        return far if far > SHIFTED and far > 2.0 * float(np.sqrt((apart**2).mean())) else None

    def _learn(self, unknown: Array, then: Array, seen: Sighting) -> None:
        """Take over what one believed sighting tells: at once where a link floats, else by degrees.

        A Kalman filter: what the model does not know stays about the same, but for links without weight, which wander
        in their play, and for what changes along the way.
        """
        place, jacobian = position_kinematics(self.arm, then)
        if self._count == 1:
            self._spread = UNKNOWN**2 * np.eye(3)
        else:
            floats = 1.0 - np.tanh(self.displacement.torque(self.arm, then) / FLOATING) ** 2
            wander, moved = RATTLE * jacobian * floats, ALONG * float(np.linalg.norm(place - self._place))
            change = DRIFT**2 * np.eye(3) + wander @ wander.T
            self._spread = self._spread + (seen.time - self._believed) * change + moved**2 * np.eye(3)
        noise = np.fmax(seen.sigma, NOISE)  # NaN: nobody knows
        share = self._spread @ np.linalg.inv(self._spread + noise**2 * np.eye(3))
        self._extra = self._extra + share @ (unknown - self._extra)
        self._spread = self._spread - share @ self._spread
        self._place, self._believed = place, seen.time

    def _remembered(self, time: float) -> bool:
        return self._told[0][0] <= time <= self._told[-1][0]

    def _position(self, time: float) -> Array:
        """Return what the encoders said (n,) [rad] at ``time`` [s]."""
        times = np.array([one for one, _ in self._told])
        places = np.stack([one for _, one in self._told])
        return np.array([np.interp(time, times, column) for column in places.T])
