"""The parameters of a twin, their units and priors.

Stiffness: Park et al. 2024 train on P = 50..200; a 0.85 kg arm oscillates as in their Fig. 10 with 0.06 P N m/rad (in
simulation). Bounds contain identified hobby servos (SO-101: 19-26 N m/rad, Coulomb friction 0.25-0.8 N m, viscous
friction 0.8-1.6 N m s/rad); ranges of unknown arms, industrial joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import CATALOGUE, Arm, Array, Index, Mask
from rejoint.arms.workspace import largest_loads, least_load, length_size
from rejoint.control.robot import Servos
from rejoint.system.records import entity, taken, value_type

TIMESTEP = 0.005
"""[s]; chosen: half of it changes predictions by less than an encoder step"""


@value_type
class Parameter:
    """A row of `rejoint.twin.parameters.PARAMETERS`."""

    name: str
    unit: str
    meaning: str
    nominal: float
    """prior median at `rejoint.twin.parameters.REFERENCE_LOAD`, near the base"""
    sigma: float
    """prior sigma: of the logarithm if `log`, else in `unit`"""
    lower: float
    upper: float
    wide: Mapping[str, float | bool] = field(default_factory=dict)
    """for an unknown arm"""
    healthy: float = 1.0
    """of a servo without wear, over the median: chosen, as 35 N m/rad of an STS3215 (SO-ARM100, issue 134)"""
    log: bool = True
    """estimated as its logarithm"""
    difference: float = 0.045
    """finite-difference step, in `unit` unless `log`; chosen"""
    beside: float = 0.0
    """sigma by what no twin holds; measured: emulated worn arms"""
    fitted: bool = True
    """whether a descent may change it"""
    per_joint: bool = True
    scaled: bool = False
    """torque known up to its joint's common scale"""
    wrist: float = 1.0
    """factor for wrist joints"""
    alike: float | None = None
    """sigma, as `sigma`, among equal servos (`rejoint.arms.Arm.servos`)"""
    by_load: bool = False
    """nominal value and bounds scale with the arm's weight"""
    by_time: int = 0
    """their power of sqrt(reach)"""
    by_speed: bool = False
    """they scale with the arm's speed"""


@entity
class TwinParameters(Servos):
    """Physical parameters of one twin or a batch, with any leading shape."""

    ramp_speed: Array
    """(...) [rad/s] speed of the servo's reference"""
    compensation: Array = field(default_factory=lambda: np.zeros(()))
    """(..., n) share of the model's gravity that does not show, fed forward or too heavy; 0 for hobby servos"""
    load_friction: Array = field(default_factory=lambda: np.zeros(()))
    """(..., n) dry friction per torque that the gears pass on"""
    stiction: Array = field(default_factory=lambda: np.ones(()))
    """(..., n) dry friction at rest over that in motion"""

    def __post_init__(self) -> None:
        for parameter in PARAMETERS:
            array = np.array(getattr(self, parameter.name), dtype=float)
            shape = np.shape(self.stiffness) if parameter.per_joint else self.shape
            object.__setattr__(self, parameter.name, np.broadcast_to(array, shape))  # which is read-only

    @property
    def shape(self) -> tuple[int, ...]:
        """Leading shape: () for one twin, (m,) for a batch."""
        return np.shape(self.stiffness)[:-1]

    def __getitem__(self, index: int | slice | Index | Mask) -> TwinParameters:
        """Select twins along the first leading axis."""
        return taken(self, vars(self), index)

    @classmethod
    def stacked(cls, twins: Sequence[TwinParameters]) -> TwinParameters:
        """Stack twins along a leading axis."""
        return cls(**{f.name: np.stack([getattr(one, f.name) for one in twins]) for f in fields(cls)})

    def repeat(self, count: int) -> TwinParameters:
        """Repeat a single twin along a leading axis."""
        return self.stacked([self] * count)


