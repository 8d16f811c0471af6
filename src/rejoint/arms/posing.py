"""Inverse kinematics of poses: postures that bring a tool to a place and turn it as wanted."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rejoint.arms.arm import Arm, Array
from rejoint.arms.collision import collides
from rejoint.arms.inverse import DAMPING, MOST_STEP, REST_GAIN, TOLERANCE, clip_norm, dls, solve_position
from rejoint.arms.kinematics import frames
from rejoint.arms.orientation import Orientation, task

NEAR, TURNED = 1e-3, float(np.radians(0.5))
"""[m], [rad] a pose that the inverse kinematics misses by more is out of reach (chosen)"""
_STARTS = 48
"""Random postures from which a pose is searched where that from nearby fails (measured: of 200 poses that a myCobot 280
shows, 24 find 199 and 48 all)"""
_ROUNDS = 100
"""Most steps towards a pose (chosen)"""


def solve_pose(arm: Arm, target: Array, start: Array, turn: Orientation) -> Array:
    """Search joint positions (..., n) [rad] for a place (..., 3) [m] and a ``turn`` (...), from ``start`` (..., n).

    Ends where place and orientation are right, or at the least weighted sum of squares nearby. Limits are kept.
    """
    shape = np.broadcast_shapes(target.shape[:-1], start.shape[:-1])
    q = np.clip(np.broadcast_to(start, (*shape, arm.joints)), arm.lower, arm.upper)
    for _ in range(_ROUNDS):
        missed, jacobian = task(arm, q, target, turn)
        done = np.abs(missed).max(axis=-1) < TOLERANCE
        if done.all():
            break
        damping = np.minimum(DAMPING, np.linalg.norm(missed, axis=-1) + 1e-4)
        pull = REST_GAIN * (arm.rest - q)
        drift = (jacobian @ pull[..., None])[..., 0]
        step = dls(jacobian, missed, damping) + pull - dls(jacobian, drift, 1e-4)
        step = np.where(done[..., None], 0.0, clip_norm(step, MOST_STEP))
        q = np.clip(q + step, arm.lower, arm.upper)
    return q


def find_postures(arm: Arm, target: Array, start: Array, turn: Orientation | None) -> Array:
    """Return the postures (B, n) [rad] of poses, nearest to ``start`` (B, n) among those that are found.

    ``target`` is (B, 3) [m]; without a ``turn`` these are the postures of `solve_position`. Postures in which the arm
    touches itself or the ground are taken only where there is no other. Out of reach, the best posture found is taken.
    """
    if turn is None:
        return solve_position(arm, target, start).q
    found = solve_pose(arm, target, start, turn)
    for b in np.flatnonzero(_badness(arm, found, target, turn) > 0.0):
        one = turn[np.full(_STARTS + 1, b)]
        tried = solve_pose(arm, np.tile(target[b], (_STARTS + 1, 1)), _starts(arm), one)
        tried = np.concatenate([found[b][None], tried])
        bad = _badness(arm, tried, target[b], turn[np.full(_STARTS + 2, b)])
        far = np.abs(tried - start[b]).max(axis=-1)
        found[b] = tried[np.lexsort((far, bad))[0]]
    return found


def missed_pose(arm: Arm, posture: Array, target: Array, turn: Orientation) -> tuple[Array, Array]:
    """Return how far (...) [m], and by which angle (...) [rad], postures (..., n) miss their poses; NaN: any angle."""
    f = frames(arm, posture)
    return np.linalg.norm(target - f.tcp_position, axis=-1), turn.angle(f.tcp_rotation)


def _badness(arm: Arm, posture: Array, target: Array, turn: Orientation) -> Array:
    """Return 0 (...) for a posture that will do; 1 where the arm touches something, more where the pose is missed."""
    off, angle = missed_pose(arm, posture, target, turn)
    missed = off + turn.weight * np.nan_to_num(angle)
    reached = (off < NEAR) & ~(angle > TURNED)
    return np.where(reached, collides(arm, frames(arm, posture)).astype(float), 2.0 + missed)


@lru_cache(maxsize=32)
def _starts(arm: Arm) -> Array:
    """Postures (S + 1, n) [rad] from which poses are searched: rest, and random ones."""
    drawn = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_STARTS, arm.joints))
    return np.concatenate([arm.rest[None], drawn])
