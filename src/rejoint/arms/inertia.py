"""Masses and inertias; payload and tool.

A solid cylinder along the link replaces impossible values, with a note.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms.arm import Arm, Array
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_floats, as_place
from rejoint.system.records import entity

LINK_RADIUS_RATIO = 1 / 20
"""Radius of that cylinder over the reach (chosen)"""

LINK_DENSITY = 1000.0
"""[kg/m^3] (chosen)"""

DENSEST = 20000.0
"""[kg/m^3] upper bound (tungsten: 19300)"""

PLACEHOLDER = 1e-4
"""Masses below this share of a solid link count as none (chosen)"""

UNLIKELY = 100.0
"""Factor between the masses of an arm and of solid links that may be a wrong unit (chosen)"""

ROUNDING = 0.05
"""of the triangle inequality (chosen)"""


def pseudo_inertia(mass: float, com: ArrayLike, inertia: Array) -> Array:
    """Second moments (4, 4) of the mass at (x, y, z, 1), of a ``com`` (3,) [m] and ``inertia`` (3, 3) about it.

    Those of bodies add up; in a frame where theirs has the pose T they are T J T' (Wensing, Kim and Slotine 2018).
    """
    moment = np.append(com, 1.0)
    second = mass * np.outer(moment, moment)
    second[:3, :3] += 0.5 * np.trace(inertia) * np.eye(3) - inertia
    return second


def rigid_body(second: Array) -> tuple[float, Array, Array]:
    """Mass [kg], centre (3,) [m], and inertia (3, 3) [kg m^2] about it, of a pseudo-inertia (4, 4)."""
    mass = float(second[3, 3])
    com = second[:3, 3] / (mass or 1.0)
    about = second[:3, :3] - mass * np.outer(com, com)
    return mass, com, np.trace(about) * np.eye(3) - about


def cylinder(mass: float, end: Array, radius: float) -> Array:
    """Inertia (3, 3) [kg m^2] of a cylinder from the origin to ``end`` (3,) [m], about its centre."""
    length = np.linalg.norm(end)
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


def ball_moment(mass: float, density: float = LINK_DENSITY) -> float:
    """Moment of inertia [kg m^2] of a ball."""
    return 0.4 * mass * (3 * mass / (4 * np.pi * density)) ** (2 / 3)


def usable(inertia: Array) -> bool:
    """Whether a symmetric (3, 3) [kg m^2] is possible."""
    if not np.isfinite(inertia).all():
        return False
    small, middle, large = np.linalg.eigvalsh(inertia)
    return bool(small > 1e-6 * large and small + middle >= large * (1 - ROUNDING))


def link_ends(arm: Arm) -> Array:
    """Link ends (n, 3) [m] in the joint frames."""
    return np.concatenate([arm.offset[1:, :3, 3], arm.tip[None, :3, 3]])


def plausible(arm: Arm, notes: list[str]) -> Arm:
    """Estimate absent masses and impossible inertias, with a note each; an inertia of NaN is unknown."""
    ends = link_ends(arm)
    lengths = np.linalg.norm(ends, axis=1)
    reach = lengths.sum()
    if reach == 0.0:
        raise InputError(
            f"the tool lies in the axis of {', '.join(arm.joint_names)}: an arm without reach; give the place of its "
            "tip (tip.position_m in a TOML file, --tip for a model)"
        )
    radius = reach * LINK_RADIUS_RATIO
    least = 2 * radius  # of a link that is a cylinder
    pointed = np.where(lengths[:, None] > 1e-9, ends, [0.0, 0.0, least])
    ends = pointed * np.maximum(1.0, least / np.linalg.norm(pointed, axis=1))[:, None]
    solid = LINK_DENSITY * np.pi * radius**2 * np.linalg.norm(ends, axis=1)
    whole, usual = arm.mass.sum(), solid.sum()
    if whole and not usual / UNLIKELY < whole < usual * UNLIKELY:
        notes.append(
            f"masses: {whole:.3g} kg in all, where solid links of that length have {usual:.3g} kg; is it kilograms? "
            "They decide what the twin's torques mean"
        )
    mass, com, inertia = arm.mass.copy(), arm.com.copy(), arm.inertia.copy()
    for i, (name, end) in enumerate(zip(arm.joint_names, ends, strict=True)):
        wrong = []
        if not PLACEHOLDER * solid[i] < mass[i] < np.inf:
            wrong.append(f"a mass of {mass[i]:.3g} kg" if mass[i] else "no mass")
            mass[i], com[i], inertia[i] = solid[i], end / 2, cylinder(solid[i], end, radius)
        elif not np.linalg.norm(com[i]) < 2 * reach or (np.isnan(inertia[i]).any() and not com[i].any()):
            wrong.append("no usable centre of mass")
            com[i] = end / 2
        impossible = _wrong_inertia(mass[i], inertia[i], reach)
        if impossible:
            wrong.append(impossible)
            inertia[i] = cylinder(mass[i], end, radius)
        inertia[i] = _balanced(inertia[i])
        if wrong:
            solids = f"a solid cylinder of {mass[i]:.3g} kg along the link"
            notes.append(f"link after joint {name}: {', '.join(wrong)}; estimated from {solids}")
    return replace(arm, mass=mass, com=com, inertia=inertia)


def _wrong_inertia(mass: float, inertia: Array, reach: float) -> str:
    if not usable(inertia):
        return "no usable inertia"
    largest = np.linalg.eigvalsh(inertia)[-1]
    if ball_moment(mass, DENSEST) <= largest <= mass * (reach / 2) ** 2:
        return ""
    return f"an inertia of {largest:.2g} kg m^2, which {mass:.3g} kg of metal within the arm's reach cannot have"


def _balanced(inertia: Array) -> Array:
    moments, axes = np.linalg.eigh(inertia)
    if moments[2] <= moments[0] + moments[1]:
        return inertia
    moments[2] = (moments[0] + moments[1]) * (1 - 1e-9)
    return (axes * moments) @ axes.T


LONGEST_TOOL = 0.5
"""[m] (chosen: longer is in millimetres)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Payload:
    """A point mass in the hand."""

    mass: float
    """[kg]"""
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m] from the bare arm's TCP, in its axes"""

    def __post_init__(self) -> None:
        mass = as_floats("payload", self.mass, "a mass in kg, or a Payload")
        if mass.shape or not 0.0 <= mass < np.inf:
            raise InputError(f"payload: expected a mass in kg, got {self.mass}")
        object.__setattr__(self, "mass", float(mass))


