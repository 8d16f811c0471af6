"""How the numbers of one arm become those of another: a wear profile on an arm of any size.

The profiles hold what a myCobot 280 has. On another arm a joint takes the numbers of the myCobot's joint
at the same share of the way along the chain, times powers of two ratios:

* torque T, joint by joint: of the joint's effort to that of the myCobot's joint. The effort is what its motor is
  there for, hypot(G, I g/L, 0.3 max G): G the largest gravity torque over the region of targets, I the
  inertia of the links that it turns in the rest posture, L the reach. The second term stands for
  acceleration, for joints without gravity load: whatever moves under gravity does so at about g/L. The third
  stands for a servo of some size where there is neither.
* time t, for the whole arm: sqrt(L / L0), since g is the same for all.

Torques and torques per angle (gains, stiffness) go with T, damping with T t, inertia with T t^2; angles and
shares stay. Gains then go with inertia over time squared. These are the only ratios with which an arm
that is the same but larger or heavier (lengths times a, masses times b, so T = a b, t = sqrt(a)) rests at the same
joint angles and moves in the same way in its own time: its errors are the same share of its reach.

Arms of other builds sag by about the same angles, and miss by those angles times the distance of their targets: with
the default controller healthy ones by 1.6 to 1.8 % of the distance of the targets' middle from the base's axis
(myCobot 280, SO-101, UR5e, UR10, Panda, xArm 6 and CRX-5iA; 0.6 to 1.2 % of the summed link lengths), worn ones by
7.4 to 9.1 %, the myCobot by 12 %, since its fourth joint is too weak to start, as no scaled one is (measured,
30 targets each).

An arm of another build may carry more on a joint than the place in the chain suggests, so no scaled servo
gets weaker than what moves the arm in its region of targets.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, link_inertia
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.size import heaviest_load, length_size, reference_arm
from rejoint.arms.workspace import reach

FLOOR = 0.3
"""Least effort of a joint by the largest load (chosen: in small arms as in large ones neighbouring joints have the same
motors or the next size, and those of the wrist a fifth to all of the torque of those near the base)."""

_GRID = 5
"""Targets along each edge of the region over which the gravity torques are taken (chosen)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ratios:
    """Ratios of an arm to the myCobot 280; exactly one for that arm itself."""

    row: NDArray[np.intp]
    """(n,) joint of the myCobot 280 whose numbers each joint takes"""
    torque: Array
    """(n,) [1]"""
    time: float
    """[1]"""


@lru_cache(maxsize=16)
def scale_of(arm: Arm) -> Ratios:
    """Compare an arm with the myCobot 280."""
    reference = reference_arm()
    row = np.rint(np.linspace(0.0, reference.joints - 1, arm.joints)).astype(np.intp)
    return Ratios(
        row=row,
        torque=effort(arm) / effort(reference)[row],
        time=float(np.sqrt(length_size(arm))),
    )


@lru_cache(maxsize=16)
def effort(arm: Arm) -> Array:
    """Torque (n,) [N m] that stands for the size of each joint."""
    load = largest_load(arm)
    rate = np.linalg.norm(GRAVITY) / reach(arm)
    least = max(FLOOR * float(load.max()), np.finfo(float).tiny)
    return np.sqrt(load**2 + (link_inertia(arm, arm.rest) * rate) ** 2 + least**2)


def largest_load(arm: Arm) -> Array:
    """Largest gravity torque (n,) [N m] of each joint over the region of targets."""
    return heaviest_load(arm, _GRID)
