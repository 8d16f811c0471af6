"""The servo's reference: commands that arrive late and are approached at limited speed or acceleration.

Between commands it is a ramp, or the time-optimal motion to rest at the goal (bang-bang; Pontryagin et al. 1962). An
SO-101 (Feetech STS3215) limits its acceleration to at most 254 x 100 counts/s^2; it follows a repeated goal at once
(measured).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.control.robot import Mask
from rejoint.system.errors import InputError

REACHED = 1e-12
"""[rad] rounding"""


class ServoReference:
    """References of m twins for one record of commands."""

    def __init__(self, time: Array, command: Array, ramp_speed: Array, start: Array) -> None:
        """Take sending times (T,) [s], commands (T, n) [rad], speeds (m,) [rad/s], start (n,)."""
        self.time = time
        self.command = command
        speeds, self.which = np.unique(np.asarray(ramp_speed), return_inverse=True)
        self.ramp_speed = speeds[:, None]
        # Reference at the sending of each command: what is left of each step is carried into the next.
        self.at = np.repeat(np.concatenate([command[:1], command[:-1]])[:, None], len(speeds), axis=1)
        self.at[0] = start
        steps = speeds[0] * np.diff(time)  # the slowest decides what can be skipped
        jumps = np.abs(np.diff(command[:-1], axis=0)).max(axis=1) > steps[1:]
        ahead = np.append(np.flatnonzero(jumps) + 1, len(time) - 1)  # rows whose command is not reached in time
        k = 0
        while k < len(time) - 1:
            self.at[k + 1] = approach(self.at[k], command[k], self.ramp_speed * (time[k + 1] - time[k]))
            k += 1
            if np.abs(self.at[k] - command[k - 1]).max() < REACHED:
                k = int(ahead[min(int(np.searchsorted(ahead, k)), len(ahead) - 1)])
        self._area: Array | None = None

    def sample(self, time: Array, delay: Array) -> Array:
        """Return references (m, s, n) [rad] at ``time`` (s,) [s] for delays (m,) [s]."""
        late = time - np.asarray(delay)[:, None]
        row = np.clip(np.searchsorted(self.time, late, side="right") - 1, 0, len(self.time) - 1)
        elapsed = np.maximum(late - self.time[row], 0.0)
        twin = self.which[:, None]
        return approach(self.at[row, twin], self.command[row], (self.ramp_speed[self.which] * elapsed)[..., None])

    def mean(self, time: Array, delay: Array, width: float) -> Array:
        """Means of references over ``width`` [s] about each of the even times ``time`` (s,) [s].

        They remove the effect of commands in step with the grid.
        """
        edges = np.append(time - 0.5 * width, time[-1] + 0.5 * width)
        late = edges - np.asarray(delay)[:, None]
        row = np.clip(np.searchsorted(self.time, late, side="right") - 1, 0, len(self.time) - 1)
        if self._area is None:
            lasts = np.diff(self.time)[:, None, None]
            areas = _area(self.at[:-1], self.command[:-1, None], self.ramp_speed, lasts)
            self._area = np.concatenate([np.zeros_like(self.at[:1]), np.cumsum(areas, axis=0)])
        twin, speed = self.which[:, None], self.ramp_speed[self.which][..., None]
        since = (late - self.time[row])[..., None]
        area = self._area[row, twin] + _area(self.at[row, twin], self.command[row], speed, since)
        return np.diff(area, axis=1) / width


def _area(reference: Array, goal: Array, speed: Array, elapsed: Array) -> Array:
    """Integral [rad s] of a reference that approaches ``goal`` for ``elapsed`` [s]."""
    gap = goal - reference
    moving = np.clip(elapsed, 0.0, np.abs(gap) / speed)
    missing = np.abs(gap) * moving - 0.5 * speed * moving**2
    return np.where(elapsed < 0.0, reference, goal) * elapsed - np.sign(gap) * missing


def approach(reference: Array, goal: Array, step: Array | float) -> Array:
    """Move ``reference`` towards ``goal`` by at most ``step``."""
    return reference + np.clip(goal - reference, -step, step)


class LiveReference:
    """Online references of N arms of n joints."""

    def __init__(self, count: int, joints: int) -> None:
        self.position, self.velocity = np.zeros((2, count, joints))
        """(N, n) [rad], [rad/s]; velocity only with limited acceleration"""
        self._speed, self._acceleration = np.ones(count), np.full(count, np.inf)

    def restart(self, where: Mask, position: Array, *, speed: Array, acceleration: Array) -> None:
        """Rest at ``position`` (m, n) [rad] in ``where`` (N,); limits (m,) [rad/s] or, if finite, [rad/s^2]."""
        self.position[where], self.velocity[where] = position, 0.0
        self._speed[where], self._acceleration[where] = speed, acceleration

    def follow(self, latency: Latency, starts: Array, step: Array) -> Array:
        """Follow the commands in force at ``starts`` (N, s) [s], ``step`` (N,) [s] each: (N, s, n) [rad]."""
        goals, limited = latency.in_force(starts), (self._acceleration < np.inf).any()
        again = latency.sent_again(starts) if limited else np.zeros(goals.shape, dtype=bool)
        reach = self._speed * step
        path, self.velocity = follow(self.position, self.velocity, goals, again, reach, self._acceleration, step)
        self.position = path[:, -1].copy()
        return path

    def ahead(self, which: NDArray[np.integer], goals: Array, step: float) -> Array:
        """Later references (m, s, n) [rad] of arms ``which`` (m,)."""
        again, each = np.zeros(goals.shape, dtype=bool), np.full(len(which), step)
        position, velocity, speed = self.position[which], self.velocity[which], self._speed[which]
        return np.asarray(follow(position, velocity, goals, again, speed * step, self._acceleration[which], each)[0])

    def state(self) -> dict[str, Array]:
        """Live arrays for a checkpoint."""
        return {
            "position": self.position,
            "velocity": self.velocity,
            "speed": self._speed,
            "acceleration": self._acceleration,
        }


@njit(cache=True, nogil=True, boundscheck=True)
def follow(position, velocity, goals, again, reach, acceleration, step):  # noqa: ANN001, ANN201
    """Move references (N, n) towards ``goals`` (N, s, n); return them after each step, and speeds.

    By ``reach`` (N,) [rad] per ``step`` (N,) [s], or a finite ``acceleration`` (N,).
    """
    agents, steps, joints = goals.shape
    path, speed = np.empty(goals.shape), np.zeros(velocity.shape)
    for i in range(agents):
        for j in range(joints):
            now, v = position[i, j], velocity[i, j]
            for k in range(steps):
                if acceleration[i] == np.inf:
                    now += min(max(goals[i, k, j] - now, -reach[i]), reach[i])
                elif again[i, k, j]:
                    now, v = goals[i, k, j], 0.0
                else:
                    now, v = _advance(now, v, goals[i, k, j], acceleration[i], step[i])
                path[i, k, j] = now
            speed[i, j] = v
    return path, speed


class Profile:
    """References with limited acceleration for one record of commands."""

    def __init__(self, time: Array, command: Array, acceleration: float) -> None:
        """Take sending times (T,) [s], commands (T, n) [rad] and the acceleration [rad/s^2]."""
        self.time, self.command, self.acceleration = time, command, acceleration
        self.position, self.velocity = _states(time, np.ascontiguousarray(command), acceleration)

    def sample(self, time: Array, delay: Array) -> Array:
        """As `ServoReference.sample`."""
        delays, which = np.unique(np.asarray(delay), return_inverse=True)
        late = time - delays[:, None]
        row = np.clip(np.searchsorted(self.time, late, side="right") - 1, 0, len(self.time) - 1)
        elapsed = np.maximum(late - self.time[row], 0.0)[..., None]
        found, _ = advance(self.position[row], self.velocity[row], self.command[row], self.acceleration, elapsed)
        return np.asarray(found[which])


def advance(
    position: Array, velocity: Array, goal: Array, acceleration: float, elapsed: Array | float
) -> tuple[Array, Array]:
    """Position and velocity after ``elapsed`` [s] of the fastest motion to rest at ``goal``; also compiled."""
    away = goal - position
    direction = np.where(away >= 0.5 * velocity * np.abs(velocity) / acceleration, 1.0, -1.0)
    away, start = direction * away, direction * velocity
    peak = np.sqrt(np.maximum(acceleration * away + 0.5 * start**2, 0.0))
    rising, left = (peak - start) / acceleration - elapsed, (2.0 * peak - start) / acceleration - elapsed
    left = np.maximum(left, 0.0)
    up = rising > 0.0
    travelled = np.where(up, elapsed * (start + 0.5 * acceleration * elapsed), away - 0.5 * acceleration * left**2)
    speed = np.where(up, start + acceleration * elapsed, acceleration * left)
    return position + direction * travelled, direction * speed


_advance = njit(cache=True)(advance)


@njit(cache=True)
def _states(time: Array, command: Array, acceleration: float) -> tuple[Array, Array]:
    """Position and velocity (T, n) at each command."""
    position, velocity = np.empty_like(command), np.zeros_like(command)
    position[0] = command[0]
    for k in range(1, len(time)):
        elapsed = time[k] - time[k - 1]
        for j in range(command.shape[1]):
            if command[k, j] == command[k - 1, j]:
                position[k, j] = command[k, j]
                continue
            position[k, j], velocity[k, j] = _advance(
                position[k - 1, j], velocity[k - 1, j], command[k - 1, j], acceleration, elapsed
            )
    return position, velocity


DEPTH = 4
"""Commands kept: 40 ms of delay at the shortest period of 18 ms"""


class Latency:
    """Delayed commands and readings of N arms of n joints."""

    def __init__(self, count: int, joints: int, substeps: int) -> None:
        self.command_delay = np.zeros(count)
        """(N,) [s]"""
        self.readback_delay = np.zeros(count)
        """(N,) [s]"""
        self._commands = np.zeros((count, DEPTH, joints))  # newest first
        self._sent = np.full((count, DEPTH), -np.inf)
        self._positions = np.zeros((count, 2 * substeps + 1, joints))  # oldest first
        self._times = np.zeros((count, 2 * substeps + 1))

    def clear(self, where: Mask, command: Array, position: Array) -> None:
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

    def in_force(self, time: Array) -> Array:
        """Commands (N, s, n) [rad] at the servos at ``time`` (N, s) [s]."""
        self._check(len(time))
        return _in_force(self._sent, self.command_delay, self._commands, time)

    def sent_again(self, time: Array) -> NDArray[np.bool_]:
        """Whether the commands (N, s, n) at ``time`` (N, s) [s] repeat the one before."""
        self._check(len(time))
        same = np.zeros(self._commands.shape)
        same[:, :-1] = self._commands[:, :-1] == self._commands[:, 1:]
        return _in_force(self._sent, self.command_delay, same, time) > 0.0

    def record(self, time: Array, position: Array) -> None:
        """Record positions (N, substeps, n) [rad] at ``time`` (N, substeps) [s]."""
        new = time.shape[1]
        self._positions[:, :-new] = self._positions[:, new:]
        self._times[:, :-new] = self._times[:, new:]
        self._positions[:, -new:], self._times[:, -new:] = position, time

    def read(self, time: Array) -> Array:
        """Positions (N, n) [rad] that arrive at ``time`` (N,) [s], interpolated."""
        self._check(len(time))
        return _read(self._times, self._positions, time, self.readback_delay)

    def _check(self, count: int) -> None:
        if count != len(self._sent):
            raise InputError(f"latency: times of {count} arms, expected {len(self._sent)}")

    def state(self) -> dict[str, Array]:
        """Live arrays for a checkpoint."""
        return {
            "command_delay": self.command_delay,
            "readback_delay": self.readback_delay,
            "commands": self._commands,
            "sent": self._sent,
            "positions": self._positions,
            "times": self._times,
        }


@njit(cache=True, nogil=True, boundscheck=True)
def _in_force(sent, delay, commands, time):  # noqa: ANN001, ANN202
    agents, instants = time.shape
    joints = commands.shape[2]
    known = np.empty((agents, instants, joints))
    for i in range(agents):
        for s in range(instants):
            pending = 0
            for d in range(DEPTH - 1):  # the oldest is in force where no other is
                pending += sent[i, d] + delay[i] > time[i, s]
            for j in range(joints):
                known[i, s, j] = commands[i, pending, j]
    return known


@njit(cache=True, nogil=True, boundscheck=True)
def _read(times, positions, time, delay):  # noqa: ANN001, ANN202
    agents, instants, joints = positions.shape
    seen = np.empty((agents, joints))
    for i in range(agents):
        then, later = time[i] - delay[i], 1
        while later < instants - 1 and times[i, later] <= then:
            later += 1
        before, after = times[i, later - 1], times[i, later]
        share = min(max((then - before) / (after - before), 0.0), 1.0)
        for j in range(joints):
            old = positions[i, later - 1, j]
            seen[i, j] = old + share * (positions[i, later, j] - old)
    return seen
