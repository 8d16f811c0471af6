"""Damped least squares (Park et al. 2024, equation 11) and inverse kinematics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array
from rejoint.arms.kinematics import chain_of, tcp_position
from rejoint.arms.rotations import Orientation
from rejoint.system.shell import Late

compiled = Late("rejoint.arms.compiled")

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


def goals_of(places: Array, turn: Orientation | None) -> Array:
    """Goals (..., 17), see `rejoint.arms.compiled`, of ``places`` (..., 3) [m] and orientations (...)."""
    goals = np.zeros((*places.shape[:-1], 17))
    goals[..., :3] = places
    if turn is not None:
        goals[..., 3:12] = turn.rotation.reshape(*turn.rotation.shape[:-2], 9)
        goals[..., 12:15], goals[..., 15] = turn.axis, turn.weight
        goals[..., 16] = turn.counts * np.where(turn.whole, 2.0, 1.0)
    return goals


def solve_position(
    arm: Arm,
    target: Array,
    start: Array,
    *,
    turn: Orientation | None = None,
    tolerance: float = TOLERANCE,
    iterations: int = ROUNDS,
    rest_gain: float = REST_GAIN,
) -> Solution:
    """Search joint positions of the TCP at ``target`` (..., 3) [m], from ``start`` (..., n) [rad].

    ``turn`` (...): wanted orientation. The null space pulls to rest. ``tolerance`` [m], weighted radians. Without a
    solution the search ends at the least weighted sum of squares nearby, within the limits.
    """
    shape = np.broadcast_shapes(target.shape[:-1], start.shape[:-1])
    q = np.array(np.broadcast_to(start, (*shape, arm.joints)), dtype=float, order="C").reshape(-1, arm.joints)
    goals, missed = goals_of(np.broadcast_to(target, (*shape, 3)), turn).reshape(-1, 17), np.empty(len(q))
    compiled.solve_all(chain_of(arm), goals, q, rest_gain, iterations, tolerance, missed)
    q = q.reshape(*shape, arm.joints)
    error = np.linalg.norm(target - tcp_position(arm, q), axis=-1)
    return Solution(q=q, error=error, converged=(missed < tolerance).reshape(shape) & np.isfinite(error))
