"""The servo's reference: commands that arrive late and are approached at limited speed or acceleration.

Between commands it is a ramp, or the time-optimal motion to rest at the goal (Pontryagin et al. 1962). An SO-101
(Feetech STS3215) limits its acceleration to at most 254 x 100 counts/s^2, and follows a repeated goal at once
(measured).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201, ANN202 - compiled functions take their types from their arguments

from __future__ import annotations

import numpy as np
from numba import njit

from rejoint.arms import Array, Index, Mask


@njit(cache=True, nogil=True)
def move(position, velocity, goal, reach, acceleration, elapsed):
    """Position and velocity after ``elapsed`` [s] on the way to rest at ``goal``.

    By at most ``reach`` [rad], or, with a finite ``acceleration`` [rad/s^2], as fast as that allows.
    """
    away = goal - position
    if acceleration == np.inf or (away == 0.0 and velocity == 0.0):
        return position + min(max(away, -reach), reach), velocity
    direction = 1.0 if away >= 0.5 * velocity * abs(velocity) / acceleration else -1.0
    away, start = direction * away, direction * velocity
    peak = np.sqrt(max(acceleration * away + 0.5 * start**2, 0.0))
    if (peak - start) / acceleration > elapsed:
        travelled, speed = elapsed * (start + 0.5 * acceleration * elapsed), start + acceleration * elapsed
    else:
        left = max((2.0 * peak - start) / acceleration - elapsed, 0.0)
        travelled, speed = away - 0.5 * acceleration * left**2, acceleration * left
    return position + direction * travelled, direction * speed


INSTANT = np.zeros(1)


class ServoReference:
    """Reference for one record of commands."""

    def __init__(self, time: Array, command: Array, speed: float, acceleration: float = np.inf) -> None:
        """Take sending times (T,) [s], commands (T, n) [rad], a speed [rad/s] or a finite acceleration [rad/s^2].

        The first reference is the first command.
        """
        self._time, self._command, self._limits = time, np.ascontiguousarray(command), (speed, acceleration)
        again, rest = np.diff(command, axis=0, prepend=np.nan) == 0.0, (command[:1], 0.0 * command[:1])
        limits = np.array([speed]), np.array([acceleration])
        moved = follow(*rest, command[None, :-1], again[None, :-1], *limits, np.diff(time)[None])
        # when each command is sent
        self._position, self._velocity = (np.vstack([first, one[0]]) for first, one in zip(rest, moved, strict=True))
        if acceleration < np.inf:
            self._position[again], self._velocity[again] = command[again], 0.0

    def sample(self, time: Array, delay: Array, around: Array = INSTANT) -> Array:
        """Return references (m, s, n) [rad] for delays (m,) [s]: means ``around`` each ``time`` (s,) [s]."""
        late = time - delay[:, None]
        return _sample(late, around, self._time, self._command, self._position, self._velocity, self._limits)


@njit(cache=True, nogil=True)
def _sample(late, around, time, command, position, velocity, limits):
    speed, acceleration = limits
    twins, instants = late.shape
    path = np.zeros((twins, instants, command.shape[1]))
    for i in range(twins):
        k = 0
        for s in range(instants):
            for shift in around:
                at = late[i, s] + shift
                if at < time[k]:
                    k = 0
                while k + 1 < len(time) and time[k + 1] <= at:
                    k += 1
                elapsed = max(at - time[k], 0.0)
                for j in range(command.shape[1]):
                    now, v = position[k, j], velocity[k, j]
                    path[i, s, j] += move(now, v, command[k, j], speed * elapsed, acceleration, elapsed)[0]
    return path / len(around)


class LiveReference:
    """Online references of N arms of n joints."""

    def __init__(self, count: int, joints: int) -> None:
        self.position, self.velocity = np.zeros((2, count, joints))
        """(N, n) [rad], [rad/s]; velocity only with limited acceleration"""
        self._speed, self._acceleration = np.ones(count), np.full(count, np.inf)

    def restart(self, where: Mask | slice, position: Array, *, speed: Array, acceleration: Array) -> None:
        """Rest at ``position`` (m, n) [rad] in ``where`` (N,); limits (m,) [rad/s] or, if finite, [rad/s^2]."""
        self.position[where], self.velocity[where] = position, 0.0
        self._speed[where], self._acceleration[where] = speed, acceleration

    def follow(self, latency: Latency, starts: Array, step: Array) -> Array:
        """Follow the commands in force at ``starts`` (N, s) [s], ``step`` (N,) [s] each: (N, s, n) [rad]."""
        goals, again = latency.in_force(starts)
        steps = np.repeat(step[:, None], starts.shape[1], axis=1)
        path, speed = follow(self.position, self.velocity, goals, again, self._speed, self._acceleration, steps)
        self.position, self.velocity = path[:, -1].copy(), speed[:, -1].copy()
        return path

    def ahead(self, which: Index, goals: Array, step: float) -> Array:
        """Later references (m, s, n) [rad] of arms ``which`` (m,)."""
        again, steps = np.zeros(goals.shape, dtype=bool), np.full(goals.shape[:2], step)
        limits = self._speed[which], self._acceleration[which]
        return follow(self.position[which], self.velocity[which], goals, again, *limits, steps)[0]


@njit(cache=True, nogil=True, boundscheck=True)
def follow(position, velocity, goals, again, speed, acceleration, step):
    """Move references (N, n) towards ``goals`` (N, s, n); return them and their velocities after each ``step`` (N, s).

    By ``speed`` (N,) [rad/s], or a finite ``acceleration`` (N,). Goals sent ``again`` (N, s, n) are then reached.
    """
    agents, steps, joints = goals.shape
    path, rate = np.empty(goals.shape), np.empty(goals.shape)
    for i in range(agents):
        for j in range(joints):
            now, v = position[i, j], velocity[i, j]
            for k in range(steps):
                if again[i, k, j] and acceleration[i] < np.inf:
                    now, v = goals[i, k, j], 0.0
                else:
                    now, v = move(now, v, goals[i, k, j], speed[i] * step[i, k], acceleration[i], step[i, k])
                path[i, k, j], rate[i, k, j] = now, v
    return path, rate


DEPTH, READINGS = 12, 4
"""Commands, and periods of readings, kept: delays of 200 and 70 ms at the shortest period of 18 ms"""


class Latency:
    """Delayed commands and readings of N arms of n joints."""

    def __init__(self, count: int, joints: int, substeps: int) -> None:
        self.command_delay = np.zeros(count)
        """(N,) [s]"""
        self.readback_delay = np.zeros(count)
        """(N,) [s]"""
        self._commands = np.zeros((count, DEPTH + 1, joints))  # newest first
        self._sent = np.full((count, DEPTH + 1), -np.inf)
        self._positions = np.zeros((count, READINGS * substeps + 1, joints))  # oldest first
        self._times = np.zeros((count, READINGS * substeps + 1))

    def clear(self, where: Mask | slice, command: Array, position: Array) -> None:
        """Restart at time 0 in ``where`` (N,) with constant ``command``, ``position`` (m, n)."""
        self._commands[where] = command[:, None]
        self._sent[where] = -np.inf
        self._positions[where] = position[:, None]
        steps = np.arange(self._times.shape[1]) - self._times.shape[1] + 1.0
        self._times[where] = steps  # one second apart: the arm has long been there

    def send(self, command: Array, time: Array) -> None:
        """Send ``command`` (N, n) [rad] at ``time`` (N,) [s]."""
        self._commands[:, 1:] = self._commands[:, :-1]  # NumPy copies first where memory overlaps
        self._sent[:, 1:] = self._sent[:, :-1]
        self._commands[:, 0], self._sent[:, 0] = command, time

    def in_force(self, time: Array) -> tuple[Array, Mask]:
        """Commands (N, s, n) [rad] at the servos at ``time`` (N, s) [s], and whether they repeat the ones before."""
        arrival = self._sent[:, None, : DEPTH - 1] + self.command_delay[:, None, None]
        arms, later = np.arange(len(time))[:, None], (arrival > time[..., None]).sum(axis=-1)  # not there yet
        commands = self._commands[arms, later]
        return commands, commands == self._commands[arms, later + 1]

    def record(self, time: Array, position: Array) -> None:
        """Record positions (N, substeps, n) [rad] at ``time`` (N, substeps) [s]."""
        new = time.shape[1]
        self._positions[:, :-new] = self._positions[:, new:]
        self._times[:, :-new] = self._times[:, new:]
        self._positions[:, -new:], self._times[:, -new:] = position, time

    def read(self, time: Array) -> Array:
        """Positions (N, n) [rad] that arrive at ``time`` (N,) [s], interpolated."""
        then, arms = time - self.readback_delay, np.arange(len(time))
        later = np.clip((self._times <= then[:, None]).sum(axis=1), 1, self._times.shape[1] - 1)
        start, end = self._times[arms, later - 1], self._times[arms, later]
        share = np.clip((then - start) / (end - start), 0.0, 1.0)[:, None]
        old = self._positions[arms, later - 1]
        return old + share * (self._positions[arms, later] - old)