PARAMETERS: tuple[Parameter, ...] = (
    Parameter(name="stiffness", unit="N m/rad", meaning="servo torque per angle between command and joint",
              nominal=7.0, sigma=0.7, healthy=5.0, lower=0.5, upper=200.0, wrist=0.8, by_load=True, scaled=True,
              # chosen: geometric middle of worn (7) and healthy (35 N m/rad) hobby servos; stiffer within three sigma
              wide={"nominal": 16.0, "sigma": 0.9, "upper": 1000.0,
                    "alike": 0.05}),  # chosen: motors and voltages of one make differ by some percent
    Parameter(name="damping", unit="N m s/rad", meaning="viscous friction and derivative gain together",
              nominal=0.25, sigma=0.8, lower=0.005, upper=20.0, wrist=0.6, healthy=3.2, by_load=True, by_time=1,
              scaled=True,
              # chosen: a servo that follows within 50 ms; damping over stiffness is that lag
              wide={"nominal": 0.8, "sigma": 0.9, "upper": 100.0, "alike": 0.2}),
    Parameter(name="coulomb", unit="N m", meaning="dry friction",
              nominal=0.08, sigma=0.8, healthy=0.6, lower=0.002, upper=2.0, wrist=0.5, by_load=True, scaled=True,
              # chosen: 0.03 to 1.5 N m within two sigma
              wide={"nominal": 0.2, "sigma": 1.0, "upper": 10.0}),
    Parameter(name="load_friction", unit="1", meaning="dry friction per torque that the gears pass on",
              nominal=0.0, sigma=1e-4, lower=0.0, upper=2.0, log=False, difference=0.02,
              wide={"sigma": 0.3}),  # chosen: gears take up to half of what they pass on
    Parameter(name="stiction", unit="1", meaning="dry friction at rest over that in motion",
              # measured on a real low-cost arm
              nominal=1.25, sigma=0.4, healthy=0.8, lower=1.0, upper=2.5, log=False, difference=0.1, beside=0.4,
              wide={"alike": 0.1}),
    Parameter(name="armature", unit="kg m^2", meaning="inertia of motor and gears at the joint",
              nominal=0.02, sigma=0.4, lower=0.002, upper=0.1, by_load=True, by_time=2,
              # measured: 0.01 to 0.03 kg m^2 for geared hobby servos
              wide={"nominal": 0.015, "sigma": 1.0, "lower": 5e-4, "upper": 1.0, "alike": 0.1}),
    Parameter(name="torque_limit", unit="N m", meaning="largest torque of the servo",
              nominal=0.92, sigma=0.35, healthy=2.2, lower=0.05, upper=5.0, wrist=0.5, by_load=True,
              # chosen: twice and more what the arm weighs, or no one would have recorded it moving
              wide={"nominal": 3.0, "sigma": 0.7, "upper": 50.0, "alike": 0.1}),
    Parameter(name="offset", unit="rad", meaning="unloaded joint position minus command",
              nominal=0.0, sigma=0.01, lower=-0.1, upper=0.1, log=False, difference=0.005,
              wide={"sigma": 0.02, "lower": -0.2, "upper": 0.2}),
    Parameter(name="compensation", unit="1", meaning="share of the model's gravity torque that the controller feeds "
              "forward, or by which the model is too heavy",
              nominal=0.0, sigma=0.01, lower=-1.0, upper=1.0, log=False, fitted=False),
    Parameter(name="delay", unit="s", meaning="command latency plus age of the answer",
              nominal=0.025, sigma=0.012, lower=0.0, upper=0.2, log=False, difference=0.004, per_joint=False,
              beside=0.003,  # such as the filter of a servo's speed, and the step of the fit
              # chosen: a bus servo answers within a few periods; below zero where a position is read up to a period
              # of 20 ms later than its row is stamped
              wide={"nominal": 0.01, "sigma": 0.015, "lower": -0.02}),
    Parameter(name="ramp_speed", unit="rad/s", meaning="speed of the servo's reference",
              nominal=2.0, sigma=0.25, lower=0.5, upper=20.0, per_joint=False, by_speed=True,
              # chosen: faster than most motions, so that a ramp must show itself in the data
              wide={"nominal": 8.0, "sigma": 0.7, "upper": 50.0, "by_speed": False}),
)  # fmt: skip
"""In the order of the vector. Differences of offset and delay are chosen."""

PER_JOINT = sum(p.per_joint for p in PARAMETERS)
"""Number of parameters of each joint"""

REFERENCE_LOAD = 0.838
"""[N m] largest gravity torque of the myCobot 280"""

REFERENCE_SPEED = np.radians(150.0)
"""[rad/s] its joint speed"""

LEAST_FED = 0.05
"""Least share of gravity fed forward that counts; chosen"""

NO_LOAD = 2.0
"""No-load speed of a motor over its joint's largest; chosen: the speed of most power"""

BESIDE = 0.5
"""Least share of the damping beside the torque limit of other motors; chosen: viscous friction is there, too"""

WRIST_INERTIA = 0.2
"""Share of the largest link inertia that bounds the wrist; chosen"""


