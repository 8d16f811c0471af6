"""Rewards, from distances in m, speeds in m/s and rad/s, angles in rad."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array


def residual_reward(distance: Array, speed: Array, action: Array) -> Array:
    """Reward (N,) that rises with accuracy down to a tenth of a millimetre.

    Three exponentials give a slope at every ``distance`` (N,) [m]; the TCP's ``speed`` (N,) costs only near the target,
    the ``action`` (N, n) everywhere. Chosen by simulation.
    """
    attraction = 0.4 * np.exp(-distance / 0.010) + 0.5 * np.exp(-distance / 0.003) + 0.4 * np.exp(-distance / 0.001)
    haste = 0.2 * np.minimum(speed, 1.0) * np.exp(-distance / 0.020)
    effort = 0.02 * np.minimum(action**2, 2.0).sum(axis=-1)
    return -10.0 * np.minimum(distance, 0.1) + attraction - haste - effort


def paper_reward(
    distance: Array,
    joint_speed: Array,
    collided: NDArray[np.bool_],
    reached: NDArray[np.bool_],
    timed_out: NDArray[np.bool_],
) -> Array:
    """Equation 25 of Park et al. 2024 for ``distance`` (N,) [m] and ``joint_speed`` (N, n) [rad/s].

    Weights .1, .1, -5, 10, 10. Our choice: centimetres, the mean joint speed; the time-out is a penalty, as the text
    says.
    """
    travel = -0.1 * 100.0 * distance - 0.1 * np.abs(joint_speed).mean(axis=-1)
    return travel - 5.0 * timed_out - 10.0 * collided + 10.0 * reached
