"""The channel between a computer and the arm: latency, readback age and period, redrawn every cycle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.robots.lab.plant.streams import Keys, uniform
from rejoint.system.errors import InputError

Interval = tuple[float, float]

_DRAWS = 3


class Delays(NamedTuple):
    """What the channel does in one control cycle."""

    latency: Array
    """(B,) [s] from sending a command to its arrival in the firmware"""
    age: Array
    """(B,) [s] how old a joint position is when its answer arrives"""
    period: Array
    """(B,) [s] length of the cycle"""


@dataclass(frozen=True, kw_only=True)
class Channel:
    """Uniform distributions of the delays.

    The defaults are those of an idle wire; a myCobot over TCP or serial needs 20-50 ms a cycle
    (measured, with about 12 ms for a read and 8 ms for an acknowledgement).
    """

    latency: Interval = (0.008, 0.013)
    """[s]"""
    age: Interval = (0.006, 0.013)
    """[s]"""
    period: Interval = (0.020, 0.030)
    """[s]"""

    def __post_init__(self) -> None:
        for name in ("latency", "age", "period"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high:
                raise InputError(f"channel: {name} needs 0 <= low <= high [s], got ({low}, {high})")
        if self.period[0] < 0.001:
            raise InputError(f"channel: the period must be at least 0.001 s, got {self.period[0]}")

    def draw(self, keys: Keys, cycle: NDArray[np.int64]) -> Delays:
        """Delays of cycle number ``cycle`` (B,) for the arms with these stream keys (B,)."""
        unit = _draw_units(keys, cycle)
        low, high = np.array([self.latency, self.age, self.period]).T
        return Delays(*(low + unit * (high - low)).T)


@njit(cache=True)
def _draw_units(keys, cycle):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    unit = np.empty((len(keys), _DRAWS))
    for i in range(len(keys)):
        for k in range(_DRAWS):
            unit[i, k] = uniform(keys[i], cycle[i] * _DRAWS + k)
    return unit
