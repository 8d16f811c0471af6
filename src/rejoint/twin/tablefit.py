"""Fit of the table under an arm to motion in contact, the arm's own parameters being known.

Method: Gauss-Newton with Levenberg-Marquardt damping on the loss of `rejoint.twin.fit`, several damping
values in one batch, with a weak prior that keeps what few contacts do not show.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rejoint.arms import Array
from rejoint.twin.fit import DAMPINGS, influence, loss
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.replay import Replay
from rejoint.twin.table import TablePlane

# height [m], slopes, log stiffness [N/m], log friction
_SIGMA = np.array([0.02, 0.05, 0.05, 1.0, 0.7])
"""Prior standard deviations (chosen): a table is level within 3 degrees, soft or hard within a factor of e"""
_STEP = np.array([0.001, 0.01, 0.01, 0.2, 0.2])
"""Finite-difference steps (chosen)"""
_LOWER = np.array([-np.inf, -0.3, -0.3, np.log(100.0), np.log(0.05)])
_UPPER = np.array([np.inf, 0.3, 0.3, np.log(1e5), np.log(1.5)])

STIFFNESS, FRICTION = 1000.0, 0.3
"""Where a fit starts [N/m]: a hand-sized arm gives about as much itself (chosen)"""

NOISE = np.radians(0.5)
"""[rad] of a prediction in contact, for the weight of the prior (chosen; `ROWS` of them count as one)"""
ROWS = 50
"""Rows that say as much as one independent one: a second (chosen)"""


def fit_table(
    replay: Replay, parameters: TwinParameters, height: float, start: TablePlane | None = None, iterations: int = 6
) -> TablePlane:
    """Fit the table to the windows of a replay made ``on_table``; before any data it is level, at ``height`` [m].

    The descent begins at ``start``, else there.
    """
    measured = np.concatenate(replay.measured())

    def residuals(vectors: Array) -> Array:
        tables = [_table(v) for v in vectors]
        return np.concatenate(replay.predict(parameters.repeat(len(vectors)), tables), axis=1) - measured

    belief = np.array([height, 0.0, 0.0, np.log(STIFFNESS), np.log(FRICTION)])
    return _table(_descend(residuals, belief, belief if start is None else _vector(start), iterations))


def _descend(residuals: Callable[[Array], Array], belief: Array, start: Array, iterations: int) -> Array:
    x, weight = start, 1.0 / (NOISE**2 * ROWS)

    def costs(vectors: Array, found: Array) -> Array:
        pull = 0.5 * (((vectors - belief) / _SIGMA) ** 2).sum(axis=1)
        return np.asarray(weight * loss(found).sum(axis=(1, 2)) + pull)

    for _ in range(iterations):
        signs = np.where(x + _STEP > _UPPER, -1.0, 1.0)
        found = residuals(np.vstack([x, x + np.diag(signs * _STEP)]))
        base = found[0].ravel()
        jacobian = ((found[1:] - found[0]).reshape(len(x), -1) / (signs * _STEP)[:, None]).T
        scaled = jacobian * (weight * influence(base))[:, None]
        curvature = jacobian.T @ scaled + np.diag(_SIGMA**-2)
        gradient = scaled.T @ base + (x - belief) / _SIGMA**2
        steps = [np.linalg.solve(curvature + d * np.diag(np.diag(curvature)), gradient) for d in DAMPINGS]
        trials = np.clip(x - np.clip(steps, -_SIGMA, _SIGMA), _LOWER, _UPPER)
        cost = np.append(costs(trials, residuals(trials)), costs(x[None], found[:1]))
        best = int(np.argmin(cost))
        if best == len(trials) or cost[-1] - cost[best] < 0.5:  # half of one sigma^2, as in `rejoint.twin.fit`
            return x if best == len(trials) else trials[best]
        x = trials[best]
    return x


def _vector(table: TablePlane) -> Array:
    return np.array(
        [table.height, table.slope_x, table.slope_y, np.log(table.stiffness), np.log(max(table.friction, 1e-3))]
    )


def _table(vector: Array) -> TablePlane:
    height, slope_x, slope_y = (float(value) for value in vector[:3])
    stiffness, friction = (float(value) for value in np.exp(vector[3:]))
    return TablePlane(height=height, slope_x=slope_x, slope_y=slope_y, stiffness=stiffness, friction=friction)
