"""The frame of whatever measured, placed by what the encoders say: the first estimate of a fit."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.rotations import pose_of
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.system.errors import InputError

FEWEST = 4
"""Points with all coordinates that a pose needs (chosen: three that do not lie on a line, and one to spare)"""
_FLAT = 0.02  # [m] least extent of the points across their longest direction (chosen: ten times the error of a point)


def align(arm: Arm, measurements: Measurements) -> Array:
    """Pose (4, 4) of the measuring frame in the base that brings the points nearest to the encoders' (Kabsch 1976).

    InputError where the points leave it open.
    """
    whole = np.isfinite(measurements.point).all(axis=1)
    if whole.sum() < FEWEST:
        raise InputError(
            f"measurements in the frame {measurements.frame!r}: {int(whole.sum())} points with all three coordinates, "
            f"expected at least {FEWEST} to find out where that frame is; measure more, or in the frame of the base"
        )
    seen = measurements.point[whole]
    told = tcp_position(arm, measurements.position[whole])
    apart_seen, apart_told = seen - seen.mean(axis=0), told - told.mean(axis=0)
    left, size, right = np.linalg.svd(apart_seen.T @ apart_told)
    if np.sqrt(size[1] / len(seen)) < _FLAT / 2:
        raise InputError(
            f"measurements in the frame {measurements.frame!r}: all points lie on a line, which leaves its pose open; "
            "measure points that lie apart in two directions at least"
        )
    sign = np.sign(np.linalg.det(left @ right))
    rotation = (left @ np.diag([1.0, 1.0, sign]) @ right).T
    return pose_of(rotation, told.mean(axis=0) - rotation @ seen.mean(axis=0))
