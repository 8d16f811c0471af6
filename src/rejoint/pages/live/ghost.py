"""What the arm's twin does under the same commands, beside the arm."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.pages.live.ring import Records
from rejoint.twin.simulation import Draw, Simulation

if TYPE_CHECKING:
    from rejoint.twin.twin import Twin

LONGEST = 0.5
"""[s] between two records from which the twin is put where the arm is (chosen: it was not told what came between)"""


class Ghost:
    """A twin that is sent what its arm is sent. It begins where the arm is at the start of every run of the loop."""

    def __init__(self, arm: Arm, twin: Twin) -> None:
        self._draw = Draw.of(twin.parameters.repeat(1), twin.stiction, twin.acceleration)
        self._simulation = Simulation(arm, 1)
        self._now: tuple[float, float, float] | None = None  # run, arm, time [s] of the record that was followed last

    def follow(self, records: Records) -> Array:
        """Follow what the arm was sent; returns the joint positions (K, n) [rad] at the times of the records."""
        predicted = np.empty_like(records.position)
        for k in range(len(records)):
            run, arm, now = float(records.run[k]), float(records.arm[k]), float(records.time[k])
            passed = np.nan if self._now is None or self._now[:2] != (run, arm) else now - self._now[2]
            if 0.0 < passed <= LONGEST:
                self._simulation.advance(np.array([passed]))
            elif passed != 0.0:
                self._simulation.place(self._draw, records.position[k, None], records.command[k, None])
            self._simulation.send(records.command[k, None])
            predicted[k], self._now = self._simulation.measured[0], (run, arm, now)
        return predicted
