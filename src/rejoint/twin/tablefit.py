"""Fit of the table to motion in contact: least squares with a weak prior."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from rejoint.arms import Array
from rejoint.twin.fit import HUBER
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.replay import Replay
from rejoint.twin.table import TablePlane

# height [m], slopes, log stiffness [N/m], log friction
_SIGMA = np.array([0.02, 0.05, 0.05, 1.0, 0.7])
"""Prior sigma; chosen: level within 3 degrees, stiffness within a factor of e"""
_STEP = np.array([0.001, 0.01, 0.01, 0.2, 0.2])
"""Finite-difference steps (chosen)"""
_LOWER = np.array([-np.inf, -0.3, -0.3, np.log(100.0), np.log(0.05)])
_UPPER = np.array([np.inf, 0.3, 0.3, np.log(1e5), np.log(1.5)])

STIFFNESS, FRICTION = 1000.0, 0.3
"""Start of a fit [N/m], [1]; chosen: a hand-sized arm"""

NOISE, ROWS = np.radians(0.5), 50
"""[rad] error in contact, and rows of one observation; chosen"""


def fit_table(
    replay: Replay, parameters: TwinParameters, height: float, start: TablePlane | None = None, evaluations: int = 12
) -> TablePlane:
    """Fit the table, from ``start`` or level at ``height`` [m]."""
    measured, weight = np.concatenate(replay.measured()), 1.0 / (NOISE * ROWS**0.5)
    mean = np.array([height, 0.0, 0.0, np.log(STIFFNESS), np.log(FRICTION)])

    def misfit(vectors: Array) -> Array:
        paths = replay.predict(parameters.repeat(len(vectors)), [_table(v) for v in vectors])
        return weight * (np.concatenate(paths, axis=1) - measured).reshape(len(vectors), -1)

    def residual(x: Array) -> Array:
        return np.append(misfit(x[None])[0], (x - mean) / _SIGMA)

    def jacobian(x: Array) -> Array:
        steps = np.where(x + _STEP > _UPPER, -_STEP, _STEP)
        base, *moved = misfit(np.vstack([x, x + np.diag(steps)]))
        return np.vstack([((np.array(moved) - base) / steps[:, None]).T, np.diag(1.0 / _SIGMA)])

    def loss(z: Array) -> Array:
        """Pseudo-Huber with derivatives, square for the prior."""
        motion = np.arange(len(z)) < len(z) - len(mean)
        root = np.sqrt(1.0 + z)
        return np.where(motion, [2.0 * (root - 1.0), 1.0 / root, -0.5 / root**3], [z, np.ones_like(z), 0.0 * z])

    first = mean if start is None else _vector(start)
    found = least_squares(
        residual,
        np.clip(first, _LOWER + 1e-9, _UPPER - 1e-9),
        jacobian,
        bounds=(_LOWER, _UPPER),
        x_scale=_SIGMA,
        loss=loss,
        f_scale=weight * HUBER,
        max_nfev=evaluations,
        ftol=1e-3,
        xtol=1e-3,
    )
    return _table(found.x)


def _vector(table: TablePlane) -> Array:
    return np.array([table.height, table.slope_x, table.slope_y, np.log(table.stiffness), np.log(table.friction)])


def _table(vector: Array) -> TablePlane:
    height, slope_x, slope_y = (float(value) for value in vector[:3])
    stiffness, friction = (float(value) for value in np.exp(vector[3:]))
    return TablePlane(height=height, slope_x=slope_x, slope_y=slope_y, stiffness=stiffness, friction=friction)
