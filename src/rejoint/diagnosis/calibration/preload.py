"""A wedge under the base presses floating joints to one side of their play."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.displacement import FLOATING
from rejoint.arms.kinematics import position_kinematics
from rejoint.arms.rotations import rotation_about
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.parameters import scatter

WEDGE = np.radians(2.0)
"""[rad] slope of the wedge; chosen, see `python -m benchmarks wedge`"""
RISE = 100.0 * float(np.tan(WEDGE))
"""[mm] rise on 10 cm"""
WORTH = 0.8
"""Share of random error that a useful wedge leaves; chosen"""
_SIDES = {"-x": (0.0, 1.0), "+x": (0.0, -1.0), "-y": (-1.0, 0.0), "+y": (1.0, 0.0)}
"""Raised side of the base, and the axis (x, y) of that turn"""


@dataclass(frozen=True, kw_only=True)
class Preload:
    """Benefit of a wedge."""

    joints: tuple[str, ...]
    """that float at half of the postures or more"""
    chance: float
    """[m] rms tool error by floating joints"""
    wedge: float
    """[m] the same on a wedge"""
    side: str
    """to raise, such as ``+y``"""

    @property
    def wedge_helps(self) -> bool:
        """Whether the wedge is worth it."""
        return bool(self.joints) and self.wedge <= WORTH * self.chance


def preload(found: Calibration, position: Array) -> Preload:
    """Compute the benefit of a wedge at ``position`` (M, n) [rad]."""
    arm, own = found.arm, found.displacement
    sides = {side: _chance(arm, _tilted(own, axis), position) for side, axis in _SIDES.items()}
    best = min(sides, key=lambda side: sides[side])
    return Preload(joints=_floating(found, position), chance=_chance(arm, own, position), wedge=sides[best], side=best)


def _floating(found: Calibration, position: Array) -> tuple[str, ...]:
    torque = found.displacement.torque(found.arm, position)
    lever = np.linalg.norm(position_kinematics(found.arm, position)[1], axis=-2).mean(axis=0)
    often = (np.abs(torque) < FLOATING).mean(axis=0) >= 0.5
    felt = 0.5 * found.displacement.play * lever > found.floor / 2
    return tuple(name for name, floats in zip(found.arm.joint_names, often & felt, strict=True) if floats)


def _chance(arm: Arm, displacement: Displacement, position: Array) -> float:
    return float(np.sqrt(np.trace(scatter(arm, displacement, position), axis1=-2, axis2=-1).mean()))


def _tilted(displacement: Displacement, axis: tuple[float, float]) -> Displacement:
    turn = rotation_about(np.array([*axis, 0.0]), -WEDGE)
    return replace(displacement, gravity=turn @ displacement.gravity)
