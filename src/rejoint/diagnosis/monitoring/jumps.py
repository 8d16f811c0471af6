"""Zeros that have moved between two checks: what a collision or a screwdriver does at once, and wear never.

A zero that moves by an angle moves where its joint comes to rest by that angle in all poses and from both sides. Wear
shows in more than that: a weaker servo hangs lower where it carries more, which is sag, and friction holds a joint back
on either side. So a change of the deviation alone, many times its scatter from one check to the next, is no wear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array

SURE = 5.0
"""Standard deviations of the difference of two checks from which a zero has jumped (chosen: of arms that wear or
stay as they are none is said to have moved, `python -m benchmarks years`)"""
SHARE = 1.0 / 3.0
"""Of the jump, below which nothing else may have changed (chosen: what a joint gives way to its weight and to friction
hardly depends on where its zero is, while wear moves its sag by as much as its deviation)"""
STAYED = 0.5
"""Share of the jump that has to lie between the checks before it and the newest: one odd check is no jump (chosen)"""
BEFORE = 3
"""Checks before a jump whose median says where the zero was (chosen: the fewest that bear an odd one)"""
UNTOLD = 10.0
"""[K] by which the warmth of two checks may differ where the servos do not tell (chosen: a room over the seasons)"""


@dataclass(frozen=True, kw_only=True)
class Jump:
    """The zero of a joint has moved between two checks."""

    at: int
    """index of the first check after it"""
    way: float
    """in the unit of the deviations, with sign"""


def find_jump(
    deviation: Array, others: Sequence[Array], temperature: Array, *, scatter: float, per_degree: float
) -> Jump | None:
    """Find where the zero of a joint has moved since the norm began, the last time; None where it has not.

    ``deviation`` (T,) [mm] at ``temperature`` (T,) [deg C], NaN where the servos do not tell; ``others`` are what wear
    changes as well, each (T,) [mm]. ``scatter`` [mm] and ``per_degree`` [mm/K] are as for `chart`.
    """
    for at in range(len(deviation) - 1, 0, -1):
        way = float(deviation[at] - deviation[at - 1])
        warmer = float(temperature[at] - temperature[at - 1])
        doubt = per_degree * (abs(warmer) if np.isfinite(warmer) else UNTOLD)
        if abs(way) < SURE * float(np.hypot(2.0**0.5 * scatter, doubt)):
            continue
        alone = all(abs(float(one[at] - one[at - 1])) < SHARE * abs(way) for one in others)
        was = float(np.median(deviation[max(at - BEFORE, 0) : at]))
        stayed = (float(deviation[-1]) - was) / way >= STAYED
        if alone and stayed:
            return Jump(at=at, way=way)
    return None
