"""How large an arm is, beside the one that the thresholds in this package were chosen on.

Thresholds in newton metres or millimetres belong to a myCobot 280. On another arm they go with the load that its
joints carry, or with its reach; both factors are exactly one for the myCobot itself.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, mycobot280, solve_position
from rejoint.arms.workspace import reach


@lru_cache(maxsize=8)
def heaviest_load(arm: Arm) -> Array:
    """Largest gravity torque (n,) [N m] of each joint at the corners of the target region."""
    corners = np.array(list(product(*zip(arm.targets.lower, arm.targets.upper, strict=True))))
    return np.abs(gravity_torque(arm, solve_position(arm, corners, arm.rest).q)).max(axis=0)


@lru_cache(maxsize=8)
def torque_size(arm: Arm) -> float:
    """Largest load of an arm's joints by that of a myCobot 280."""
    return float(heaviest_load(arm).max() / heaviest_load(mycobot280()).max())


@lru_cache(maxsize=8)
def length_size(arm: Arm) -> float:
    """Reach of an arm by that of a myCobot 280."""
    return reach(arm) / reach(mycobot280())
