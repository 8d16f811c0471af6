"""How a parameter of a twin is declared, with its prior; and the time step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

TIMESTEP = 0.005
"""[s] of a twin's physics (chosen: half of it changes predictions by less than an encoder step)"""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One row of the table of parameters (`rejoint.twin.parameters.PARAMETERS`)."""

    name: str
    unit: str
    meaning: str
    nominal: float
    """prior median, for an arm of `rejoint.twin.parameters.REFERENCE_LOAD` and a joint near the base"""
    sigma: float
    """prior standard deviation: of the logarithm if `log`, else in `unit`"""
    lower: float
    upper: float
    wide: Mapping[str, float | bool] = field(default_factory=dict)
    """what replaces these, and what follows, for an arm of which only links and masses are known"""
    log: bool = True
    """positive quantity, estimated as its logarithm"""
    difference: float = 0.045
    """finite-difference step of a fit, in `unit` unless `log` (chosen: smaller ones measure stick-slip)"""
    per_joint: bool = True
    scaled: bool = False
    """torque that is known only up to the common scale of its joint"""
    wrist: float = 1.0
    """factor on the nominal value for joints with little inertia"""
    alike: float | None = None
    """standard deviation of the logarithm among joints with servos of one type (`rejoint.arms.Arm.servos`); or None"""
    by_load: bool = False
    """whether nominal value and bounds grow with the weight of the arm"""
    by_time: int = 0
    """their power of the time of motion under gravity, the square root of the reach"""
    by_speed: bool = False
    """whether they grow with the arm's speed"""
