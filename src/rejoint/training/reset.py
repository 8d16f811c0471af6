"""Initial states of new arms in training."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, gravity_torque, tcp_position
from rejoint.control.guard import GuardLimits
from rejoint.training.ranges import Ranges
from rejoint.twin.simulation import Draw


class ResetStates(NamedTuple):
    """m arms at the start of their first episode."""

    draw: Draw
    position: Array
    """(m, n) [rad]"""
    command: Array
    """(m, n) [rad]"""

    def rows(self, index: NDArray[np.integer]) -> ResetStates:
        """Return some rows."""
        return ResetStates(self.draw.rows(index), self.position[index], self.command[index])


def draw_reset_states(
    ranges: Ranges, limits: GuardLimits, rng: np.random.Generator, count: int, *, spread: float, lead_limit: float
) -> ResetStates:
    """Draw ``count`` arms around rest with sigma ``spread`` [rad].

    The first command leads by part of the sag, at most ``lead_limit`` [rad].
    """
    draw = ranges.draw(rng, count)
    position = _start_postures(limits, rng, count, spread)
    return ResetStates(draw, position, position + _start_lead(limits.arm, rng, draw, position, lead_limit))


def _start_postures(limits: GuardLimits, rng: np.random.Generator, count: int, spread: float) -> Array:
    """Postures (m, n) [rad] inside the guard's limits and above the floor."""
    arm = limits.arm
    position = arm.rest + rng.normal(0.0, spread, (count, arm.joints))
    position = np.clip(position, limits.lower, limits.upper)
    low = tcp_position(arm, position)[:, 2] < 3.0 * arm.floor
    return np.where(low[:, None], arm.rest, position)


def _start_lead(arm: Arm, rng: np.random.Generator, draw: Draw, position: Array, limit: float) -> Array:
    """Lead (m, n) [rad] of the first command: none up to the whole sag."""
    if limit == 0.0:
        return np.zeros_like(position)
    torque = draw.gravity_scale[:, None] * gravity_torque(arm, position)
    held = torque / draw.twin.stiffness - draw.twin.offset
    return np.clip(held, -limit, limit) * rng.uniform(0.0, 1.0, (len(position), 1))