@dataclass(frozen=True)
class Layout:
    """Indices of a twin's parameters in its vector of length k: those of n joints, then of the arm."""

    joints: int

    @classmethod
    def of(cls, vector: Array) -> Layout:
        """Of vectors (..., k)."""
        return cls(1 + (vector.shape[-1] - len(PARAMETERS)) // PER_JOINT)

    @cached_property
    def kind(self) -> Index:
        """(k,) number in `PARAMETERS`."""
        return np.repeat(np.arange(len(PARAMETERS)), [self.joints if p.per_joint else 1 for p in PARAMETERS])

    @cached_property
    def owner(self) -> Index:
        """(k,) joint; -1 for the whole arm."""
        return np.concatenate([np.arange(self.joints) if p.per_joint else np.array([-1]) for p in PARAMETERS])

    def has(self, name: str) -> NDArray[Any]:
        """(k,) values of a field of `Parameter`."""
        return np.array([getattr(p, name) for p in PARAMETERS])[self.kind]

    @cached_property
    def is_log(self) -> Mask:
        """(k,) which are logarithms."""
        return self.has("log")

    @cached_property
    def is_fitted(self) -> Mask:
        """(k,) which a descent may change."""
        return self.has("fitted")

    def fitted(self, values: Array) -> Array:
        """Vectors (m, k) of ``values`` (m, f), else 0."""
        whole = np.zeros((len(values), len(self.kind)))
        whole[:, self.is_fitted] = values
        return whole

    def normal(self, rng: np.random.Generator, count: int) -> Array:
        """Draw standard normal values (count, k) of the fitted elements, else 0."""
        return self.fitted(rng.standard_normal((count, self.is_fitted.sum())))

    def at(self, name: str) -> slice:
        """Slice of one parameter."""
        return slice(*np.searchsorted(self.kind, [number(name), number(name) + 1]))


def number(name: str) -> int:
    """Return the number in `PARAMETERS`."""
    return [p.name for p in PARAMETERS].index(name)


def vector_names(joint_names: tuple[str, ...]) -> tuple[str, ...]:
    """Names such as ``stiffness.joint2`` and ``delay``."""
    layout = Layout(len(joint_names))
    return tuple(
        PARAMETERS[kind].name + (f".{joint_names[joint]}" if joint >= 0 else "")
        for kind, joint in zip(layout.kind, layout.owner, strict=True)
    )


def flat(parameters: TwinParameters) -> Array:
    """Values (..., k) in the order of the vector."""
    parts = [(p, getattr(parameters, p.name)) for p in PARAMETERS]
    return np.concatenate([values if p.per_joint else values[..., None] for p, values in parts], -1)


def shaped(values: Array) -> TwinParameters:
    """Inverse of `flat` for ``values`` (..., k)."""
    at = Layout.of(values).at
    places = {p.name: at(p.name) if p.per_joint else at(p.name).start for p in PARAMETERS}
    return TwinParameters(**{name: values[..., place] for name, place in places.items()})


def pack(parameters: TwinParameters) -> Array:
    """Parameter vector (..., k), with logarithms of the positive quantities."""
    values = flat(parameters)
    return np.log(values, out=values, where=Layout.of(values).is_log)


def unpack(vector: Array) -> TwinParameters:
    """Inverse of `pack` for ``vector`` (..., k)."""
    return shaped(np.exp(vector, out=vector.copy(), where=Layout.of(vector).is_log))


@entity
class Prior:
    """Prior of an arm over the parameter vector."""

    mean: Array
    """(k,) medians, as in `pack`"""
    sigma: Array
    """(k,)"""
    lower: Array
    """(k,) physical bounds"""
    upper: Array
    correlation: Array
    """(k, k)"""
    told: Array | None = None
    """(k,) sigma before the logs told a stiffness; None: ``sigma``"""

    @cached_property
    def layout(self) -> Layout:
        """Of the vectors."""
        return Layout.of(self.mean)

    @cached_property
    def precision(self) -> Array:
        """(k, k) inverse covariance."""
        return np.linalg.inv(self.correlation) / np.outer(self.sigma, self.sigma)

    def clip(self, vectors: Array) -> Array:
        """Vectors (..., k) within the bounds."""
        return np.clip(vectors, self.lower, self.upper)


def prior(arm: Arm, table: tuple[Parameter, ...] = PARAMETERS) -> Prior:
    """Prior by a table, the arm's largest gravity torque, reach, speed and link inertias."""
    load = max(largest_loads(arm).max(), least_load(arm)) / REFERENCE_LOAD
    time = length_size(arm) ** 0.5
    speed = arm.max_speed.min() / REFERENCE_SPEED
    wrist = _wrist(arm)
    rows = []
    for p in table:
        scale = (load if p.by_load else 1.0) * time**p.by_time * (speed if p.by_speed else 1.0)
        for is_wrist in wrist if p.per_joint else [False]:
            values = np.array([p.nominal * (p.wrist if is_wrist else 1.0), p.lower, p.upper]) * scale
            median, lower, upper = np.log(values) if p.log else values
            rows.append((median, p.sigma, lower, upper))
    mean, sigma, lower_, upper_ = np.array(rows).T
    return Prior(mean=mean, sigma=sigma, lower=lower_, upper=upper_, correlation=_alike(arm, table))


def _alike(arm: Arm, table: tuple[Parameter, ...]) -> Array:
    """Correlation (k, k) of joints with equal servos."""
    layout, servos = Layout(arm.joints), arm.servos or ("",) * arm.joints
    same = np.array([[one == other != "" for other in servos] for one in servos]) & ~np.eye(arm.joints, dtype=bool)
    correlation = np.eye(len(layout.kind))
    for p in table:
        if p.alike is not None:
            correlation[layout.at(p.name), layout.at(p.name)] += same * (1.0 - (p.alike / p.sigma) ** 2)
    return correlation


DRY = ("coulomb", "load_friction", "stiction")
"""Parameters of dry friction"""
STRIBECK_SPEED = 0.1
"""[rad/s] at which friction has fallen to kinetic; chosen"""


def friction_terms(twin: TwinParameters) -> Array:
    """Terms (t, ..., n) of `dry_friction`, in the order of `DRY`."""
    return np.stack([getattr(twin, name) for name in DRY])


def dry_friction(terms: Array, speed: Array, load: Array | float) -> Array:
    """Dry friction (...) [N m] at ``speed`` (...) [rad/s] under ``load`` (...) [N m], from ``terms`` (t, ...).

    Stribeck's law (Stribeck 1902, as in Armstrong-Helouvry et al. 1994), and gears that rub as they are pressed
    (Rhoban/bam); also compiled.
    """
    coulomb, load_friction, stiction = terms[0], terms[1], terms[2]
    return (coulomb + load_friction * load) * (1.0 + (stiction - 1.0) * np.exp(-((speed / STRIBECK_SPEED) ** 2)))


def back_emf(arm: Arm, twin: TwinParameters) -> Array:
    """Return the share (..., n) [N m s/rad] of the damping that acts beside the torque limit; the limit holds the rest.

    A servo limits duty, derivative gain included; back-EMF takes torque after that, and so does viscous friction.
    Outside the catalogue, where no-load speeds are unknown, both are at least `BESIDE` of the damping.
    """
    least = 0.0 if is_hobby(arm) else BESIDE * twin.damping
    return np.clip(twin.torque_limit / (NO_LOAD * arm.max_speed), least, twin.damping)


BREAKAWAY, RUBBING = 2.0, 0.15
"""Dry friction at rest over that in motion, of dry gears; friction over load, with a margin for more load; chosen"""


def lifting_torque(twin: TwinParameters) -> Array:
    """Return the torque (..., n) [N m] that motors lift from rest, against their friction."""
    usable = (twin.torque_limit - BREAKAWAY * twin.coulomb) / (1.0 + RUBBING)
    return np.maximum(usable, 0.1 * twin.torque_limit)


@lru_cache
def nominal_parameters(arm: Arm) -> TwinParameters:
    """Twin of the prior medians."""
    return unpack(prior(arm).mean)


def is_hobby(arm: Arm) -> bool:
    """Whether the servos are hobby servos: those of the catalogue are."""
    return arm.name in CATALOGUE


def healthy_parameters(arm: Arm) -> TwinParameters:
    """Twin of an arm of hobby servos without wear."""
    worn = nominal_parameters(arm)
    return TwinParameters(**{p.name: p.healthy * getattr(worn, p.name) for p in PARAMETERS})


def _wrist(arm: Arm) -> Mask:
    passed = np.cumsum(np.linalg.norm(arm.offset[:, :3, 3], axis=1))
    reach = passed - passed[:, None] + np.linalg.norm(arm.com, axis=1)  # at most, with the chain stretched out
    inertia = np.triu(arm.mass * reach**2).sum(axis=1)
    return inertia < WRIST_INERTIA * inertia.max()


UNKNOWN_PARAMETERS: tuple[Parameter, ...] = tuple(replace(p, wrist=1.0, **p.wide) for p in PARAMETERS)  # type: ignore[arg-type]
"""For an unknown arm, whose wrist may be as strong as its other joints"""


def unknown_prior(arm: Arm) -> Prior:
    """Prior of an arm known by its URDF or MJCF."""
    return prior(arm, UNKNOWN_PARAMETERS)
