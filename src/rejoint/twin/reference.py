"""What the servo is really asked for: commands that arrive late and are approached at limited speed.

A position servo of this class does not jump to a new command: its reference moves there at a set speed.
The command is constant between two sendings, so the reference is a straight line and then a rest, and
both effects are computed exactly, outside of the simulation, at any time and for many twins at once.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array

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

    def sample(self, time: Array, delay: Array) -> Array:
        """Return references (m, s, n) [rad] at ``time`` (s,) [s] for delays (m,) [s]; at first the start."""
        late = time - np.asarray(delay)[:, None]
        row = np.clip(np.searchsorted(self.time, late, side="right") - 1, 0, len(self.time) - 1)
        elapsed = np.maximum(late - self.time[row], 0.0)
        twin = self.which[:, None]
        return approach(self.at[row, twin], self.command[row], (self.ramp_speed[self.which] * elapsed)[..., None])


def approach(reference: Array, goal: Array, step: Array | float) -> Array:
    """Move ``reference`` towards ``goal`` by at most ``step``; all broadcast."""
    return reference + np.clip(goal - reference, -step, step)
