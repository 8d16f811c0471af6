"""How large an arm is, beside the one that most constants of this package were chosen on.

Constants in newton metres or millimetres belong to a myCobot 280. On another arm they go with the load that
its joints carry, or with its reach; both factors are exactly one for the myCobot itself.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array
from rejoint.arms.inverse import solve_position
from rejoint.arms.kinematics import gravity_torque, position_kinematics
from rejoint.arms.mycobot280 import mycobot280
from rejoint.arms.workspace import reach

UNLOADED = 0.03
"""A joint whose load is nowhere above this share of the largest joint's carries no weight (chosen: less than the
friction of worn gears; bases and wrist rolls have 0 to 0.3 %, the first wrist of a UR5e 2.5 %, what bends a myCobot 280
or an SO-101 10 % and more, measured)"""


LEAST_LEVER = 0.02
"""A joint that moves the TCP nowhere by more than this share of the reach per radian only turns the tool (chosen: the
last joint of a myCobot or a UR5e has 0, that of an SO-101 0.017, the joints before them 0.087 and more, measured)"""


METRES = 5e-3
"""[m] in which no arm's tool keeps all coordinates: what does, read in millimetres, was given in metres (chosen)"""


def in_metres(places: Array) -> bool:
    """Tell whether places (..., 3) [m], read in millimetres, were given in metres; NaN is not known."""
    known = np.abs(places[np.isfinite(places)])
    return known.size > 0 and bool((known < METRES).all())


@lru_cache(maxsize=32)
def heaviest_load(arm: Arm, per_edge: int = 2) -> Array:
    """Largest gravity torque (n,) [N m] of each joint over a grid of targets, ``per_edge`` along each edge."""
    load: Array = np.abs(gravity_torque(arm, _postures(arm, per_edge))).max(axis=0)
    load.setflags(write=False)
    return load


def _postures(arm: Arm, per_edge: int) -> Array:
    """Postures (per_edge^3, n) [rad] that a grid of targets needs."""
    axes = [np.linspace(low, high, per_edge) for low, high in zip(arm.targets.lower, arm.targets.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return solve_position(arm, grid, arm.rest).q


@lru_cache(maxsize=32)
def unloaded_joints(arm: Arm) -> NDArray[np.bool_]:
    """Tell which joints (n,) carry no weight anywhere in the region of targets, and so rest on no flank of a gear."""
    load = heaviest_load(arm)
    mask: NDArray[np.bool_] = load < UNLOADED * load.max()
    mask.setflags(write=False)
    return mask


@lru_cache(maxsize=32)
def moves_tool(arm: Arm) -> NDArray[np.bool_]:
    """Tell which joints (n,) move the TCP somewhere in the region of targets; the others only turn the tool."""
    lever = np.linalg.norm(position_kinematics(arm, _postures(arm, 2))[1], axis=-2).max(axis=0)
    mask: NDArray[np.bool_] = lever > LEAST_LEVER * reach(arm)
    mask.setflags(write=False)
    return mask


@lru_cache(maxsize=32)
def torque_size(arm: Arm) -> float:
    """Largest load of an arm's joints by that of a myCobot 280."""
    return float(heaviest_load(arm).max() / heaviest_load(reference_arm()).max())


@lru_cache(maxsize=32)
def length_size(arm: Arm) -> float:
    """Reach of an arm by that of a myCobot 280."""
    return reach(arm) / reach(reference_arm())


@lru_cache(maxsize=1)
def reference_arm() -> Arm:
    """Return the arm that constants were chosen on."""
    return mycobot280()
