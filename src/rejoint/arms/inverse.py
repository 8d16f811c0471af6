"""Damped least squares (Park et al. 2024, equation 11) and inverse kinematics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array
from rejoint.arms.kinematics import frames, position_kinematics
from rejoint.arms.rotations import rotation_error

DAMPING = 0.05
"""[m] lambda (Park et al. 2024, section III-C)"""
TOLERANCE, ROUNDS = 1e-5, 200
"""[m] and most steps (chosen)"""
MOST_STEP, REST_GAIN = float(np.radians(10.0)), 0.05
"""[rad] per joint and step; pull to rest per step (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Result of an inverse-kinematics search."""

    q: Array
    """(..., n) [rad] within the joint limits"""
    error: Array
    """(...) [m] TCP"""
    converged: NDArray[np.bool_]
    """(...) error, and wanted orientation, within tolerance"""


def dls(jacobian: Array, error: Array, damping: float | Array = DAMPING) -> Array:
    """Damped least-squares step J'(JJ' + lambda^2 I)^-1 e, (..., n) [rad].

    ``jacobian`` (..., k, n), ``error`` (..., k), ``damping`` a number or (...). This k x k form equals the paper's n x
    n form.
    """
    transpose = np.swapaxes(jacobian, -1, -2)
    ridge = np.asarray(damping)[..., None, None] ** 2 * np.eye(jacobian.shape[-2])
    gram = jacobian @ transpose + ridge
    return (transpose @ np.linalg.solve(gram, error[..., None]))[..., 0]


def clip_norm(step: Array, limit: float | Array) -> Array:
    """Scale vectors (..., n) down to elements of ``limit`` at most, a number or (..., 1)."""
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
    """Search joint positions of the TCP at ``target`` (..., 3) [m], from ``start`` (..., n) [rad].

    ``rotation`` (..., 3, 3): wanted orientation; without it, the null space pulls to rest. ``tolerance`` [m], [rad].
    The damping shrinks with the error (quadratic convergence).
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
