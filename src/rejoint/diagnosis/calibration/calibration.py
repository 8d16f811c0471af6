"""A calibration: displacement, uncertainty, what a wedge below the base would bring, and file."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from operator import methodcaller
from pathlib import Path
from typing import Any, get_type_hints

import msgspec
import numpy as np

from rejoint.arms import Arm, Array, Displacement, position_kinematics, tcp_position
from rejoint.arms.displacement import FLOATING
from rejoint.arms.inertia import bare
from rejoint.arms.rotations import rotation_about
from rejoint.control.controllers.policy import law_digests
from rejoint.control.correction import Modelled
from rejoint.diagnosis.calibration.parameters import DisplacementLayout, displacement_of, scatter, vector_of
from rejoint.system.errors import ContractError, InputError
from rejoint.system.files import array_of, read_sealed, write_sealed
from rejoint.system.results import Readable
from rejoint.system.statistics import CONFIDENCE

GEOMETRY = ("offset", "axis", "tip", "mass", "com")
_NEAR = 7.81  # squared distance by its covariance that 95 % of draws of three coordinates keep (chi-squared)
_PARAMETERS = 64  # draws of the parameters, the same each time (chosen: a sigma within a tenth)
_DRAWS = 256  # of the tool for an interval (chosen: ends repeat within a tenth of the width; the same draws each time)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Calibration(Readable):
    """What was measured about one arm, in its base frame.

    Examples
    --------
    >>> found = calibrate(arm, measurements)
    >>> command = found.aim(target, arm.rest)
    """

    arm: Arm
    displacement: Displacement
    covariance: Array
    """(k, k), see `parameters.DisplacementLayout`"""
    frame: Array
    """(4, 4) pose of the measuring frame in the base"""
    frame_name: str
    """``base``, or the name of a fitted frame"""
    source: str
    """``touch``, ``camera``, ``tracker`` or ``emulated``"""
    date: str
    points: int
    """measurements in the fit"""
    before: float
    """[m] mean true error by encoders"""
    after: float
    """[m] the same by this calibration, points left out"""
    used: bool
    """whether the correction helped at points left out; else it is off"""
    floor: float
    """[m] sigma per coordinate beyond the model"""
    suspects: tuple[int, ...] = ()
    """rows, from 0, that do not fit"""
    left_out: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(M, 2) [m] errors ``before`` and ``after``"""

    @property
    def missed(self) -> Array:
        """(M,) [m] error at each point, by the others."""
        return self.left_out[:, 1] if len(self.left_out) else np.array([self.after])

    @property
    def layout(self) -> DisplacementLayout:
        """Places of the parameters in the covariance."""
        return DisplacementLayout(joints=self.arm.joints)

    def require(self, arm: Arm) -> None:
        """Raise ContractError for another arm."""
        check_arm(self.arm.name, geometry_of(self.arm), arm)

    def tool(self, position: Array) -> Array:
        """Tool (..., 3) [m] at the encoders' ``position`` (..., n) [rad]."""
        return self.displacement.tool(self.arm, position)

    def spread(self, position: Array) -> Array:
        """Covariance (..., 3, 3) [m^2] of `tool`: draws of the parameters, play of floating joints, and the floor."""
        own, layout = np.random.default_rng(0), self.layout
        mean = vector_of(layout, self.displacement)
        drawn = own.multivariate_normal(mean, self.covariance, _PARAMETERS, method="eigh")
        away, play = [], np.zeros((*np.shape(position)[:-1], 3, 3))
        for one in (displacement_of(layout, vector) for vector in drawn):
            away.append(one.tool(self.arm, position) - self.tool(position))
            play += scatter(self.arm, one, position)[..., :3, :3] / len(drawn)
        known = np.einsum("d...i,d...j->...ij", away, away) / len(drawn)
        return known + play + self.floor**2 * np.eye(3)

    def distance(self, position: Array, target: Array | None = None) -> Array:
        """Mean and 95 % interval (3, ...) [m] of the distance between tool and ``target`` (..., 3) [m].

        Default target: the encoders' tool.
        """
        spread = self.spread(position)
        middle = self.tool(position) - (tcp_position(self.arm, position) if target is None else target)
        draws = np.random.default_rng(0).standard_normal((_DRAWS, 3)) @ np.swapaxes(np.linalg.cholesky(spread), -1, -2)
        distances = np.linalg.norm(middle[..., None, :] + draws, axis=-1)
        low, high = np.quantile(distances, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=-1)
        there = (middle[..., None] * np.linalg.solve(spread, middle[..., None])).sum(axis=(-2, -1)) < _NEAR
        return np.stack([distances.mean(axis=-1), np.where(there, 0.0, low), high])

    def aim(self, target: Array, start: Array) -> Array:
        """Where the encoders must see the tool (..., 3) [m] for it to be at ``target`` (..., 3) [m].

        ``start`` (..., n) [rad]: where the arm comes from.
        """
        target = np.array(target, dtype=float)
        if not self.used:
            return target
        flat = target.reshape(-1, 3)
        came = np.broadcast_to(start, (*target.shape[:-1], self.arm.joints)).reshape(-1, self.arm.joints)
        aims, _ = Modelled(self.arm, self.displacement).aim(flat, came, np.ones(len(flat), dtype=bool))
        return aims.reshape(target.shape)


