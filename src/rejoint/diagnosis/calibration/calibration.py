"""A calibration: its parameters and their prior, displacement, uncertainty, what a wedge brings, and its file.

Torques and compliances scale with the arm's size, lengths with its reach (`rejoint.arms.workspace`).

The play of an unloaded joint is scatter, not a shift.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_type_hints

import msgspec
import numpy as np
from scipy.linalg import block_diag

from rejoint.arms import Arm, Array, Displacement, frames, jacobian, levers, tcp_pose, tcp_position
from rejoint.arms.inertia import bare
from rejoint.arms.kinematics import GRAVITY, floating
from rejoint.arms.rotations import between_directions, turned
from rejoint.arms.workspace import length_size, torque_size
from rejoint.control.controllers.policy import law_digests
from rejoint.control.correction import Modelled
from rejoint.system.errors import ContractError, InputError
from rejoint.system.files import array_of, read_sealed, toml_of, write_sealed
from rejoint.system.records import Readable, entity, value_type
from rejoint.system.statistics import CONFIDENCE

OFFSET = np.radians(0.6)
"""[rad] sigma of an encoder's zero; chosen"""
COMPLIANCE = 0.015
"""[rad/(N m)] mean and sigma of a joint's compliance on a myCobot 280; chosen"""
PLAY, PLAY_SIGMA = np.radians(0.9), np.radians(0.7)
"""[rad] mean and sigma of a joint's play (SO-ARM100 issue 134: about 1 deg on healthy servos)"""
LEVEL, ASKEW = np.radians(0.1), np.radians(6.0)
"""[rad] sigma of the tilt per horizontal axis, on a table and tilted; chosen"""
MASS = 0.12
"""Relative sigma of each link's mass; chosen"""
SHIFT, TURN = 1e-3, np.radians(0.3)
"""[m] over a myCobot 280's reach, and [rad]: sigma of each link's description; chosen"""
ANYWHERE = 3.0
"""[m] and [rad] sigma of a pose outside the arm around its first estimate"""

_STEP = 1e-6  # [rad] for the derivative of the direction of gravity

KINDS = ("offset", "compliance", "play", "mass", "tilt", "twist")
"""Parameters of an arm, in order"""


@dataclass(frozen=True, eq=False)
class DisplacementLayout:
    """The parameters of an arm's displacement as a vector (k,)."""

    arm: Arm

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of parameters of each of `KINDS`."""
        return *[self.arm.joints] * 4, 2, 6 * (self.arm.joints + 1)

    @property
    def body(self) -> int:
        """Number of the arm's parameters, with which the vector begins."""
        return sum(self.sizes)

    def at(self, name: str) -> slice:
        """Slice of one of `KINDS`."""
        place = KINDS.index(name)
        return slice(sum(self.sizes[:place]), sum(self.sizes[: place + 1]))

    def names(self) -> tuple[str, ...]:
        """Names of the arm's parameters, such as ``play 2``."""
        return tuple(f"{kind} {i + 1}" for kind, size in zip(KINDS, self.sizes, strict=True) for i in range(size))

    def displacement(self, vector: Array) -> Displacement:
        """Displacement of the vector (k,)."""
        offset, compliance, play, mass, tilt, twist = (vector[self.at(name)] for name in KINDS)
        links = twist.reshape(self.arm.joints + 1, 6)
        return Displacement(
            offset=offset, compliance=compliance, play=play, twist=links, gravity=gravity_of(tilt), mass=1.0 + mass
        )

    def vector(self, displacement: Displacement) -> Array:
        """Turn a displacement into the arm's part of the vector."""
        own, down = displacement, [one / np.linalg.norm(one) for one in (GRAVITY, displacement.gravity)]
        parts = own.offset, own.compliance, own.play, own.mass - 1.0, between_directions(*down)[:2], own.twist.ravel()
        return np.concatenate([np.broadcast_to(part, size) for part, size in zip(parts, self.sizes, strict=True)])

    def linearised(self, vector: Array, position: Array) -> tuple[Array, Array]:
        """Tool (M, 4, 4) at ``position`` (M, n) [rad], and derivative (M, 6, body) of its shift and turn, base axes."""
        arm, own, loads = self.arm, self.displacement(vector), link_loads(self.arm, position)
        torque = loads @ own.gravity @ own.mass
        side = np.tanh(torque / (light := floating(arm)))
        one, tilt = np.eye(arm.joints), vector[self.at("tilt")]
        turns = [gravity_of(tilt + step) - gravity_of(tilt - step) for step in _STEP * np.eye(2)]
        by_load = [loads @ own.gravity, np.stack([loads @ turn @ own.mass for turn in turns], axis=-1) / (2 * _STEP)]
        # torque moves joints by flex and by the side of the play
        yielding = own.compliance + 0.5 * own.play * (1.0 - side**2) / light
        by_joint = [
            np.broadcast_to(one, (*torque.shape, arm.joints)),
            -torque[..., None] * one,
            -0.5 * side[..., None] * one,
        ]
        by_joint += [-yielding[..., None] * each for each in by_load]
        moved, joints = own.moved(arm), position + own.offset - own.compliance * torque - 0.5 * own.play * side
        slope = jacobian(moved, joints) @ np.concatenate(by_joint, axis=-1)
        return tcp_pose(moved, joints), np.concatenate([slope, _by_twist(moved, joints)], axis=-1)


