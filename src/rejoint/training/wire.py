"""The wire between policy and twin in training: commands arrive late, positions are old when they come.

Every agent has delays and a control period of its own. Times are those of each agent's own clock.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.control.robot import Mask

DEPTH = 4
"""Commands that are remembered: 40 ms of delay at the shortest period of 18 ms."""


class Wire:
    """Commands on their way out and positions on their way back, for N agents of n joints."""

    def __init__(self, agents: int, joints: int, substeps: int) -> None:
        self.command_delay = np.zeros(agents)
        """(N,) [s]"""
        self.readback_delay = np.zeros(agents)
        """(N,) [s]"""
        self._commands = np.zeros((agents, DEPTH, joints))  # newest first
        self._sent = np.full((agents, DEPTH), -np.inf)
        self._positions = np.zeros((agents, 2 * substeps + 1, joints))  # oldest first
        self._times = np.zeros((agents, 2 * substeps + 1))
        self._agent = np.arange(agents)

    def clear(self, where: Mask, command: Array, position: Array) -> None:
        """Begin at time 0 in ``where`` (N,): ``command`` (m, n) has long been in force, ``position`` (m, n) stands."""
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
        """Commands (N, s, n) [rad] that the servos know at ``time`` (N, s) [s]."""
        arrival = self._sent + self.command_delay[:, None]
        pending = np.zeros(time.shape, dtype=np.intp)
        for one in arrival.T[:-1]:  # the oldest is in force where no other is
            pending += one[:, None] > time
        return self._commands[self._agent[:, None], pending]

    def record(self, time: Array, position: Array) -> None:
        """Record positions (N, substeps, n) [rad] that were passed at ``time`` (N, substeps) [s]."""
        new = time.shape[1]
        self._positions[:, :-new] = self._positions[:, new:]
        self._times[:, :-new] = self._times[:, new:]
        self._positions[:, -new:], self._times[:, -new:] = position, time

    def read(self, time: Array) -> Array:
        """Positions (N, n) [rad] that arrive at ``time`` (N,) [s], interpolated between substeps."""
        then = time - self.readback_delay
        later = np.clip((self._times <= then[:, None]).sum(axis=1), 1, self._times.shape[1] - 1)
        t0, t1 = self._times[self._agent, later - 1], self._times[self._agent, later]
        share = np.clip((then - t0) / (t1 - t0), 0.0, 1.0)[:, None]
        p0, p1 = self._positions[self._agent, later - 1], self._positions[self._agent, later]
        return p0 + share * (p1 - p0)

    def state(self) -> dict[str, Array]:
        """Everything that a checkpoint must keep, as live arrays."""
        return {
            "command_delay": self.command_delay, "readback_delay": self.readback_delay, "commands": self._commands,
            "sent": self._sent, "positions": self._positions, "times": self._times,
        }  # fmt: skip
