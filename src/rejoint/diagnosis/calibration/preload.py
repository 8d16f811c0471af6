"""What would press floating joints to one side of their play: a wedge under the base, or a weight at the tool.

A joint without weight lies in its play where chance left it, and no correction can know where. Standing the base
askew lets gravity pull on a base joint, which no weight at the tool can do; a weight helps joints of the wrist. How
much less chance would decide then is computed from the calibration: the part of the tool's error that such joints make.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.displacement import FLOATING
from rejoint.arms.kinematics import position_kinematics
from rejoint.arms.rotations import rotation_about
from rejoint.arms.size import torque_size
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.model import scatter

WEDGE = np.radians(2.0)
"""[rad] slope of the wedge (chosen: on emulated arms half a degree does, `python -m benchmarks.wedge`, but there only
grease holds the link of a base joint, and real bearings have friction; more brings nothing)"""
RISE = 100.0 * float(np.tan(WEDGE))
"""[mm] by which it rises on 10 cm"""
WEIGHT = 0.05
"""[kg] at the tool of an arm of the size of a myCobot 280 (chosen: a fifth of the 250 g that it may carry)"""
WORTH = 0.8
"""Share of what chance decides that is left at most where a wedge or a weight is worth its trouble (chosen)"""
_SIDES = {"-x": (0.0, 1.0), "+x": (0.0, -1.0), "-y": (-1.0, 0.0), "+y": (1.0, 0.0)}
"""Side of the base that is raised, and the axis (x, y) about which that turns the base"""


@dataclass(frozen=True, kw_only=True)
class Preload:
    """What could be done about joints that float, and what that would bring."""

    joints: tuple[str, ...]
    """names of the joints that float at half of the postures or more"""
    chance: float
    """[m] root mean square of the part of the tool's error that floating joints make, as the arm stands"""
    wedge: float
    """[m] the same on a wedge"""
    side: str
    """side of the base that is to be raised, such as ``+y``"""
    weight: float
    """[m] the same with a weight at the tool"""
    mass: float
    """[kg] of that weight"""

    @property
    def wedge_helps(self) -> bool:
        """Whether the wedge is worth its trouble."""
        return bool(self.joints) and self.wedge <= WORTH * self.chance

    @property
    def weight_helps(self) -> bool:
        """Whether the weight is worth its trouble."""
        return bool(self.joints) and self.weight <= WORTH * self.chance


def preload(found: Calibration, position: Array) -> Preload:
    """Compute what a wedge or a weight brings at ``position`` (M, n) [rad]."""
    arm, own = found.arm, found.displacement
    sides = {side: _chance(arm, _tilted(own, axis), position) for side, axis in _SIDES.items()}
    best = min(sides, key=lambda side: sides[side])
    mass = WEIGHT * torque_size(arm)
    return Preload(
        joints=_floating(found, position), chance=_chance(arm, own, position), wedge=sides[best], side=best,
        weight=_chance(_loaded(arm, own, mass), own, position), mass=mass,
    )  # fmt: skip


def _floating(found: Calibration, position: Array) -> tuple[str, ...]:
    """Name the joints that float in some play and move the tool by it."""
    torque = found.displacement.torque(found.arm, position)
    lever = np.linalg.norm(position_kinematics(found.arm, position)[1], axis=-2).mean(axis=0)
    often = (np.abs(torque) < FLOATING).mean(axis=0) >= 0.5
    felt = 0.5 * found.displacement.play * lever > found.floor / 2
    return tuple(name for name, floats in zip(found.arm.joint_names, often & felt, strict=True) if floats)


def _chance(arm: Arm, displacement: Displacement, position: Array) -> float:
    return float(np.sqrt(np.trace(scatter(arm, displacement, position), axis1=-2, axis2=-1).mean()))


def _tilted(displacement: Displacement, axis: tuple[float, float]) -> Displacement:
    """Return the same on a wedge that turns the base by `WEDGE` about ``axis``: gravity turns back, seen from there."""
    turn = rotation_about(np.array([*axis, 0.0]), -WEDGE)
    return replace(displacement, gravity=turn @ displacement.gravity)


def _loaded(arm: Arm, displacement: Displacement, mass: float) -> Arm:
    """Return the arm with a weight at its tool that pulls by ``mass`` [kg], whatever the displacement's factor is."""
    factor = np.broadcast_to(displacement.mass, (arm.joints,))
    heavy, com = arm.mass.copy(), arm.com.copy()
    added = mass / float(factor[-1])
    heavy[-1] += added
    com[-1] = (arm.mass[-1] * arm.com[-1] + added * arm.tip[:3, 3]) / heavy[-1]
    return replace(arm, mass=heavy, com=com)
