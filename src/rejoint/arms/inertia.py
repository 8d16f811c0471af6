"""Masses and inertias; payload and tool.

A solid cylinder along the link replaces impossible values, with a note.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms.arm import Arm, Array
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_floats

LINK_RADIUS_RATIO = 1 / 20
"""Radius of that cylinder over the reach (chosen)"""

LINK_DENSITY = 1000.0
"""[kg/m^3] (chosen)"""

DENSEST = 20000.0
"""[kg/m^3] upper bound (tungsten: 19300)"""

IMPLAUSIBLE_MASS_RATIO = 100.0
"""over the estimate, or its inverse square: a placeholder (chosen)"""

ROUNDING = 0.05
"""of the triangle inequality (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class SpatialInertia:
    """Mass, centre and inertia of a rigid body."""

    mass: float
    """[kg]"""
    com: Array
    """(3,) [m]"""
    inertia: Array
    """(3, 3) [kg m^2] about the centre"""
    doubtful: bool = False
    """most of the mass has no usable inertia"""

    def seen_from(self, pose: Array) -> SpatialInertia:
        """Transform from the frame ``pose`` (4, 4) to its parent."""
        turn = pose[:3, :3]
        return SpatialInertia(
            mass=self.mass,
            com=turn @ self.com + pose[:3, 3],
            inertia=turn @ self.inertia @ turn.T,
            doubtful=self.doubtful,
        )


NOTHING = SpatialInertia(mass=0.0, com=np.zeros(3), inertia=np.zeros((3, 3)))


def combined(pieces: Sequence[SpatialInertia]) -> SpatialInertia:
    """Join bodies of one frame (parallel-axis theorem)."""
    mass = sum(piece.mass for piece in pieces)
    if mass <= 0.0:
        return NOTHING
    com = sum((piece.mass * piece.com for piece in pieces), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for piece in pieces:
        arm = piece.com - com
        inertia += piece.inertia + piece.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    unknown = sum(piece.mass for piece in pieces if piece.doubtful)
    return SpatialInertia(mass=mass, com=com, inertia=inertia, doubtful=unknown > mass / 2)


def cylinder(mass: float, end: Array, radius: float) -> Array:
    """Inertia (3, 3) [kg m^2] of a cylinder from the origin to ``end`` (3,) [m], about its centre."""
    length = float(np.linalg.norm(end))
    along = end / length
    axial, lateral = mass * radius**2 / 2, mass * (3 * radius**2 + length**2) / 12
    return lateral * np.eye(3) + (axial - lateral) * np.outer(along, along)


def inertia_matrix(values: Sequence[float] | Array) -> Array:
    """Inertia (3, 3) from xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_values(inertia: Array) -> Array:
    """Its inverse, (6,)."""
    return inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def ball(mass: float) -> Array:
    """Inertia (3, 3) [kg m^2] of a ball of `LINK_DENSITY`."""
    return _ball_moment(mass, LINK_DENSITY) * np.eye(3)


def ball_radius(mass: float) -> float:
    """Its radius [m]."""
    return float((3 * mass / (4 * np.pi * LINK_DENSITY)) ** (1 / 3))


def usable(inertia: Array) -> bool:
    """Whether (3, 3) [kg m^2] is possible."""
    if not np.isfinite(inertia).all() or not np.abs(inertia - inertia.T).max() <= 1e-6 * np.abs(inertia).max():
        return False
    small, middle, large = np.linalg.eigvalsh(inertia)
    return bool(small > 1e-6 * large and small + middle >= large * (1 - ROUNDING))


def link_ends(offset: Array, tip: Array) -> Array:
    """Link ends (n, 3) [m] in the joint frames; ``offset`` (n, 4, 4), ``tip`` (4, 4)."""
    return np.concatenate([offset[1:, :3, 3], tip[None, :3, 3]])


def plausible_links(
    names: Sequence[str], links: Sequence[SpatialInertia], ends: Array
) -> tuple[list[SpatialInertia], list[str]]:
    """Replace impossible links, with a note each; ``ends`` (n, 3) [m]."""
    reach = float(np.linalg.norm(ends, axis=1).sum())
    if reach == 0.0:
        raise InputError(
            f"the tool lies in the axis of {', '.join(names)}: an arm without reach; give the place of its tip "
            "(tip.position_m in a TOML file, --tip for a model)"
        )
    result, notes = [], []
    mass, usual = sum(link.mass for link in links), sum(_estimate(_thick(end, reach), reach) for end in ends)
    if 0.0 < mass < usual / IMPLAUSIBLE_MASS_RATIO:
        notes.append(
            f"masses: {mass:.3g} kg in all, where solid links of that length have {usual:.3g} kg; is it kilograms? "
            "They decide what the twin's torques mean"
        )
    for name, link, end in zip(names, links, ends, strict=True):
        repaired, problem = _plausible(link, _thick(end, reach), reach)
        result.append(repaired)
        if problem:
            notes.append(f"link after joint {name}: {problem}")
    return result, notes


def _plausible(link: SpatialInertia, end: Array, reach: float) -> tuple[SpatialInertia, str]:
    radius = reach * LINK_RADIUS_RATIO
    estimate = _estimate(end, reach)
    mass, com = link.mass, link.com
    if not estimate / IMPLAUSIBLE_MASS_RATIO**2 < mass < estimate * IMPLAUSIBLE_MASS_RATIO:
        whole = SpatialInertia(mass=estimate, com=end / 2, inertia=cylinder(estimate, end, radius))
        found = "no mass" if mass == 0.0 else f"a mass of {mass:.3g} kg"
        return whole, f"{found}; estimated {estimate:.3g} kg from a solid cylinder along the link"
    problems = []
    if not np.linalg.norm(com) < 2 * reach or (link.doubtful and not com.any()):
        problems.append("no usable centre of mass; put at the middle of the link")
        com = end / 2
    inertia = link.inertia
    cause = "no usable inertia" if link.doubtful or not usable(inertia) else _wrong_size(mass, inertia, reach)
    if cause:
        problems.append(f"{cause}; estimated from a solid cylinder along the link")
        inertia = cylinder(mass, end, radius)
    return SpatialInertia(mass=mass, com=com, inertia=_balanced(inertia)), ", ".join(problems)


def _estimate(end: Array, reach: float) -> float:
    """Mass [kg] of a cylinder along a link; ``reach`` [m]."""
    return float(LINK_DENSITY * np.pi * (reach * LINK_RADIUS_RATIO) ** 2 * np.linalg.norm(end))


def _wrong_size(mass: float, inertia: Array, reach: float) -> str:
    largest = float(np.linalg.eigvalsh(inertia)[-1])
    if largest < _ball_moment(mass, DENSEST):
        return f"an inertia of {largest:.2g} kg m^2, less than {mass:.3g} kg of any metal can have"
    if largest > mass * (reach / 2) ** 2:
        return f"an inertia of {largest:.2g} kg m^2, more than {mass:.3g} kg within the arm's reach can have"
    return ""


def _thick(end: Array, reach: float) -> Array:
    length, least = float(np.linalg.norm(end)), 2 * reach * LINK_RADIUS_RATIO
    if length >= least:
        return end
    return end * (least / length) if length > 1e-9 else np.array([0.0, 0.0, least])


def _balanced(inertia: Array) -> Array:
    moments, axes = np.linalg.eigh(inertia)
    if moments[2] <= moments[0] + moments[1]:
        return inertia
    moments[2] = (moments[0] + moments[1]) * (1 - 1e-9)
    return (axes * moments) @ axes.T


def _ball_moment(mass: float, density: float) -> float:
    return float(0.4 * mass * (3 * mass / (4 * np.pi * density)) ** (2 / 3))


LONGEST_TOOL = 0.5
"""[m] (chosen: longer is in millimetres)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Payload:
    """A point mass in the hand."""

    mass: float
    """[kg]"""
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m] from the bare arm's TCP, in its axes"""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedArm(Arm):
    """An arm with payload or tool."""

    bare: Arm


def bare(arm: Arm) -> Arm:
    """Arm without payload and tool."""
    return arm.bare if isinstance(arm, LoadedArm) else arm


def loaded(arm: Arm, payload: Payload | float | None = None, tool: ArrayLike | None = None) -> Arm:
    """Add a payload (a number: kg at the TCP) and a ``tool`` (3,) [m] in the TCP frame; InputError."""
    carried = payload if isinstance(payload, Payload) else Payload(mass=_mass(0.0 if payload is None else payload))
    if carried.mass == 0.0 and tool is None:
        return arm
    whole = float(arm.mass.sum())
    if not 0.0 <= carried.mass <= whole:
        raise InputError(f"payload: {carried.mass:g} kg, expected 0 to the {whole:.2g} kg of the arm itself")
    com = _lengths("payload: the centre of mass", carried.com)
    tip = arm.tip.copy()
    tip[:3, 3] += tip[:3, :3] @ _lengths("tool", np.zeros(3) if tool is None else tool)
    link = SpatialInertia(mass=float(arm.mass[-1]), com=arm.com[-1], inertia=arm.inertia[-1])
    place = arm.tip[:3, 3] + arm.tip[:3, :3] @ com
    joined = combined([link, SpatialInertia(mass=carried.mass, com=place, inertia=np.zeros((3, 3)))])
    fields = {name: getattr(arm, name) for name in Arm.__dataclass_fields__}
    fields |= {
        "tip": tip,
        "mass": np.append(arm.mass[:-1], joined.mass),
        "com": np.vstack([arm.com[:-1], joined.com]),
        "inertia": np.concatenate([arm.inertia[:-1], joined.inertia[None]]),
    }
    return LoadedArm(**fields, bare=bare(arm))


def _mass(given: ArrayLike) -> float:
    mass = as_floats("payload", given, "a mass in kg, or a Payload")
    if mass.shape != ():
        raise InputError(f"payload: expected a mass in kg, or a Payload, got {given!r}")
    return float(mass)


def _lengths(what: str, given: ArrayLike) -> Array:
    lengths = as_floats(what, given, f"x, y, z of at most {LONGEST_TOOL:g} m")
    if lengths.shape != (3,) or not np.abs(lengths).max() <= LONGEST_TOOL:
        raise InputError(f"{what}: expected x, y, z of at most {LONGEST_TOOL:g} m, got {given!r}")
    return lengths
