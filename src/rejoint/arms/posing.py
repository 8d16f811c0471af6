"""Inverse kinematics of poses: postures that bring a tool to a place and turn it as wanted."""

from __future__ import annotations

import numpy as np

from rejoint.arms.arm import Arm, Array
from rejoint.arms.collision import collides
from rejoint.arms.inverse import DAMPING, MOST_STEP, REST_GAIN, TOLERANCE, clip_norm, dls, solve_position
from rejoint.arms.kinematics import frames
from rejoint.arms.postures import choose_postures
from rejoint.arms.rotations import Orientation, task

NEAR, TURNED = 1e-3, float(np.radians(0.5))
"""[m], [rad] a pose that the inverse kinematics misses by more is out of reach (chosen)"""
_ROUNDS = 100
"""Most steps towards a pose (chosen)"""


def solve_pose(arm: Arm, target: Array, start: Array, turn: Orientation, *, rest_gain: float = REST_GAIN) -> Array:
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
        pull = rest_gain * (arm.rest - q)
        drift = (jacobian @ pull[..., None])[..., 0]
        step = dls(jacobian, missed, damping) + pull - dls(jacobian, drift, 1e-4)
        step = np.where(done[..., None], 0.0, clip_norm(step, MOST_STEP))
        q = np.clip(q + step, arm.lower, arm.upper)
    return q


def find_postures(
    arm: Arm, target: Array, start: Array, turn: Orientation | None, *, rest_gain: float = REST_GAIN
) -> Array:
    """Return the postures (B, n) [rad] of poses, found from ``start`` (B, n).

    ``target`` is (B, 3) [m]; without a ``turn`` these are the postures of `solve_position`. Where the way from there
    ends off the pose, or in a touch, `choose_postures` looks elsewhere; out of reach, the best posture nearby is taken.
    With a ``rest_gain`` of 0 the postures stay near ``start``, else they drift to rest.
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
    """Return how far (...) [m], and by which angle (...) [rad], postures (..., n) miss their poses; NaN: any angle."""
    f = frames(arm, posture)
    return np.linalg.norm(target - f.tcp_position, axis=-1), turn.angle(f.tcp_rotation)
