"""The table under an arm, as a plane."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.system.errors import InputError


@dataclass(frozen=True, kw_only=True)
class TablePlane:
    """A plane under the tip."""

    height: float
    """[m] of the TCP in contact, below the base's origin"""
    slope_x: float
    """along the base's x"""
    slope_y: float
    stiffness: float
    """[N/m] of tip, links and table together, vertical"""
    friction: float
    """Coulomb coefficient of the tip"""

    def __post_init__(self) -> None:
        if not np.isfinite(astuple(self)).all() or self.stiffness <= 0 or self.friction < 0:
            raise InputError(f"table: needs finite values, a stiffness above 0 and no negative friction, got {self}")

    def surface(self, points: Array) -> Array:
        """Height (...) [m] under points (..., 3) [m]."""
        return self.height + self.slope_x * points[..., 0] + self.slope_y * points[..., 1]
