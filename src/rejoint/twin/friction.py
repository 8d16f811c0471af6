"""Friction in the joints of a twin: the law, its parameters, and what is believed of them before any data.

Viscous friction is MuJoCo's own (`rejoint.twin.model`). Dry friction is a bound that depends on the speed, and is set
before every step of the physics (`rejoint.twin.simulation`). docs/architecture.md tells how to add a term.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Array

if TYPE_CHECKING:
    from rejoint.twin.parameters import TwinParameters

STRIBECK_SPEED = 0.1
"""[rad/s] at which friction has fallen to that of motion (chosen: two encoder steps in a control period)"""

DRY = ("coulomb",)
"""Parameters of dry friction; its ratio at rest to that in motion, the stiction, is no element of the vector"""


def dry_friction(terms: Array, speed: Array) -> Array:
    """Dry friction (...) [N m] at a joint's ``speed`` (...) [rad/s], from the ``terms`` (t, ...) of `friction_terms`.

    Stribeck's law (Stribeck 1902, as in Armstrong-Helouvry et al. 1994). Plain arithmetic, which is also compiled.
    """
    coulomb, stiction = terms[0], terms[1]
    return coulomb * (1.0 + (stiction - 1.0) * np.exp(-((speed / STRIBECK_SPEED) ** 2)))


def friction_terms(twin: TwinParameters, stiction: Array | float) -> Array:
    """Return what `dry_friction` takes (t, ..., n), from a twin and its ``stiction``, a number or (..., n)."""
    return np.stack([*(getattr(twin, name) for name in DRY), np.broadcast_to(stiction, twin.stiffness_shape)])


def is_steady(terms: Array) -> bool:
    """Tell whether dry friction is the same at every speed: then nothing has to be set before each step."""
    return bool((terms[1] == 1.0).all())
