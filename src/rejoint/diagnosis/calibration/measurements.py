"""Measurements of where the tool really is, whoever made them.

One row is one measurement: what the encoders said while the arm stood still, and where the tool was seen, in the frame
of whatever measured it. A coordinate that was not measured is NaN: a height gauge tells z alone. Rows of the same
``posture`` are visits of one posture from different sides, so that play shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.system.errors import InputError

Numbers = NDArray[np.int64]

NOISE = 0.5e-3
"""[m] standard deviation of a coordinate where it is not told (chosen: a ruler read with care)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurements:
    """M measurements of one arm of n joints."""

    position: Array
    """(M, n) [rad] what the encoders said"""
    approach: Array
    """(M, n) [rad] where the encoders came from last: readings of the posture before, or NaN where it is not known"""
    point: Array
    """(M, 3) [m] where the tool was seen, in the frame of ``frame``; NaN where a coordinate was not measured"""
    sigma: Array
    """(M,) [m] standard deviation of each coordinate, as far as it is known"""
    posture: Numbers
    """(M,) number of the posture: rows of the same number are visits of the same one"""
    frame: str = "base"
    """``base``: points are in the frame of the arm's base; any other name: in one whose pose is fitted along"""
    source: str = "touch"
    """``touch``, ``camera`` or ``tracker``"""

    def __post_init__(self) -> None:
        numbers = np.array(self.posture, dtype=np.int64)
        numbers.setflags(write=False)
        object.__setattr__(self, "posture", numbers)
        for name in ("position", "approach", "point", "sigma"):
            value = np.array(getattr(self, name), dtype=float)
            value.setflags(write=False)
            object.__setattr__(self, name, value)
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
        """Count the measurements."""
        return len(self.sigma)

    def rows(self, where: NDArray[np.bool_] | NDArray[np.intp]) -> Measurements:
        """Return some of them."""
        return Measurements(
            position=self.position[where], approach=self.approach[where], point=self.point[where],
            sigma=self.sigma[where], posture=self.posture[where], frame=self.frame, source=self.source,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class MeasuringSession:
    """How far a measuring drive had come when it was interrupted."""

    plan: str
    """digest of the postures that it went to, `rejoint.diagnosis.calibration.postures.Suggestion.digest`"""
    answered: int
    """postures that were measured or left out"""
    afresh: bool = False
    """whether no earlier calibration was to be believed"""
