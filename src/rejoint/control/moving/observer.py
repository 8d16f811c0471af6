"""What the arms will do next, and what pushes them: an observer of the deviation from the motion that is wanted.

A servo that is sent the inverse of its twin would follow exactly. What it does instead is a deviation x of its joint,
``M x'' + D x' + k x = k (u + d)``, where u is what was sent beyond that inverse, ``delay`` ago, and d all that the twin
does not know: friction that sticks, ripple of gears, a payload. A stationary Kalman filter per joint tells x, its speed
and d from the encoders; gravity, friction and motion have cancelled, so it is linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, link_inertia
from rejoint.control.moving.servos import Servos
from rejoint.control.pace import NOMINAL_PERIOD

_PARTS = 5  # steps in which a control period, or a delay, is passed (chosen: 5 ms each)
_KEPT = 12  # commands that are remembered (chosen: more than arrive late at the shortest period)
_ROUNDS = 300  # of the filter's equations until they stand still
_LEAST_INERTIA = 2e-3  # [kg m^2] believed of a joint (chosen: the least of the twins)


@dataclass(frozen=True, kw_only=True)
class Trust:
    """What the filter believes of what it does not know."""

    drift: float = 1e-3
    """[rad^2/s] by which what pushes a joint, over its stiffness, changes (chosen on four worn arms, see
    docs/daily-use.md)"""
    shocks: float = 1.0
    """[rad^2/s^3] by which its speed changes beside that (chosen there as well)"""


class PushObserver:
    """Deviations of B arms from the motion that is wanted."""

    def __init__(self, arm: Arm, servos: Servos, trust: Trust | None = None, period: float = NOMINAL_PERIOD) -> None:
        """``period`` [s] is the usual one of the control cycles."""
        self._servos = servos
        self.mass = np.maximum(servos.armature + link_inertia(arm, arm.rest), _LEAST_INERTIA)
        """(B, n) [kg m^2] that moves with each joint"""
        noise = max(arm.encoder_step**2 / 12.0, 1e-8)
        self._gain = _filter_gain(self.mass, servos, trust or Trust(), noise, period)
        self.away, self.speed, self.push = np.zeros((3, *servos.stiffness.shape))
        """each (B, n): deviation [rad], its speed [rad/s], and what pushes the joint, over its stiffness [rad]"""
        self._sent: list[tuple[Array, Array]] = []

    def sent(self, time: Array, beyond: Array) -> None:
        """Take over what was sent at ``time`` (B,) [s] ``beyond`` (B, n) [rad] the inverse of the twin."""
        self._sent = [*self._sent[1 - _KEPT :], (time, beyond)]

    def see(self, time: Array, elapsed: Array, away: Array) -> None:
        """Take over the deviations ``away`` (B, n) [rad] measured at ``time`` (B,) [s], ``elapsed`` [s] after the last.

        Arms without news, of no time, stay as they are.
        """
        fresh = (elapsed > 0.0)[:, None]
        place, speed = self._pass(time - elapsed, elapsed)
        missed = np.where(fresh, away - place, 0.0)
        self.away, self.speed = place + self._gain[..., 0] * missed, speed + self._gain[..., 1] * missed
        self.push = self.push + self._gain[..., 2] * missed

    def soon(self, time: Array) -> tuple[Array, Array]:
        """Return deviation and speed (B, n) when a command that is sent at ``time`` (B,) [s] begins to work."""
        return self._pass(time, self._servos.delay)

    def _pass(self, start: Array, span: Array) -> tuple[Array, Array]:
        servos, step = self._servos, (span / _PARTS)[:, None]
        pull = step * servos.stiffness / self.mass
        brake = 1.0 / (1.0 + step * servos.damping / self.mass)
        away, speed = self.away, self.speed
        for k in range(_PARTS):
            beyond = self._in_force(start + (k + 0.5) * step[:, 0] - servos.delay)
            speed = brake * (speed + pull * (beyond + self.push - away))
            away = away + step * speed
        return away, speed

    def _in_force(self, time: Array) -> Array:
        """Return what was last sent before ``time`` (B,) [s]."""
        found = np.zeros_like(self.push)
        for sent, beyond in self._sent:
            found = np.where((sent <= time)[:, None], beyond, found)
        return found


def _filter_gain(mass: Array, servos: Servos, trust: Trust, noise: float, period: float) -> Array:
    """Gains (B, n, 3) of the filter in the long run."""
    step = period / _PARTS
    brake, pull = 1.0 / (1.0 + step * servos.damping / mass), step * servos.stiffness / mass
    one = np.zeros((*mass.shape, 3, 3))
    one[..., 1, 0], one[..., 1, 1], one[..., 1, 2] = -brake * pull, brake, brake * pull
    one[..., 0, :] = step * one[..., 1, :]
    one[..., 0, 0] += 1.0
    one[..., 2, 2] = 1.0
    cycle = np.linalg.matrix_power(one, _PARTS)
    unknown = np.diag([1e-9, trust.shocks * period, trust.drift * period])
    spread = np.broadcast_to(1e-3 * np.eye(3), cycle.shape)
    gain = np.zeros((*mass.shape, 3))
    for _ in range(_ROUNDS):
        spread = cycle @ spread @ np.swapaxes(cycle, -1, -2) + unknown
        gain = spread[..., 0] / (spread[..., :1, 0] + noise)
        spread = spread - gain[..., None] * spread[..., :1, :]
    return gain
