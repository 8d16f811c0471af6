"""What the servo is really asked for: commands that arrive late and are approached at limited speed.

A position servo of this class does not jump to a new command: its reference moves there at a set speed.
The command is constant between two sendings, so the reference is a straight line and then a rest, and
both effects are computed exactly, outside of the simulation, at any time and for many twins at once.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array


class Reference:
    """References of m twins that follow one record of commands, each with its own delay and speed."""

    def __init__(self, time: Array, command: Array, ramp_speed: Array, start: Array) -> None:
        """Take sending times (T,) [s], commands (T, n) [rad], speeds (m,) [rad/s] and where to start (n,)."""
        self.time = time
        self.command = command
        self.ramp_speed = np.asarray(ramp_speed)[:, None]
        rows, n = command.shape
        # Reference at the sending of each command: what is left of each step is carried into the next.
        self.at = np.empty((rows, len(self.ramp_speed), n))
        self.at[0] = start
        for k in range(rows - 1):
            self.at[k + 1] = approach(self.at[k], command[k], self.ramp_speed * (time[k + 1] - time[k]))

    def sample(self, time: Array, delay: Array) -> Array:
        """Return references (m, s, n) [rad] at ``time`` (s,) [s] for delays (m,) [s]; at first the start."""
        late = time - np.asarray(delay)[:, None]
        row = np.clip(np.searchsorted(self.time, late, side="right") - 1, 0, len(self.time) - 1)
        elapsed = np.maximum(late - self.time[row], 0.0)
        twin = np.arange(len(self.ramp_speed))[:, None]
        return approach(self.at[row, twin], self.command[row], (self.ramp_speed * elapsed)[..., None])


def approach(reference: Array, goal: Array, step: Array | float) -> Array:
    """Move ``reference`` towards ``goal`` by at most ``step``; all broadcast."""
    return reference + np.clip(goal - reference, -step, step)
