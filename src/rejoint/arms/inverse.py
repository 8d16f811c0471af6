"""Damped least squares (equation 11 of Park et al. 2024) and the inverse kinematics built on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array
from rejoint.arms.kinematics import frames, position_kinematics
from rejoint.arms.rotations import rotation_error

DAMPING = 0.05
"""Damping factor lambda [m] of the paper (its section III-C), with positions in metres."""
TOLERANCE, ROUNDS = 1e-5, 200
"""[m] within which a place counts as found, and the most steps towards it (chosen)"""
MOST_STEP, REST_GAIN = float(np.radians(10.0)), 0.05
"""[rad] of a joint in a step, and the pull to the rest posture in one (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Result of an inverse-kinematics search."""

    q: Array
    """(..., n) [rad] within the joint limits"""
    error: Array
    """(...) [m] remaining distance of the TCP"""
    converged: NDArray[np.bool_]
    """(...) whether the error (and the orientation, if asked for) is within tolerance"""


def dls(jacobian: Array, error: Array, damping: float | Array = DAMPING) -> Array:
    """Damped least-squares step J'(JJ' + lambda^2 I)^-1 e.

    ``jacobian`` is (..., k, n), ``error`` (..., k), ``damping`` a number or (...); returns (..., n)
    [rad]. The form with the k x k matrix equals the paper's n x n form and is smaller.
    """
    transpose = np.swapaxes(jacobian, -1, -2)
    ridge = np.asarray(damping)[..., None, None] ** 2 * np.eye(jacobian.shape[-2])
    gram = jacobian @ transpose + ridge
    return (transpose @ np.linalg.solve(gram, error[..., None]))[..., 0]


def clip_norm(step: Array, limit: float | Array) -> Array:
    """Scale whole vectors (..., n) down so that no element exceeds ``limit``, a number or (..., 1), in size."""
    largest = np.maximum.reduce(np.abs(step), axis=-1, keepdims=True)
    return step * np.minimum(1.0, limit / np.maximum(largest, 1e-12))


def solve_position(
    arm: Arm,
    target: Array,
    start: Array,
    *,
    rotation: Array | None = None,
    tolerance: float = TOLERANCE,
    iterations: int = ROUNDS,
    rest_gain: float = REST_GAIN,
) -> Solution:
    """Find joint positions whose TCP is at ``target`` (..., 3) [m], searching from ``start`` (..., n).

    With ``rotation`` (..., 3, 3) the full pose is asked for, otherwise only the position, and the
    null space pulls weakly to the rest posture. Joint limits are kept at every iterate.
    ``tolerance`` is in metres (and in radians for the orientation). The damping shrinks with the
    error, so that the last iterations converge quadratically.
    """
    shape = np.broadcast_shapes(target.shape[:-1], start.shape[:-1])
    q = np.clip(np.broadcast_to(start, (*shape, arm.joints)), arm.lower, arm.upper)
    for iteration in range(iterations + 1):
        tcp, j = position_kinematics(arm, q)
        e = target - tcp
        if rotation is not None:
            f = frames(arm, q)
            turn = rotation_error(f.tcp_rotation, rotation)
            j, e = np.concatenate([j, np.swapaxes(f.axis, -1, -2)], axis=-2), np.concatenate([e, turn], axis=-1)
        converged = np.abs(e).max(axis=-1) < tolerance
        if converged.all() or iteration == iterations:
            break
        damping = np.minimum(DAMPING, np.sqrt((e**2).sum(axis=-1)) + 1e-4)
        if rotation is None:
            pull = rest_gain * (arm.rest - q)
            drift = (j @ pull[..., None])[..., 0]
            towards, back = dls(j, np.stack([e, drift]), np.stack([damping, np.full_like(damping, 1e-6)]))
            step = towards + pull - back
        else:
            step = dls(j, e, damping)
        step = np.where(converged[..., None], 0.0, clip_norm(step, MOST_STEP))
        q = np.minimum(np.maximum(q + step, arm.lower), arm.upper)
    return Solution(q=q, error=np.linalg.norm(e[..., :3], axis=-1), converged=converged)
