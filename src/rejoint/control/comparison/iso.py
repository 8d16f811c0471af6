"""Accuracy in the words of data sheets: ISO 9283 for poses of the tool, ISO 230-2 for approaches from two sides.

By the encoders it is what the controller does; only with an outside measurement is it what the norm means. Written from
textbook definitions of ISO 9283:1998 and ISO 230-2:2014. ISO 9283 asks for 30 cycles: fewer are to be said beside.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array

INSET = 0.1
"""Distance of P2 to P5 from the corners of the region, as a share of its diagonal (ISO 9283)"""
RISING_AHEAD = np.array([[0, 0, 0], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1]], dtype=float)
"""P1 to P5 in the diagonal plane of the region that is higher where it is farther from the base: in half diagonals"""
RISING_LEFT = np.array([[0, 0, 0], [1, 1, 1], [-1, 1, 1], [-1, -1, -1], [1, -1, -1]], dtype=float)
"""The same in the plane that is higher on the arm's left"""


def iso_poses(arm: Arm, plane: Array, size: float = 1.0) -> Array:
    """Points P1 to P5 (5, 3) [m] of ISO 9283 in a ``plane`` of the region of targets, made smaller by ``size``."""
    low, high = arm.targets.lower, arm.targets.upper
    return np.asarray(0.5 * (low + high) + 0.5 * size * (1.0 - 2.0 * INSET) * (high - low) * plane)


def position_accuracy(places: Array, target: Array) -> Array:
    """AP (...) [m]: how far the mean of the attained ``places`` (..., R, 3) of R cycles is from ``target`` (..., 3)."""
    return np.asarray(np.linalg.norm(places.mean(axis=-2) - target, axis=-1))


def position_repeatability(places: Array) -> Array:
    """RP (...) [m]: mean distance of ``places`` (..., R, 3) from their mean, and three standard deviations of it.

    NaN for fewer than two cycles.
    """
    if places.shape[-2] < 2:
        return np.full(places.shape[:-2], np.nan)
    distance = np.linalg.norm(places - places.mean(axis=-2, keepdims=True), axis=-1)
    return np.asarray(distance.mean(axis=-1) + 3.0 * distance.std(axis=-1, ddof=1))


def direction_variation(means: Array) -> float:
    """Compute vAP [m]: largest distance between the ``means`` (D, 3) of places attained from D directions."""
    apart = np.linalg.norm(means[:, None] - means[None], axis=-1)
    return float(apart.max())


def reversal(forwards: Array, backwards: Array) -> Array:
    """B (...) [m]: mean of R places (..., R, 3) come to forwards less that of places come to backwards, its length."""
    return np.asarray(np.linalg.norm(forwards.mean(axis=-2) - backwards.mean(axis=-2), axis=-1))