def link_loads(arm: Arm, position: Array) -> Array:
    """Each link's weight on each joint: (M, n joints, n links, 3) [N m / (m/s^2)]."""
    f = frames(arm, position)
    com = f.position + np.einsum("mnij,nj->mni", f.rotation, arm.com)
    carried = np.triu(np.ones((arm.joints, arm.joints)))[..., None] * arm.mass[:, None]
    return -carried * np.cross(f.axis[:, :, None], com[:, None] - f.position[:, :, None])


def _by_twist(arm: Arm, joints: Array) -> Array:
    """Return derivative (M, 6, 6 n + 6) of the tool by small errors of the transforms."""
    f, first = frames(arm, joints), np.zeros((len(joints), 1, 3))
    before = np.concatenate([first[..., None] + np.eye(3), f.rotation], axis=1)  # frame before each transform
    lever = f.tcp_position[:, None] - np.concatenate([first, f.position], axis=1)
    swing = np.cross(lever[..., None], before, axisa=-2, axisb=-2, axisc=-2) * -1.0
    both = np.block([[before, swing], [np.zeros_like(before), before]])  # (M, n + 1, 6, 6)
    return np.moveaxis(both, 1, 2).reshape(len(joints), 6, 6 * (arm.joints + 1))


@entity
class Belief:
    """A normal distribution over the vector (k,), truncated at bounds."""

    mean: Array
    """(k,)"""
    precision: Array
    """(k, k) inverse covariance"""
    lower: Array
    """(k,)"""
    upper: Array
    """(k,)"""
    odds: float
    """log odds against the others"""


@value_type
class PriorCase:
    """A kind of arm with its prior."""

    offset: float = OFFSET
    """[rad] sigma"""
    play: float = PLAY
    """[rad]"""
    play_sigma: float = PLAY_SIGMA
    """[rad]"""
    compliance: float = COMPLIANCE
    """[rad/(N m)] mean and sigma for a myCobot 280's size"""
    tilt: float = LEVEL
    """[rad] sigma"""
    twist: float = 0.0
    """scale of the errors of the arm's description"""
    odds: float = 0.0
    """log odds against the others"""


NOTHING = np.zeros((0, 0))
"""Precision of no parameters"""


def belief(arm: Arm, case: PriorCase, outside: Array = NOTHING) -> Belief:
    """Prior of an arm in a case: mean, sigma and bounds of each kind; bounds are chosen.

    ``outside`` (o, o): precision of the parameters of the measuring device, zero and unbounded.
    """
    layout = DisplacementLayout(arm)
    mean, sigma, lower, upper = np.repeat([[0.0], [1.0], [-np.inf], [np.inf]], layout.body + len(outside), axis=1)
    stiff = torque_size(arm)
    soft, each = case.compliance / stiff, np.array([SHIFT * length_size(arm)] * 3 + [TURN] * 3)
    links = np.inf if case.twist else 0.0
    rows = {
        "offset": (0.0, case.offset, -10.0 * case.offset, 10.0 * case.offset),
        "compliance": (soft, soft, 0.0, 0.3 / stiff),
        "play": (case.play, case.play_sigma, 0.0, np.radians(8.0)),
        "mass": (0.0, MASS, -0.5, 0.5),
        "tilt": (0.0, case.tilt, -np.radians(20.0), np.radians(20.0)),
        "twist": (0.0, np.tile(max(case.twist, 1e-3) * each, arm.joints + 1), -links, links),
    }
    for name, row in rows.items():
        for column, value in zip((mean, sigma, lower, upper), row, strict=True):
            column[layout.at(name)] = value
    precision = block_diag(np.diag(sigma[: layout.body] ** -2.0), outside)
    return Belief(mean=mean, precision=precision, lower=lower, upper=upper, odds=case.odds)


def gravity_of(tilt: Array) -> Array:
    """Gravity (3,) [m/s^2] in a base tilted by ``tilt`` (2,) [rad]."""
    return turned(np.append(tilt, 0.0)) @ GRAVITY


FLOOR = 0.5e-3
"""[m] over a myCobot 280's reach, sigma of unexplained displacement; chosen"""
SCATTER = 1.0 / 3.0
"""Variance of a floating joint over half its play squared: uniform distribution; chosen"""