@entity
class LoadedArm(Arm):
    """An arm with payload or tool."""

    bare: Arm


def bare(arm: Arm) -> Arm:
    """Arm without payload and tool."""
    return arm.bare if isinstance(arm, LoadedArm) else arm


def loaded(arm: Arm, payload: Payload | float | None = None, tool: ArrayLike | None = None) -> Arm:
    """Add a payload (a number: kg at the TCP) and a ``tool`` (3,) [m] in the TCP frame; InputError."""
    load = payload if isinstance(payload, Payload) else Payload(mass=0.0 if payload is None else payload)
    if tool is None and load.mass == 0.0:
        return arm
    if load.mass > (whole := arm.mass.sum()):
        raise InputError(f"payload: {load.mass:g} kg, expected 0 to the {whole:.2g} kg of the arm itself")
    com = as_place("payload: the centre of mass", load.com, most=LONGEST_TOOL)
    tip = arm.tip.copy()
    tip[:3, 3] += tip[:3, :3] @ as_place("tool", np.zeros(3) if tool is None else tool, most=LONGEST_TOOL)
    place = arm.tip[:3, 3] + arm.tip[:3, :3] @ com
    return LoadedArm(**vars(arm) | {"bare": bare(arm), "tip": tip} | heavier(arm, load.mass, place))


def heavier(arm: Arm, mass: float, place: Array) -> dict[str, Any]:
    """Masses of an arm with one more at a ``place`` (3,) [m] of its last link."""
    link = pseudo_inertia(arm.mass[-1], arm.com[-1], arm.inertia[-1]) + pseudo_inertia(mass, place, np.zeros((3, 3)))
    values = zip(("mass", "com", "inertia"), rigid_body(link), strict=True)
    return {name: np.concatenate([getattr(arm, name)[:-1], [value]]) for name, value in values}
