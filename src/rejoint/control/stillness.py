"""How long an arm has stood still under one command: what comes of it is known then, and need not be waited for."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.control.robot import JointState


class Stillness:
    """Looks on at B arms, cycle by cycle."""

    def __init__(self, state: JointState, sent: Array, encoder_step: float) -> None:
        """Begin with what is read and the command in force (B, n) [rad]; a reading may flicker by an encoder step."""
        self._position, self._sent, self._since = state.position.copy(), sent.copy(), state.time.copy()
        self._flicker = 1.5 * encoder_step

    def look(self, state: JointState, sent: Array) -> Array:
        """Return the time (B,) [s] for which each arm has stood under its command."""
        moved = (np.abs(state.position - self._position) > self._flicker) | (sent != self._sent)
        stirred = np.logical_or.reduce(moved, axis=-1)
        if np.count_nonzero(stirred):
            self._position[stirred], self._sent[stirred] = state.position[stirred], sent[stirred]
            self._since[stirred] = state.time[stirred]
        return np.asarray(state.time - self._since)
