"""An arm with what its owner says of its hand: a payload, and a tool whose tip is elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms.arm import Arm, Array
from rejoint.arms.inertia import SpatialInertia, combined
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_floats

LONGEST_TOOL = 0.5
"""[m] (chosen: longer is a number in millimetres)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Payload:
    """What a hand carries, as a point mass."""

    mass: float
    """[kg]"""
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m] centre of mass from the tool centre point of the bare arm, along the axes of its frame"""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedArm(Arm):
    """An arm with a told load or tool: what is computed of the bare one, a policy say, goes for it as well."""

    bare: Arm


def bare(arm: Arm) -> Arm:
    """Return the arm without what was told of its hand."""
    return arm.bare if isinstance(arm, LoadedArm) else arm


def loaded(arm: Arm, payload: Payload | float | None = None, tool: ArrayLike | None = None) -> Arm:
    """Return ``arm`` with a payload (a number is a mass [kg] at its TCP), and its TCP moved by ``tool`` (3,) [m].

    The tool is given in the frame of the bare arm's TCP. Without either, ``arm`` itself. InputError for a mass or
    length that no such arm carries.
    """
    carried = payload if payload is None or isinstance(payload, Payload) else Payload(mass=_mass(payload))
    if (carried is None or carried.mass == 0.0) and tool is None:
        return arm
    carried = carried or Payload(mass=0.0)
    whole = float(arm.mass.sum())
    if not 0.0 <= carried.mass <= whole:
        raise InputError(f"payload: {carried.mass:g} kg, expected 0 to the {whole:.2g} kg of the arm itself")
    com = _lengths("payload: the centre of mass", carried.com)
    tip = arm.tip.copy()
    if tool is not None:
        tip[:3, 3] += tip[:3, :3] @ _lengths("tool", tool)
    link = SpatialInertia(mass=float(arm.mass[-1]), com=arm.com[-1], inertia=arm.inertia[-1])
    place = arm.tip[:3, 3] + arm.tip[:3, :3] @ com
    joined = combined([link, SpatialInertia(mass=carried.mass, com=place, inertia=np.zeros((3, 3)))])
    fields = {name: getattr(arm, name) for name in Arm.__dataclass_fields__}
    found = LoadedArm(**fields, bare=bare(arm))
    return replace(
        found, tip=tip, mass=np.append(arm.mass[:-1], joined.mass), com=np.vstack([arm.com[:-1], joined.com]),
        inertia=np.concatenate([arm.inertia[:-1], joined.inertia[None]]),
    )  # fmt: skip


def _mass(given: ArrayLike) -> float:
    mass = as_floats("payload", given, "a mass in kg, or a Payload")
    if mass.shape != ():
        raise InputError(f"payload: expected a mass in kg, or a Payload, got {given!r}")
    return float(mass)


def _lengths(what: str, given: ArrayLike) -> Array:
    lengths = as_floats(what, given, f"x, y, z of at most {LONGEST_TOOL:g} m")
    if (
        lengths.shape != (3,)
        or not np.abs(lengths).max(initial=np.inf if lengths.shape != (3,) else 0.0) <= LONGEST_TOOL
    ):
        raise InputError(f"{what}: expected x, y, z of at most {LONGEST_TOOL:g} m, got {given!r}")
    return lengths
