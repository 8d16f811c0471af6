"""Measurements of the real tool at rest.

Rows of one ``posture`` approach it from different sides, which shows play.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.rotations import pose_of
from rejoint.system.errors import InputError

Numbers = NDArray[np.int64]

NOISE = 0.5e-3
"""[m] default sigma of a coordinate; chosen: a ruler read with care"""


ROWS = ("position", "approach", "point", "sigma", "posture")
"""Fields of `Measurements` with a row each"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurements:
    """M measurements of one arm of n joints."""

    position: Array
    """(M, n) [rad] by encoders"""
    approach: Array
    """(M, n) [rad] before the last motion; NaN where unknown"""
    point: Array
    """(M, 3) [m] tool in ``frame``; NaN where not measured"""
    sigma: Array
    """(M,) [m] sigma of each coordinate"""
    posture: Numbers
    """(M,) rows of one number visit one posture"""
    frame: str = "base"
    """``base``, or the name of a frame to fit"""
    source: str = "touch"
    """``touch``, ``camera`` or ``tracker``"""

    def __post_init__(self) -> None:
        for name in ROWS:
            kind = np.int64 if name == "posture" else np.float64
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=kind))
        rows, joints = self.position.shape
        shapes = {"approach": (rows, joints), "point": (rows, 3), "sigma": (rows,), "posture": (rows,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"measurements: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if np.isinf(self.point).any() or not (np.isfinite(self.point).any(axis=1)).all():
            raise InputError("measurements: every row needs at least one coordinate of the tool, in metres")
        if not np.isfinite(self.position).all() or not (self.sigma > 0.0).all():
            raise InputError("measurements: joint positions must be finite and standard deviations positive")

    def __len__(self) -> int:
        return len(self.sigma)

    def joined(self, more: Measurements) -> Measurements:
        """Add rows."""
        both = {name: np.concatenate([getattr(self, name), getattr(more, name)]) for name in ROWS}
        return replace(self, **both)

    def rows(self, where: NDArray[np.bool_] | NDArray[np.intp]) -> Measurements:
        """Return some rows."""
        return replace(self, **{name: getattr(self, name)[where] for name in ROWS})


@dataclass(frozen=True, kw_only=True)
class MeasuringSession:
    """Progress of an interrupted measuring session."""

    plan: str
    """`rejoint.diagnosis.calibration.postures.Suggestion.digest`"""
    answered: int
    """postures measured or left out"""
    fresh: bool = False
    """ignore earlier calibrations"""


FEWEST = 4
"""Complete points that a pose needs; chosen"""
_FLAT = 0.02  # [m] least extent of the points across their longest direction (chosen: ten times the error of a point)


def align(arm: Arm, measurements: Measurements) -> Array:
    """Pose (4, 4) of the measuring frame nearest to the encoders (Kabsch 1976); InputError if undetermined."""
    whole = np.isfinite(measurements.point).all(axis=1)
    if whole.sum() < FEWEST:
        raise InputError(
            f"measurements in the frame {measurements.frame!r}: {int(whole.sum())} points with all three coordinates, "
            f"expected at least {FEWEST} to find out where that frame is; measure more, or in the frame of the base"
        )
    seen = measurements.point[whole]
    told = tcp_position(arm, measurements.position[whole])
    apart_seen, apart_told = seen - seen.mean(axis=0), told - told.mean(axis=0)
    if np.sqrt(np.linalg.svd(apart_seen.T @ apart_told)[1][1] / len(seen)) < _FLAT / 2:
        raise InputError(
            f"measurements in the frame {measurements.frame!r}: all points lie on a line, which leaves its pose open; "
            "measure points that lie apart in two directions at least"
        )
    rotation = Rotation.align_vectors(apart_told, apart_seen)[0].as_matrix()
    return pose_of(rotation, told.mean(axis=0) - rotation @ seen.mean(axis=0))
