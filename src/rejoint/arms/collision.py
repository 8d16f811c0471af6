"""Contacts of an arm with itself, the ground or a box, by capsules.

Pairs of links that meet in a joint, or overlap at rest or at a target, do not count (Coleman et al. 2014). Distances:
Ericson 2005, "Real-Time Collision Detection", section 5.1.9.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array
from rejoint.arms.catalogue import mycobot280
from rejoint.arms.inertia import LINK_RADIUS_RATIO
from rejoint.arms.kinematics import Frames, all_poses, frames
from rejoint.arms.workspace import posture_grid, reach, rising_frames
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


@dataclass(frozen=True, kw_only=True, eq=False)
class CollisionShape:
    """Capsules; link 0 is the base."""

    radius: float
    """[m]"""
    pairs: NDArray[np.intp]
    """(P, 2) links that can touch"""
    grounded: NDArray[np.bool_]
    """(n + 2,) ends, base to TCP, that can touch the ground"""
    ground: float
    """[m]"""
    moving: NDArray[np.int64]
    """(L,) links that can enter boxes"""
    boxes: Array
    """(K, 6) [m] lower and upper corners"""

    @cached_property
    def places(self) -> NDArray[np.int64]:
        """(G,) ends that can touch the ground."""
        return np.flatnonzero(self.grounded).astype(np.int64)


@lru_cache(maxsize=32)
def collision_shape(arm: Arm) -> CollisionShape:
    """Capsules and their pairs."""
    f = frames(arm, _work(arm))
    first, links = _ends(f)[0], arm.joints + 1
    radius, ground = LINK_RADIUS_RATIO * reach(arm), min(GROUND, arm.floor)
    apart = np.array([(i, j) for i in range(links) for j in range(i + 2, links)], dtype=np.intp).reshape(-1, 2)
    shape = CollisionShape(
        radius=radius,
        pairs=apart,
        grounded=first[:, 2] > ground + radius,
        ground=ground,
        moving=_moving(arm),
        boxes=np.array([[*box.lower, *box.upper] for box in arm.keep_out]).reshape(-1, 6),
    )
    return replace(shape, pairs=apart[(_gaps(shape, f)[:, : len(apart)] > 0.0).all(axis=0)])


def collides(arm: Arm, f: Frames) -> NDArray[np.bool_]:
    """Which postures of the frames ``f`` (...) have a contact."""
    return np.asarray((_gaps(collision_shape(arm), f) < 0.0).any(axis=-1).reshape(f.tcp_position.shape[:-1]))


def _gaps(shape: CollisionShape, f: Frames) -> Array:
    """Distances (B, P + G + L K) [m] at B postures."""
    points = _ends(f)[..., 1:, :]
    points = points.reshape(-1, *points.shape[-2:])
    poses = np.empty((points.shape[1], 3, 4, len(points)))
    poses[:, :, 3] = points.transpose(1, 2, 0)
    return _fill(shape, poses, np.zeros(0))


def _fill(shape: CollisionShape, poses: Array, floors: Array) -> Array:
    """Clearances (B, len(floors) + P + G + L K) [m] at ``poses`` (n + 1, 3, 4, B)."""
    counted = len(floors) + len(shape.pairs) + len(shape.places) + len(shape.moving) * len(shape.boxes)
    clear = np.empty((poses.shape[-1], counted))
    compiled.fill_clearances(
        poses, floors, shape.pairs, shape.places, shape.radius, shape.ground, shape.moving, shape.boxes, clear
    )
    return clear


@lru_cache(maxsize=32)
def usual_distances(arm: Arm) -> Array:
    """Distances (256, c) [m] between bodies at random postures."""
    drawn = np.random.default_rng(1).uniform(arm.lower, arm.upper, (256, arm.joints))
    return clearances(arm, drawn, np.zeros(0))


@lru_cache(maxsize=32)
def guarded_floors(arm: Arm) -> Array:
    """Lowest heights (n,) [m] of the joint frames but the first, and TCP; -inf: hardly rises."""
    joint_floor = arm.floor + JOINT_CLEARANCE * reach(arm) / reach(mycobot280())
    floors = np.append(np.where(rising_frames(arm, joint_floor)[1:], joint_floor, -np.inf), arm.floor)
    floors.setflags(write=False)
    return floors


def clearances(arm: Arm, q: Array, floors: Array) -> Array:
    """Heights above ``floors`` (n,), then distances of capsules, (..., n + P + G + L K) [m] at ``q`` (..., n) [rad].

    Heights: joint frames but the first, and TCP. Distances: links, ends and ground, links and boxes; negative: contact.
    """
    clear = _fill(collision_shape(arm), all_poses(arm, q, slice(0, 3)), floors)
    return clear.reshape(*q.shape[:-1], clear.shape[-1])


def contact(arm: Arm, item: int) -> tuple[str, str]:
    """Return the two bodies at distance ``item`` of `clearances`."""
    shape, names = collision_shape(arm), arm.joint_names

    def link(i: int) -> str:
        return "the base" if i == 0 else f"the link after {names[i - 1]}"

    if item < len(shape.pairs):
        one, two = shape.pairs[item].tolist()
        return link(one), link(two)
    item -= len(shape.pairs)
    if item < len(shape.places):
        end = int(shape.places[item])
        return "the tool" if end == arm.joints + 1 else names[end - 1], "the ground"
    box, moving = divmod(item - len(shape.places), len(shape.moving))
    return link(int(shape.moving[moving])), f"keep_out box {box + 1}"


def _moving(arm: Arm) -> NDArray[np.int64]:
    """Links (L,) with a moving end."""
    postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (16, arm.joints))
    still = np.ptp(_ends(frames(arm, postures)), axis=0).max(axis=-1) < _STILL
    return np.flatnonzero(~(still[:-1] & still[1:])).astype(np.int64)


def _work(arm: Arm) -> Array:
    """Postures (m, n) [rad] without contacts: rest, targets."""
    solution = posture_grid(arm, GRID)
    return np.concatenate([arm.rest[None], solution.q[solution.converged]])


def _ends(f: Frames) -> Array:
    """Capsule ends (..., n + 2, 3) [m]."""
    base = np.zeros((*f.tcp_position.shape[:-1], 1, 3))
    return np.concatenate([base, f.position, f.tcp_position[..., None, :]], axis=-2)
