"""Latency between a controller and twins: commands arrive late, positions are old when they come.

Every arm has delays and a control period of its own. Times are those of each arm's own clock.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.control.robot import Mask
from rejoint.system.errors import InputError

DEPTH = 4
"""Commands that are remembered: 40 ms of delay at the shortest period of 18 ms."""


class Latency:
    """Commands on their way out and positions on their way back, for N arms of n joints."""

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
        self._check(len(time))
        return _in_force(self._sent, self.command_delay, self._commands, time)

    def sent_again(self, time: Array) -> NDArray[np.bool_]:
        """Tell which of the commands (N, s, n) in force at ``time`` (N, s) [s] are those of the sending before."""
        self._check(len(time))
        same = np.zeros(self._commands.shape)
        same[:, :-1] = self._commands[:, :-1] == self._commands[:, 1:]
        return _in_force(self._sent, self.command_delay, same, time) > 0.0

    def record(self, time: Array, position: Array) -> None:
        """Record positions (N, substeps, n) [rad] that were passed at ``time`` (N, substeps) [s]."""
        new = time.shape[1]
        self._positions[:, :-new] = self._positions[:, new:]
        self._times[:, :-new] = self._times[:, new:]
        self._positions[:, -new:], self._times[:, -new:] = position, time

    def read(self, time: Array) -> Array:
        """Positions (N, n) [rad] that arrive at ``time`` (N,) [s], interpolated between substeps."""
        self._check(len(time))
        return _read(self._times, self._positions, time, self.readback_delay)

    def _check(self, count: int) -> None:
        if count != len(self._sent):
            raise InputError(f"latency: times of {count} arms, expected {len(self._sent)}")

    def state(self) -> dict[str, Array]:
        """Everything that a checkpoint must keep, as live arrays."""
        return {
            "command_delay": self.command_delay, "readback_delay": self.readback_delay, "commands": self._commands,
            "sent": self._sent, "positions": self._positions, "times": self._times,
        }  # fmt: skip


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
