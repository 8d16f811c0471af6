"""Whether an arm touches itself or the ground: one capsule along every link, from joint to joint.

The capsules are as thick as the housings that masses are estimated with (`LINK_RADIUS_RATIO`). Which pairs
are looked at follows from the arm alone, as motion planners choose them from postures known to be free
(Coleman et al. 2014, "Reducing the Barrier to Entry of Complex Robotic Software: a MoveIt! Case Study"):
links that meet in a joint never count, nor do pairs whose capsules overlap in the rest posture or in one that a target
needs. The thin wrist of a Kinova Jaco (j2s6s300) is such a pair; no other arm of the tests has one at its targets.

Two ways to ask. `collides` is for many postures: most pairs are far apart, balls around the capsules sort them
out, and the exact distance between two segments (Ericson 2005, "Real-Time Collision Detection", section 5.1.9) is
computed for the others only. `clearances` is for few: all distances, in compiled loops.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array
from rejoint.arms.inertia import LINK_RADIUS_RATIO
from rejoint.arms.inverse import solve_position
from rejoint.arms.kinematics import Frames, all_poses, frames
from rejoint.arms.workspace import reach
from rejoint.system.late import Late

compiled = Late("rejoint.arms.compiled")

GROUND = 0.0
"""[m] height of the plane that the arm stands on, in its base frame; an arm whose tool may go lower than that stands
on something, and its plane is the arm's floor"""


GRID = 3
"""Targets along each edge of their region that are taken for free (chosen: corners, middles of edges and of sides)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class CollisionShape:
    """Capsules of an arm: link 0 is its base, link i moves with joint i, and what of them can touch."""

    radius: float
    """[m] of all capsules"""
    half_length: Array
    """(n + 1,) [m] half of the length of each capsule's axis"""
    pairs: NDArray[np.intp]
    """(P, 2) links that can touch each other"""
    grounded: NDArray[np.bool_]
    """(n + 2,) which ends of capsules, from the base's lower one to the TCP, can touch the ground"""
    ground: float
    """[m] height of the plane under the arm"""

    @cached_property
    def places(self) -> NDArray[np.int64]:
        """(G,) indices of the ends that can touch the ground."""
        return np.flatnonzero(self.grounded).astype(np.int64)


@lru_cache(maxsize=32)
def collision_shape(arm: Arm) -> CollisionShape:
    """Derive the capsules of an arm and the pairs that count."""
    ends = _ends(frames(arm, _work(arm)))
    first = ends[0]
    radius, ground = LINK_RADIUS_RATIO * reach(arm), min(GROUND, arm.floor)
    links = arm.joints + 1
    apart = np.array([(i, j) for i in range(links) for j in range(i + 2, links)], dtype=np.intp).reshape(-1, 2)
    i, j = apart.T
    distance = segment_distance(ends[:, i], ends[:, i + 1], ends[:, j], ends[:, j + 1]).min(axis=0)
    return CollisionShape(
        radius=radius,
        half_length=np.linalg.norm(np.diff(first, axis=0), axis=-1) / 2,
        pairs=apart[distance > 2 * radius],
        grounded=first[:, 2] > ground + radius,
        ground=ground,
    )


def collides(arm: Arm, f: Frames) -> NDArray[np.bool_]:
    """Tell for postures with the frames ``f`` (...) whether a link touches another one or the ground."""
    shape, ends = collision_shape(arm), _ends(f)
    flat = ends.reshape(-1, *ends.shape[-2:])
    touched = np.any(flat[:, shape.grounded, 2] < shape.ground + shape.radius, axis=-1, keepdims=True)[:, 0]
    first, second = shape.pairs.T
    middle = 0.5 * (flat[:, :-1] + flat[:, 1:])
    apart = middle[:, first] - middle[:, second]
    near = shape.half_length[first] + shape.half_length[second] + 2 * shape.radius
    row, pair = np.nonzero(np.einsum("bpi,bpi->bp", apart, apart) < near**2)
    if len(row):
        a, b = first[pair], second[pair]
        distance = segment_distance(flat[row, a], flat[row, a + 1], flat[row, b], flat[row, b + 1])
        touched[row[distance < 2 * shape.radius]] = True
    return touched.reshape(ends.shape[:-2])


def clearances(arm: Arm, q: Array, floors: Array) -> Array:
    """Heights above ``floors`` (n,) [m], then distances between capsules, (..., n + P + G) [m] at ``q`` (..., n) [rad].

    The heights are those of all joint frames but the first, and of the TCP; the distances those of the shape's pairs of
    links and of its ends from the ground, below zero where they touch.
    """
    shape, poses = collision_shape(arm), all_poses(arm, q, slice(0, 3))
    clear = np.empty((*q.shape[:-1], arm.joints + len(shape.pairs) + len(shape.places)))
    rows = clear.reshape(poses.shape[-1], clear.shape[-1])
    compiled.fill_clearances(poses, floors, shape.pairs, shape.places, shape.radius, shape.ground, rows)
    return clear


def segment_distance(start: Array, end: Array, other_start: Array, other_end: Array) -> Array:
    """Smallest distance (...) [m] between segments given by their ends (..., 3) [m]; a segment may be a point.

    Exact to a micrometre for segments of up to a metre.
    """
    along, across, between = end - start, other_end - other_start, start - other_start
    a, e, b = _dot(along, along), _dot(across, across), _dot(along, across)
    c, f = _dot(along, between), _dot(across, between)
    s = np.clip(_ratio(b * f - c * e, a * e - b * b), 0.0, 1.0)
    t = np.clip(_ratio(b * s + f, e), 0.0, 1.0)
    s = np.clip(_ratio(b * t - c, a), 0.0, 1.0)
    gap = between + s[..., None] * along - t[..., None] * across
    return np.sqrt(_dot(gap, gap))


def _work(arm: Arm) -> Array:
    """Postures (m, n) [rad] that are taken for free: at rest, first, and at a grid of targets."""
    axes = [np.linspace(low, high, GRID) for low, high in zip(arm.targets.lower, arm.targets.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    solution = solve_position(arm, grid, arm.rest)
    return np.concatenate([arm.rest[None], solution.q[solution.converged]])


def _ends(f: Frames) -> Array:
    """Return the ends (..., n + 2, 3) [m] of the capsules, one after the other."""
    base = np.zeros((*f.tcp_position.shape[:-1], 1, 3))
    return np.concatenate([base, f.position, f.tcp_position[..., None, :]], axis=-2)


def _dot(x: Array, y: Array) -> Array:
    return np.einsum("...i,...i->...", x, y)


def _ratio(over: Array, under: Array) -> Array:
    """Quotient, or 0 where segments are points or parallel: any value is as good there."""
    usable = under > 1e-15
    return np.divide(over, under, out=np.zeros_like(over), where=usable)
