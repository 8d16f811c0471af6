"""Masses and inertias of links: lumping bodies, judging what a file says, estimating what it does not.

Many published models carry no inertias, zeros, or placeholders (a kilogram and a kg m^2 for each
link). A number that no piece of matter can have is replaced by that of a solid cylinder along the
link, and named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms.arm import Array
from rejoint.system.errors import InputError

LINK_RADIUS_RATIO = 1 / 20
"""Radius of the estimating cylinder by the summed link lengths (chosen: 26 mm for a myCobot 280, 63 mm for a UR5,
70 mm for a Panda, as their housings are)"""

LINK_DENSITY = 1000.0
"""[kg/m^3] of the estimating cylinder (chosen: motors and aluminium with hollow space; within a factor of two of the
masses that Universal Robots publishes for the UR5)"""

DENSEST = 20000.0
"""[kg/m^3] no link is denser (tungsten has 19300): bounds inertia from below, since among all bodies of a mass and
a largest density the ball has the smallest moments"""

IMPLAUSIBLE_MASS_RATIO = 100.0
"""a mass this many times the estimate, or below its inverse square, is taken for a placeholder (chosen)"""

ROUNDING = 0.05
"""relative violation of the triangle inequality that printing few digits explains (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class SpatialInertia:
    """Mass, centre of mass and inertia of one rigid piece, in any one frame."""

    mass: float
    """[kg]"""
    com: Array
    """(3,) [m]"""
    inertia: Array
    """(3, 3) [kg m^2] about the centre of mass"""
    doubtful: bool = False
    """whether the inertia was not usable and more than half of the mass is without one"""

    def seen_from(self, pose: Array) -> SpatialInertia:
        """Express the piece, given in the frame ``pose`` (4, 4), in the frame that the pose is given in."""
        turn = pose[:3, :3]
        return SpatialInertia(
            mass=self.mass,
            com=turn @ self.com + pose[:3, 3],
            inertia=turn @ self.inertia @ turn.T,
            doubtful=self.doubtful,
        )


NOTHING = SpatialInertia(mass=0.0, com=np.zeros(3), inertia=np.zeros((3, 3)))


def combined(pieces: Sequence[SpatialInertia]) -> SpatialInertia:
    """Join rigidly connected pieces given in one frame (parallel-axis theorem)."""
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
    """Inertia (3, 3) [kg m^2] about its centre of a solid cylinder from the origin to ``end`` (3,) [m]."""
    length = float(np.linalg.norm(end))
    along = end / length
    axial, lateral = mass * radius**2 / 2, mass * (3 * radius**2 + length**2) / 12
    return lateral * np.eye(3) + (axial - lateral) * np.outer(along, along)


def inertia_matrix(values: Sequence[float] | Array) -> Array:
    """Build an inertia (3, 3) from its six values in the order xx, yy, zz, xy, xz, yz (MuJoCo's ``fullinertia``)."""
    xx, yy, zz, xy, xz, yz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_values(inertia: Array) -> Array:
    """Give the six values (6,) of an inertia (3, 3) in the order of :func:`inertia_matrix`."""
    return inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def ball(mass: float) -> Array:
    """Inertia (3, 3) [kg m^2] of a ball of the estimating density, for a side piece without an inertia."""
    return _ball_moment(mass, LINK_DENSITY) * np.eye(3)


def ball_radius(mass: float) -> float:
    """Radius [m] of that ball."""
    return float((3 * mass / (4 * np.pi * LINK_DENSITY)) ** (1 / 3))


def usable(inertia: Array) -> bool:
    """Tell whether (3, 3) [kg m^2] can belong to any rigid body: positive, and no moment above the other two's sum."""
    if not np.isfinite(inertia).all() or not np.abs(inertia - inertia.T).max() <= 1e-6 * np.abs(inertia).max():
        return False
    small, middle, large = np.linalg.eigvalsh(inertia)
    return bool(small > 1e-6 * large and small + middle >= large * (1 - ROUNDING))


def link_ends(offset: Array, tip: Array) -> Array:
    """Where each link meets the next: (n, 3) [m] in the joint frames, from ``offset`` (n, 4, 4) and ``tip`` (4, 4)."""
    return np.concatenate([offset[1:, :3, 3], tip[None, :3, 3]])


def plausible_links(
    names: Sequence[str], links: Sequence[SpatialInertia], ends: Array
) -> tuple[list[SpatialInertia], list[str]]:
    """Replace what no link of such an arm can have; returns the links and a note for each replacement.

    ``ends`` is (n, 3) [m], see :func:`link_ends`; ``names`` are what the notes call the links.
    """
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
    """Mass [kg] of a solid cylinder along a link of an arm of that reach [m]."""
    return float(LINK_DENSITY * np.pi * (reach * LINK_RADIUS_RATIO) ** 2 * np.linalg.norm(end))


def _wrong_size(mass: float, inertia: Array, reach: float) -> str:
    largest = float(np.linalg.eigvalsh(inertia)[-1])
    if largest < _ball_moment(mass, DENSEST):
        return f"an inertia of {largest:.2g} kg m^2, less than {mass:.3g} kg of any metal can have"
    if largest > mass * (reach / 2) ** 2:
        return f"an inertia of {largest:.2g} kg m^2, more than {mass:.3g} kg within the arm's reach can have"
    return ""


def _thick(end: Array, reach: float) -> Array:
    """Lengthen a link whose joints (nearly) meet in one point to the thickness of its housing."""
    length, least = float(np.linalg.norm(end)), 2 * reach * LINK_RADIUS_RATIO
    if length >= least:
        return end
    return end * (least / length) if length > 1e-9 else np.array([0.0, 0.0, least])


def _balanced(inertia: Array) -> Array:
    """Cut the largest moment to the sum of the others, where rounding in a file has left it above."""
    moments, axes = np.linalg.eigh(inertia)
    if moments[2] <= moments[0] + moments[1]:
        return inertia
    moments[2] = (moments[0] + moments[1]) * (1 - 1e-9)
    return (axes * moments) @ axes.T


def _ball_moment(mass: float, density: float) -> float:
    return float(0.4 * mass * (3 * mass / (4 * np.pi * density)) ** (2 / 3))
