"""What the servo is really asked for: commands that arrive late and are approached at limited speed.

A position servo of this class does not jump to a new command: its reference moves there at a set speed.
The command is constant between two sendings, so the reference is a straight line and then a rest, and
both effects are computed exactly, outside of the simulation, at any time and for many twins at once (`Reference`;
`rejoint.twin.profile` for servos that limit their acceleration). Where commands come one by one, references are
followed from step to step of the simulation (`LiveReference`).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.control.robot import Mask
from rejoint.twin.latency import Latency
from rejoint.twin.profile import move

REACHED = 1e-12
"""[rad] from its command at which a reference has arrived: rounding"""


class Reference:
    """References of m twins that follow one record of commands, each with its own delay and speed."""

    def __init__(self, time: Array, command: Array, ramp_speed: Array, start: Array) -> None:
        """Take sending times (T,) [s], commands (T, n) [rad], speeds (m,) [rad/s] and where to start (n,)."""
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
        """Return references (m, s, n) [rad] at ``time`` (s,) [s] for delays (m,) [s]; at first the start."""
        late = time - np.asarray(delay)[:, None]
        row = np.clip(np.searchsorted(self.time, late, side="right") - 1, 0, len(self.time) - 1)
        elapsed = np.maximum(late - self.time[row], 0.0)
        twin = self.which[:, None]
        return approach(self.at[row, twin], self.command[row], (self.ramp_speed[self.which] * elapsed)[..., None])

    def mean(self, time: Array, delay: Array, width: float) -> Array:
        """Return what `sample` does, averaged over ``width`` [s] about each of the even times ``time`` (s,) [s] apart.

        Commands that all come at the same place of a step are then in force from where they come, and not from the
        next step on.
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
    """Integral [rad s] of a reference over the time ``elapsed`` [s] in which it approaches ``goal``; all broadcast."""
    gap = goal - reference
    moving = np.clip(elapsed, 0.0, np.abs(gap) / speed)
    missing = np.abs(gap) * moving - 0.5 * speed * moving**2
    return np.where(elapsed < 0.0, reference, goal) * elapsed - np.sign(gap) * missing


def approach(reference: Array, goal: Array, step: Array | float) -> Array:
    """Move ``reference`` towards ``goal`` by at most ``step``; all broadcast."""
    return reference + np.clip(goal - reference, -step, step)


class LiveReference:
    """References of N arms of n joints, as commands come; some limit their speed, others their acceleration."""

    def __init__(self, count: int, joints: int) -> None:
        self.position, self.velocity = np.zeros((2, count, joints))
        """(N, n) [rad], [rad/s]; the velocity is that of references with limited acceleration"""
        self._speed, self._acceleration = np.ones(count), np.full(count, np.inf)

    def restart(self, where: Mask, position: Array, *, speed: Array, acceleration: Array) -> None:
        """Rest at ``position`` (m, n) [rad] in ``where`` (N,); limits (m,) [rad/s] or, if finite, (m,) [rad/s^2]."""
        self.position[where], self.velocity[where] = position, 0.0
        self._speed[where], self._acceleration[where] = speed, acceleration

    def follow(self, latency: Latency, starts: Array, step: Array) -> Array:
        """Follow the commands in force at ``starts`` (N, s) [s] for a ``step`` (N,) [s] each; returns (N, s, n) [rad].

        A goal that is sent again ends the plan of a servo that limits its acceleration (`rejoint.twin.profile`).
        """
        goals, reach = latency.in_force(starts), self._speed * step
        if (self._acceleration == np.inf).all():
            path = follow(self.position, goals, reach)
        else:
            path, self.velocity = _follow_limited(
                self.position, self.velocity, goals, latency.sent_again(starts), reach, self._acceleration, step
            )
        self.position = path[:, -1].copy()
        return path

    def ahead(self, which: NDArray[np.integer], goals: Array, step: float) -> Array:
        """Return where references would be, (m, s, n) [rad], if the arms ``which`` (m,) were asked for ``goals``.

        These are (m, s, n) [rad], one in each of s steps of ``step`` [s]; nothing moves on.
        """
        position, velocity, reach = self.position[which], self.velocity[which], self._speed[which] * step
        if (self._acceleration == np.inf).all():
            return follow(position, goals, reach)
        again = np.zeros(goals.shape, dtype=bool)
        each = np.full(len(which), step)
        return _follow_limited(position, velocity, goals, again, reach, self._acceleration[which], each)[0]

    def state(self) -> dict[str, Array]:
        """Everything that a checkpoint must keep, as live arrays."""
        return {
            "position": self.position, "velocity": self.velocity, "speed": self._speed,
            "acceleration": self._acceleration,
        }  # fmt: skip


@njit(cache=True, nogil=True, boundscheck=True)
def follow(reference, goals, reach):  # noqa: ANN001, ANN201
    """Move references (N, n) [rad] towards the ``goals`` (N, s, n) of s steps; returns where they are after each.

    In each of the s steps they move by at most ``reach`` (N,) [rad], as by `approach`.
    """
    agents, steps, joints = goals.shape
    path = np.empty(goals.shape)
    for i in range(agents):
        for j in range(joints):
            now = reference[i, j]
            for k in range(steps):
                now += min(max(goals[i, k, j] - now, -reach[i]), reach[i])
                path[i, k, j] = now
    return path


@njit(cache=True, nogil=True, boundscheck=True)
def _follow_limited(position, velocity, goals, again, reach, acceleration, step):  # noqa: ANN001, ANN202
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
                    now, v = move(now, v, goals[i, k, j], acceleration[i], step[i])
                path[i, k, j] = now
            speed[i, j] = v
    return path, speed
