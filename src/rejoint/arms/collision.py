"""Contacts of an arm with itself, the ground or a box, by capsules.

Pairs of links that meet in a joint, overlap at rest or at a target (Coleman et al. 2014), or keep their distance do not
count. Distances: Ericson 2005, section 5.1.9.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array, Mask, frozen
from rejoint.arms.inertia import LINK_RADIUS_RATIO
from rejoint.arms.kinematics import all_poses, chain_of, heights, rows_of
from rejoint.arms.workspace import length_size, posture_grid, reach, rising_frames
from rejoint.system.shell import Late

compiled = Late("rejoint.arms.compiled")

GROUND = 0.0
"""[m] or the arm's lower floor"""


JOINT_CLEARANCE = 0.01
"""[m] of joint frames above the floor, for a myCobot 280 (chosen)"""

_STILL = 1e-6
"""[m] rounding"""

GRID = 3
"""Free targets per edge (chosen)"""


class CollisionShape(NamedTuple):
    """Capsules; link 0 is the base, ends are base to TCP."""

    floors: Array
    """(n,) [m] under the joint frames but the first, and the TCP; empty: heights do not count"""
    radius: float
    """[m]"""
    pairs: NDArray[np.int64]
    """(P, 2) links that can touch"""
    places: NDArray[np.int64]
    """(G,) ends that can touch the ground"""
    ground: float
    """[m]"""
    moving: NDArray[np.int64]
    """(L,) links that can enter boxes"""
    boxes: Array
    """(K, 6) [m] lower and upper corners"""


@lru_cache
def collision_shape(arm: Arm) -> CollisionShape:
    """Capsules and their pairs."""
    solution, links = posture_grid(arm, GRID), arm.joints + 1
    free = np.vstack([arm.rest, solution.q[solution.converged]])  # rest and targets: without contacts
    radius, ground = LINK_RADIUS_RATIO * reach(arm), min(GROUND, arm.floor)
    places = np.flatnonzero(np.append(0.0, heights(arm, arm.rest)) > ground + radius)
    apart = np.transpose(np.triu_indices(links, 2))
    boxes = np.array([box.ends for box in arm.keep_out]).reshape(-1, 6)
    shape = CollisionShape(frozen([]), radius, frozen(apart), frozen(places), ground, _moving(arm), frozen(boxes))
    distance = clearances_of(arm, shape, free)[:, : len(apart)]
    return shape._replace(pairs=frozen(apart[(distance > 0.0).all(axis=0) & (np.ptp(distance, axis=0) > _STILL)]))


def collides(arm: Arm, q: Array) -> Mask:
    """Which postures (..., n) [rad] have a contact."""
    return np.asarray((clearances(arm, q) < 0.0).any(axis=-1))


def clearances_of(arm: Arm, shape: CollisionShape, q: Array) -> Array:
    """Heights of a ``shape`` above its floors (n,), if any, then its `clearances`, (..., n + P + G + L K) [m].

    Heights: joint frames but the first, and TCP.
    """
    found = compiled.clearances(chain_of(arm), shape, rows_of(arm, q))
    return found.reshape(*q.shape[:-1], found.shape[1])


@lru_cache
def usual_distances(arm: Arm) -> Array:
    """Distances (256, c) [m] between bodies at random postures."""
    return clearances(arm, arm.drawn(256, seed=1))


def guarded_floors(arm: Arm) -> Array:
    """Lowest heights (n,) [m] of the joint frames but the first, and TCP; -inf: hardly rises."""
    joint_floor = arm.floor + JOINT_CLEARANCE * length_size(arm)
    return frozen(np.append(np.where(rising_frames(arm, joint_floor)[1:], joint_floor, -np.inf), arm.floor))


def clearances(arm: Arm, q: Array) -> Array:
    """Distances (..., P + G + L K) [m] of capsules at ``q`` (..., n) [rad]; negative: contact.

    Between links, ends and ground, links and boxes.
    """
    return clearances_of(arm, collision_shape(arm), q)


def contact(arm: Arm, item: int) -> tuple[str, str]:
    """Return what comes near to what at distance ``item`` of `clearances_of`."""
    shape, frames = collision_shape(arm), (*arm.joint_names, "the tool")
    links = ["the base", *(f"the link after {name}" for name in arm.joint_names)]
    named = [(frame, "its floor") for frame in frames[1:]]
    named += [(links[one], links[other]) for one, other in shape.pairs]
    named += [(frames[end - 1], "the ground") for end in shape.places]
    named += [(links[link], f"keep_out box {box + 1}") for box in range(len(shape.boxes)) for link in shape.moving]
    return named[item]


def _moving(arm: Arm) -> NDArray[np.int64]:
    """Links (L,) with a moving end."""
    still = np.ptp(all_poses(arm, arm.drawn(16))[..., :3, 3], axis=0).max(axis=-1) < _STILL
    return frozen(np.flatnonzero(~(np.append(True, still[:-1]) & still)))
