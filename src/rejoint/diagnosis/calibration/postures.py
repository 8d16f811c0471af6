"""Postures in which a measurement tells most."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, collides, frames, solve_position

_MARGIN = np.radians(10.0)


def suggest(arm: Arm, count: int, *, seed: int = 0) -> Array:
    """Suggest ``count`` postures (count, n) [rad]."""
    rng = np.random.default_rng(seed)
    found: list[Array] = []
    while len(found) < count:
        solution = solve_position(arm, arm.targets.sample(rng), arm.rest)
        inside = ((solution.q > arm.lower + _MARGIN) & (solution.q < arm.upper - _MARGIN)).all()
        if solution.converged and inside and not collides(arm, frames(arm, solution.q)).any():
            found.append(solution.q)
    return np.array(found)
