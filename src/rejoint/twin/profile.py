"""The reference of a servo that limits its acceleration while commands keep changing.

Serial-bus servos of this class plan a trapezoid of speed towards each new goal, with a set acceleration. On the
logs of a real SO-101 (Feetech STS3215) that is seen at 254 x 100 counts/s^2, its largest setting: chirps break
down where they ask for more. Yet a jump whose goal is sent again, period after period, arrives at once: writing a
goal that has not changed ends the plan, and the goal itself is followed (measured; the vendor's manual is silent).

Between two sendings the plan is the time-optimal motion to rest at the goal (bang-bang; Pontryagin et al. 1962),
which is known in closed form, so that references are exact at any time and for any delay, as those of
`rejoint.twin.reference` are.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rejoint.arms import Array


class Profile:
    """References of servos that follow one record of commands with limited acceleration."""

    def __init__(self, time: Array, command: Array, acceleration: float) -> None:
        """Take sending times (T,) [s], commands (T, n) [rad] and the acceleration [rad/s^2]."""
        self.time, self.command, self.acceleration = time, command, acceleration
        self.position, self.velocity = _states(time, np.ascontiguousarray(command), acceleration)

    def sample(self, time: Array, delay: Array) -> Array:
        """Return references (m, s, n) [rad] at ``time`` (s,) [s] for delays (m,) [s]; at first the first command."""
        delays, which = np.unique(np.asarray(delay), return_inverse=True)
        late = time - delays[:, None]
        row = np.clip(np.searchsorted(self.time, late, side="right") - 1, 0, len(self.time) - 1)
        elapsed = np.maximum(late - self.time[row], 0.0)[..., None]
        found, _ = advance(self.position[row], self.velocity[row], self.command[row], self.acceleration, elapsed)
        return np.asarray(found[which])


def advance(
    position: Array, velocity: Array, goal: Array, acceleration: float, elapsed: Array | float
) -> tuple[Array, Array]:
    """Position and velocity after ``elapsed`` [s] of the fastest motion to rest at ``goal``; all broadcast."""
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


@njit(cache=True)  # type: ignore[untyped-decorator]
def move(position: float, velocity: float, goal: float, acceleration: float, elapsed: float) -> tuple[float, float]:
    """As `advance`, for one joint in a compiled loop."""
    away = goal - position
    direction = 1.0 if away >= 0.5 * velocity * abs(velocity) / acceleration else -1.0
    away, start = direction * away, direction * velocity
    peak = np.sqrt(max(acceleration * away + 0.5 * start**2, 0.0))
    left = max((2.0 * peak - start) / acceleration - elapsed, 0.0)
    if elapsed < (peak - start) / acceleration:
        travelled, speed = elapsed * (start + 0.5 * acceleration * elapsed), start + acceleration * elapsed
    else:
        travelled, speed = away - 0.5 * acceleration * left**2, acceleration * left
    return position + direction * travelled, direction * speed


@njit(cache=True)  # type: ignore[untyped-decorator]
def _states(time: Array, command: Array, acceleration: float) -> tuple[Array, Array]:
    """Position and velocity (T, n) of the reference at each sending, once the new command is known."""
    position, velocity = np.empty_like(command), np.zeros_like(command)
    position[0] = command[0]
    for k in range(1, len(time)):
        elapsed = time[k] - time[k - 1]
        for j in range(command.shape[1]):
            if command[k, j] == command[k - 1, j]:
                position[k, j] = command[k, j]
                continue
            position[k, j], velocity[k, j] = move(
                position[k - 1, j], velocity[k - 1, j], command[k - 1, j], acceleration, elapsed
            )
    return position, velocity
