"""Records of the control loop for other threads: a ring, and the twin.

One writer, no lock: a reader skips slots that were written meanwhile.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.recording import Cycle
from rejoint.control.robot import JointState
from rejoint.twin.simulation import Draw, Simulation

if TYPE_CHECKING:
    from rejoint.twin.twin import Twin


SLOTS = 512
"""(chosen: ten seconds at the shortest usual period)"""
_Slot = tuple[int, int, Cycle, JointState, Array]

Records: TypeAlias = "np.recarray[Any, Any]"
"""K cycles of one arm, the oldest first; fields of `_kind`"""


def _kind(joints: int) -> np.dtype[np.void]:
    """Fields of a record: [s], [m], [rad], share of torque, [deg C]; NaN: unknown."""
    numbers = [(name, "f8") for name in ("time", "run", "index", "reasons", "arm")]
    points = [(name, "f8", (3,)) for name in ("target", "aim", "true_tcp")]
    # `wanted` is the command of the controller, before the guard
    each = [(name, "f8", (joints,)) for name in ("position", "command", "wanted", "load", "temperature")]
    return np.dtype([*numbers, *points, *each])


def lately(records: Records, seconds: float) -> Records:
    """Return records of the newest run and arm in the last ``seconds``."""
    if not len(records):
        return records
    last = records[-1]
    return records[(records.run == last.run) & (records.arm == last.arm) & (records.time > last.time - seconds)]


class Ring:
    """Newest cycles of an arm."""

    def __init__(self, joints: int, slots: int = SLOTS) -> None:
        self._slots: list[_Slot | None] = [None] * slots
        self._kind, self._size = _kind(joints), slots
        self.count = 0
        """of written records"""

    def write(self, run: int, cycle: Cycle, state: JointState, wanted: Array) -> None:
        """Write a record."""
        count = self.count
        self._slots[count % self._size] = count, run, cycle, state, wanted
        self.count = count + 1

    def since(self, count: int) -> tuple[Records, int]:
        """Return records after the first ``count``, as far as kept, and the new count."""
        end, rows = self.count, []
        for number in range(max(count, end - self._size, 0), end):
            slot = self._slots[number % self._size]
            if slot is not None and slot[0] == number:
                rows.append(_row(*slot[1:]))
        return np.array(rows, dtype=self._kind).view(np.recarray), end


def _row(run: int, cycle: Cycle, state: JointState, wanted: Array) -> tuple[Any, ...]:
    b = int(cycle.active.argmax())
    heat = np.full(wanted.shape[1], np.nan) if state.temperature is None else state.temperature[b]
    return (
        cycle.time[b],
        run,
        cycle.target_index[b],
        cycle.reasons[b],
        b,
        cycle.target[b],
        cycle.aim[b],
        cycle.true_tcp[b],
        cycle.position[b],
        cycle.command[b],
        wanted[b],
        cycle.load[b],
        heat,
    )


LONGEST = 0.5
"""[s] gap after which the twin restarts (chosen)"""


class Ghost:
    """A twin that receives the arm's commands; restarts with every run."""

    def __init__(self, arm: Arm, twin: Twin) -> None:
        self._draw = Draw.of(twin.parameters.repeat(1), twin.stiction, twin.acceleration)
        self._simulation = Simulation(arm, 1)
        self._now: tuple[float, float, float] | None = None  # run, arm, time [s] of the record that was followed last

    def follow(self, records: Records) -> Array:
        """Positions (K, n) [rad] of the twin at the records' times."""
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
