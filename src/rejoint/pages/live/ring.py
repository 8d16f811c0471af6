"""What the control loop leaves for those who look on: records in a ring of fixed size, one writer, no lock.

A record is what the loop has in its hands anyway and never changes again (`rejoint.control.recording` keeps it as
well), so that to write one is to put a number and four references into a slot, in a tenth of a microsecond
(`python -m benchmarks live`). A reader looks at the numbers: a slot that was filled anew meanwhile is left out. Neither
ever waits for the other; a reader that is too slow loses the oldest records.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.control.recording import Cycle
from rejoint.control.robot import JointState

SLOTS = 512
"""Records in a ring (chosen: ten seconds at the shortest usual period; readers come 25 times a second)"""
_HEAD, _POINTS = 5, 9
_Slot = tuple[int, int, Cycle, JointState, Array]


@dataclass(frozen=True, eq=False)
class Records:
    """K cycles of one arm, the oldest first."""

    rows: Array
    """(K, 14 + 5 n)"""
    joints: int

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def time(self) -> Array:
        """(K,) [s] of the robot's clock."""
        return self.rows[:, 0]

    @property
    def run(self) -> Array:
        """(K,) number of the run of the control loop."""
        return self.rows[:, 1]

    @property
    def index(self) -> Array:
        """(K,) of the target."""
        return self.rows[:, 2]

    @property
    def reasons(self) -> Array:
        """(K,) flags of the guard."""
        return self.rows[:, 3]

    @property
    def arm(self) -> Array:
        """(K,) which of a batch."""
        return self.rows[:, 4]

    @property
    def target(self) -> Array:
        """(K, 3) [m]; NaN where there is none."""
        return self.rows[:, 5:8]

    @property
    def aim(self) -> Array:
        """(K, 3) [m] where the controller was sent."""
        return self.rows[:, 8:11]

    @property
    def true_tcp(self) -> Array:
        """(K, 3) [m]; NaN where nobody knows."""
        return self.rows[:, 11:14]

    @property
    def position(self) -> Array:
        """(K, n) [rad] measured."""
        return self._joint(0)

    @property
    def command(self) -> Array:
        """(K, n) [rad] sent."""
        return self._joint(1)

    @property
    def wanted(self) -> Array:
        """(K, n) [rad] by the controller, before the guard."""
        return self._joint(2)

    @property
    def load(self) -> Array:
        """(K, n) share of the largest torque; NaN where it is not told."""
        return self._joint(3)

    @property
    def temperature(self) -> Array:
        """(K, n) [deg C]; NaN where it is not told."""
        return self._joint(4)

    def lately(self, seconds: float) -> Records:
        """Return those of the newest run and arm of its last ``seconds``."""
        if not len(self):
            return self
        same = (self.run == self.run[-1]) & (self.arm == self.arm[-1]) & (self.time > self.time[-1] - seconds)
        return Records(self.rows[same], self.joints)

    def then(self, later: Records) -> Records:
        """Return these and ``later`` ones."""
        return Records(np.concatenate([self.rows, later.rows]), self.joints)

    def _joint(self, k: int) -> Array:
        first = _HEAD + _POINTS + k * self.joints
        return self.rows[:, first : first + self.joints]


class Ring:
    """The newest cycles of an arm with ``joints`` joints."""

    def __init__(self, joints: int, slots: int = SLOTS) -> None:
        self._slots: list[_Slot | None] = [None] * slots
        self._joints, self._size = joints, slots
        self.count = 0
        """records written so far"""

    def write(self, run: int, cycle: Cycle, state: JointState, wanted: Array) -> None:
        """Write a record; for the control loop."""
        count = self.count
        self._slots[count % self._size] = count, run, cycle, state, wanted
        self.count = count + 1

    def since(self, count: int) -> tuple[Records, int]:
        """Return what was written after the first ``count`` records, as far as it is still there, and the new count."""
        end, rows = self.count, []
        for number in range(max(count, end - self._size, 0), end):
            slot = self._slots[number % self._size]
            if slot is not None and slot[0] == number:
                rows.append(_row(*slot[1:]))
        return Records(np.array(rows).reshape(len(rows), _HEAD + _POINTS + 5 * self._joints), self._joints), end


def _row(run: int, cycle: Cycle, state: JointState, wanted: Array) -> Array:
    """One record in numbers; of a batch it is the first arm that is still driven."""
    b = int(cycle.active.argmax())
    heat = np.full(wanted.shape[1], np.nan) if state.temperature is None else state.temperature[b]
    head = (cycle.time[b], run, cycle.target_index[b], cycle.reasons[b], b)
    return np.concatenate(
        (head, cycle.target[b], cycle.aim[b], cycle.true_tcp[b], cycle.position[b], cycle.command[b], wanted[b],
         cycle.load[b], heat)
    )  # fmt: skip
