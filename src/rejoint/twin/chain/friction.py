"""Joint friction of a twin: parameters, prior and law (how to add a term: docs/architecture.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Array
from rejoint.twin.declaration import Parameter

if TYPE_CHECKING:
    from rejoint.twin.parameters import TwinParameters

FRICTION = (
    Parameter(name="damping", unit="N m s/rad", meaning="viscous friction and derivative gain together",
              nominal=0.25, sigma=0.8, lower=0.005, upper=20.0, wrist=0.6, healthy=3.2, by_load=True, by_time=1,
              scaled=True,
              # chosen: a servo that follows within 50 ms; damping over stiffness is that lag
              wide={"nominal": 0.8, "sigma": 0.9, "upper": 100.0, "wrist": 1.0, "alike": 0.2}),
    Parameter(name="coulomb", unit="N m", meaning="dry friction",
              nominal=0.08, sigma=0.8, healthy=0.6, lower=0.002, upper=2.0, wrist=0.5, by_load=True, scaled=True,
              # chosen: 0.03 to 1.5 N m within two sigma
              wide={"nominal": 0.2, "sigma": 1.0, "upper": 10.0, "wrist": 1.0}),
    Parameter(name="load_friction", unit="1", meaning="dry friction per torque that the gears pass on",
              nominal=0.0, sigma=1e-4, lower=0.0, upper=2.0, log=False, difference=0.02,
              wide={"sigma": 0.3}),  # chosen: gears take up to half of what they pass on
)  # fmt: skip

DRY = ("coulomb", "load_friction")
"""Parameters of dry friction, besides stiction"""

STRIBECK_SPEED = 0.1
"""[rad/s] at which friction has fallen to kinetic; chosen"""


def friction_terms(twin: TwinParameters, stiction: Array | float) -> Array:
    """Terms (t, ..., n) of `dry_friction`: `DRY`, then ``stiction``."""
    return np.stack([*(getattr(twin, name) for name in DRY), np.broadcast_to(stiction, twin.stiffness_shape)])


def dry_friction(terms: Array, speed: Array, load: Array | float) -> Array:
    """Dry friction (...) [N m] at ``speed`` (...) [rad/s] under ``load`` (...) [N m], from ``terms`` (t, ...).

    Stribeck's law (Stribeck 1902, as in Armstrong-Helouvry et al. 1994), and gears that rub as they are pressed
    (Rhoban/bam); also compiled.
    """
    coulomb, load_friction, stiction = terms[0], terms[1], terms[-1]
    return (coulomb + load_friction * load) * (1.0 + (stiction - 1.0) * np.exp(-((speed / STRIBECK_SPEED) ** 2)))