def scatter(arm: Arm, displacement: Displacement, position: Array, joint: float = 0.0) -> Array:
    """Covariance (..., 6, 6) of the tool's shift [m] and turn [rad] by floating joints at ``position`` (..., n) [rad].

    ``joint`` [rad]: unexplained sigma of every joint.
    """
    lever = jacobian(arm, position)
    variance = SCATTER * (0.5 * displacement.play) ** 2 * displacement.floats(arm, position) + joint**2
    return (lever * variance[..., None, :]) @ lever.mT


def floor_of(arm: Arm) -> float:
    """[m] sigma of each coordinate by unexplained displacement."""
    return FLOOR * length_size(arm)


GEOMETRY = ("offset", "axis", "tip", "mass", "com")
_NEAR = 7.81  # squared distance by its covariance that 95 % of draws of three coordinates keep (chi-squared)
_PARAMETERS = 64  # draws of the parameters, the same each time (chosen: a sigma within a tenth)
_DRAWS = 256  # of the tool for an interval (chosen: ends repeat within a tenth of the width; the same draws each time)


@entity
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
    """(k, k), see `DisplacementLayout`"""
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
    """[m] mean true error by encoders, of the points that fit"""
    after: float
    """[m] the same by this calibration, points left out"""
    used: bool
    """whether the correction helped at points left out; else it is off"""
    floor: float
    """[m] sigma per coordinate beyond the model"""
    zeros: str = ""
    """of the address, as `zeros_of`"""
    suspects: tuple[int, ...] = ()
    """rows, from 0, that do not fit"""
    left_out: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(M, 2) [m] errors ``before`` and ``after``"""

    @property
    def layout(self) -> DisplacementLayout:
        """Places of the parameters in the covariance."""
        return DisplacementLayout(self.arm)

    def sigma(self, kind: str) -> Array:
        """Return the standard deviations of one of `KINDS`."""
        return np.sqrt(np.diag(self.covariance))[self.layout.at(kind)]

    @property
    def wrong_zeros(self) -> dict[str, float]:
        """Offsets [rad] that no healthy joint has."""
        offset = self.displacement.offset
        wrong = np.flatnonzero(np.abs(offset) > 3.0 * (OFFSET + self.sigma("offset")))
        return {self.arm.joint_names[joint]: float(offset[joint]) for joint in wrong}

    def require(self, arm: Arm) -> None:
        """Raise ContractError for another arm."""
        check_arm(self.arm.name, geometry_of(self.arm), arm)

    def tool(self, position: Array) -> Array:
        """Tool (..., 3) [m] at the encoders' ``position`` (..., n) [rad]."""
        return self.displacement.tool(self.arm, position)

    def spread(self, position: Array) -> Array:
        """Covariance (..., 3, 3) [m^2] of `tool`: draws of the parameters, play of floating joints, and the floor."""
        own, layout = np.random.default_rng(0), self.layout
        mean = layout.vector(self.displacement)
        drawn = own.multivariate_normal(mean, self.covariance, _PARAMETERS, method="eigh")
        away, play = [], np.zeros((*np.shape(position)[:-1], 3, 3))
        for one in map(layout.displacement, drawn):
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
        draws = np.random.default_rng(0).standard_normal((_DRAWS, 3)) @ np.linalg.cholesky(spread).mT
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


@value_type
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

    sides = {side: chance(turned(-WEDGE * np.append(axis, 0.0)) @ own.gravity) for side, axis in _SIDES.items()}
    best = min(sides, key=lambda side: sides[side])
    lever = levers(arm, position).mean(axis=0)
    often = (np.abs(own.torque(arm, position)) < floating(arm)).mean(axis=0) >= 0.5
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
    write_sealed(path, toml_of(told), _ABOUT)


def read_calibration(path: Path, arm: Arm) -> Calibration:
    """Read a calibration; FileError if damaged, ContractError if of another arm."""

    def build(data: dict[str, Any]) -> Calibration:
        check_arm(data.pop("arm"), data["geometry"], arm)
        kinds = get_type_hints(Calibration)
        parts = {k: msgspec.convert(data[k], kind, dec_hook=array_of) for k, kind in kinds.items() if k in data}
        own = Calibration(arm=arm, **parts)
        require_finite(own.distance(arm.rest), (3,))  # its arrays fit the arm
        return own

    return read_sealed(path, build, name="calibration", version=FORMAT, again="with --fresh, calibrate the arm")


def require_finite(array: Array, shape: tuple[int, ...]) -> None:
    """Raise InputError unless an array that follows from a file has finite numbers and this ``shape``."""
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"expected finite numbers of shape {shape}, found {array.shape}")