def geometry_of(arm: Arm) -> dict[str, str]:
    """Digest the fields of an arm that count for a calibration."""
    digests = law_digests(bare(arm))
    return {name: digests[name] for name in GEOMETRY}


def check_arm(name: str, digests: dict[str, str], arm: Arm) -> None:
    """Raise ContractError unless the digests are those of ``arm``."""
    own = geometry_of(arm)
    other = [field for field in GEOMETRY if digests.get(field) != own[field]]
    if name == arm.name and not other:
        return
    differs = f"; they differ in {', '.join(other)}" if name == arm.name else ""
    raise ContractError(f"calibration of arm {name!r}, expected one of {arm.name!r}{differs}; calibrate this arm")


WEDGE = np.radians(2.0)
"""[rad] slope of the wedge; chosen: 0.5 to 8 degrees serve emulated worn arms alike"""
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

    def chance(gravity: Array) -> float:
        covariance = scatter(arm, replace(own, gravity=gravity), position)[..., :3, :3]
        return float(np.sqrt(np.trace(covariance, axis1=-2, axis2=-1).mean()))

    turns = {side: rotation_about(np.array([*axis, 0.0]), -WEDGE) for side, axis in _SIDES.items()}
    sides = {side: chance(turn @ own.gravity) for side, turn in turns.items()}
    best = min(sides, key=lambda side: sides[side])
    lever = np.linalg.norm(position_kinematics(arm, position)[1], axis=-2).mean(axis=0)
    often = (np.abs(own.torque(arm, position)) < FLOATING).mean(axis=0) >= 0.5
    floats = often & (own.play * lever > found.floor)
    names = tuple(np.array(arm.joint_names)[floats].tolist())
    return Preload(joints=names, chance=chance(own.gravity), wedge=sides[best], side=best)


FORMAT = 1

_ABOUT = """Where the tool of one robot arm is behind its encoders. SI units.
suspects: rows that do not fit to the others
before: m, mean true error at measured points, uncorrected
after: m, the same, each point predicted from the others
used: false: nothing is corrected
floor: m, standard deviation of a coordinate that nothing here explains
left_out: m, of each measured point: as before and after
geometry: digests of what the fit computed with
displacement: play and offset of one joint cannot be told apart: together they say where the tool is
offset: rad, added to what the encoders say
compliance: rad/(N m), of gear and link
play: rad, whole width
mass: 1, by the description of the arm
gravity: m/s^2, in the frame of the base
frame: pose of whatever measured, in the base
covariance: of the parameters of the displacement in this order: mass less one, gravity as tilt in rad"""


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration, atomically."""
    own = calibration
    told = {"format": FORMAT, **vars(own), "arm": own.arm.name, "geometry": geometry_of(own.arm)}
    told["order"] = own.layout.names()
    write_sealed(path, msgspec.to_builtins(told, enc_hook=methodcaller("tolist")), _ABOUT)


def read_calibration(path: Path, arm: Arm) -> Calibration:
    """Read a calibration; FileError if damaged, ContractError if of another arm."""

    def build(data: dict[str, Any]) -> Calibration:
        check_arm(str(data["arm"]), {str(k): str(v) for k, v in data["geometry"].items()}, arm)
        kinds = {name: kind for name, kind in get_type_hints(Calibration).items() if name != "arm"}
        parts = {name: msgspec.convert(data[name], kind, dec_hook=array_of) for name, kind in kinds.items()}
        own = Calibration(arm=arm, **parts)
        require_finite(own.distance(arm.rest), (3,))  # its arrays fit the arm
        return own

    return read_sealed(path, build, name="calibration", version=FORMAT, again="calibrate the arm")


def require_finite(array: Array, shape: tuple[int, ...]) -> None:
    """Raise InputError unless an array that follows from a file has finite numbers and this ``shape``."""
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"expected finite numbers of shape {shape}, found {array.shape}")
