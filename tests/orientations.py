"""Angles between a wanted orientation and a shown one, by SciPy, for the tests of several folders."""

import numpy as np
from scipy.spatial.transform import Rotation

from rejoint.arms.rotations import Orientation


def angles(turn: Orientation, rotation: np.ndarray) -> np.ndarray:
    """Return angles (...) [rad] from ``rotation`` (..., 3, 3) to the wanted one, or between the tool axes."""
    between = (turn.rotation @ np.swapaxes(rotation, -1, -2)).reshape(-1, 3, 3)
    whole = Rotation.from_matrix(between).magnitude().reshape(turn.weight.shape)
    one, other = rotation @ turn.axis, turn.rotation @ turn.axis
    axes = np.arctan2(np.linalg.norm(np.cross(one, other), axis=-1), (one * other).sum(axis=-1))
    return np.where(turn.whole, whole, axes)
