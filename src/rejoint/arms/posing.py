"""Inverse kinematics of poses."""

from __future__ import annotations

import numpy as np

from rejoint.arms.arm import Arm, Array
from rejoint.arms.collision import collides
from rejoint.arms.inverse import DAMPING, MOST_STEP, REST_GAIN, TOLERANCE, clip_norm, dls, solve_position
from rejoint.arms.kinematics import frames
from rejoint.arms.postures import choose_postures
from rejoint.arms.rotations import Orientation, task

NEAR, TURNED = 1e-3, float(np.radians(0.5))
"""[m], [rad] largest misses of a reachable pose (chosen)"""
_ROUNDS = 100
"""(chosen)"""


def solve_pose(arm: Arm, target: Array, start: Array, turn: Orientation, *, rest_gain: float = REST_GAIN) -> Array:
    """Search joint positions (..., n) [rad] for places (..., 3) [m] and a ``turn`` (...), from ``start`` (..., n).

    Ends at the pose, or at the least weighted sum of squares nearby, within the limits.
    """
    shape = np.broadcast_shapes(target.shape[:-1], start.shape[:-1])
    q = np.clip(np.broadcast_to(start, (*shape, arm.joints)), arm.lower, arm.upper)
    for _ in range(_ROUNDS):
        missed, jacobian = task(arm, q, target, turn)
        done = np.abs(missed).max(axis=-1) < TOLERANCE
        if done.all():
            break
        damping = np.minimum(DAMPING, np.linalg.norm(missed, axis=-1) + 1e-4)
        pull = rest_gain * (arm.rest - q)
        drift = (jacobian @ pull[..., None])[..., 0]
        step = dls(jacobian, missed, damping) + pull - dls(jacobian, drift, 1e-4)
        step = np.where(done[..., None], 0.0, clip_norm(step, MOST_STEP))
        q = np.clip(q + step, arm.lower, arm.upper)
    return q


def find_postures(
    arm: Arm, target: Array, start: Array, turn: Orientation | None, *, rest_gain: float = REST_GAIN
) -> Array:
    """Postures (B, n) [rad] of poses, found from ``start`` (B, n); ``target`` (B, 3) [m].

    `choose_postures` helps where that ends off the pose or in a contact. A ``rest_gain`` of 0 keeps postures near
    ``start``; else they drift to rest.
    """
    if turn is None:
        return solve_position(arm, target, start, rest_gain=rest_gain).q
    found = solve_pose(arm, target, start, turn, rest_gain=rest_gain)
    off, angle = missed_pose(arm, found, target, turn)
    for b in np.flatnonzero((off >= NEAR) | (angle > TURNED) | collides(arm, frames(arm, found))):
        goals = choose_postures(arm, target[b : b + 1], start[b], turn=turn[np.array([b])])
        found[b] = found[b] if goals.refusals[0] else goals.q[0]
    return found


def missed_pose(arm: Arm, posture: Array, target: Array, turn: Orientation) -> tuple[Array, Array]:
    """Errors (...) [m] and (...) [rad] of postures (..., n) from their poses; NaN: any angle."""
    f = frames(arm, posture)
    return np.linalg.norm(target - f.tcp_position, axis=-1), turn.angle(f.tcp_rotation)
