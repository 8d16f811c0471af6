"""Constants of a myCobot's computer; SI units and radians."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array

FULL_SPEED = float(np.radians(120.0))
"""[rad/s] of the fastest joint at 100 % (chosen: 80 % of the vendor's)"""
ACCELERATION = float(np.radians(200.0))
"""[rad/s^2] (vendor's communication protocol page)"""

NO_SOLUTION = 32
NO_LINE = 33
COLLISION = 16
"""Error codes of the vendor's ``get_error_information``; 1..6: joint over its limit; 16: any contact"""

HAS_ARRIVED_ANGLE = float(np.radians(1.0))
HAS_ARRIVED_LENGTH = 0.003
"""[rad], [m] (chosen)"""


def at_angles(here: Array, angles: Array) -> bool:
    """Whether ``here`` (n,) [rad] is within a degree of ``angles``."""
    return bool((np.abs(here - angles) < HAS_ARRIVED_ANGLE).all())


def at_place(here: Array, pose: Array) -> bool:
    """Whether pose ``here`` (4, 4) is within 3 mm and a degree of ``pose``."""
    cosine = (np.trace(pose[:3, :3] @ here[:3, :3].T) - 1.0) / 2.0
    near = np.linalg.norm(pose[:3, 3] - here[:3, 3]) < HAS_ARRIVED_LENGTH
    return bool(near and cosine > np.cos(HAS_ARRIVED_ANGLE))
