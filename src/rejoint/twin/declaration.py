"""Declaration of a twin's parameter with its prior; the time step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

TIMESTEP = 0.005
"""[s] of a twin's physics; chosen: half of it changes predictions by less than an encoder step"""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One row of the table of parameters (`rejoint.twin.parameters.PARAMETERS`)."""

    name: str
    unit: str
    meaning: str
    nominal: float
    """prior median, for `rejoint.twin.parameters.REFERENCE_LOAD` and a joint near the base"""
    sigma: float
    """prior sigma: of the logarithm if `log`, else in `unit`"""
    lower: float
    upper: float
    wide: Mapping[str, float | bool] = field(default_factory=dict)
    """replacements for an arm with known links and masses only"""
    log: bool = True
    """estimated as its logarithm"""
    difference: float = 0.045
    """finite-difference step of a fit, in `unit` unless `log`; chosen: smaller ones measure stick-slip"""
    per_joint: bool = True
    scaled: bool = False
    """torque known only up to the common scale of its joint"""
    wrist: float = 1.0
    """factor on the nominal value for joints with little inertia"""
    alike: float | None = None
    """sigma of the logarithm among joints with servos of one type (`rejoint.arms.Arm.servos`)"""
    by_load: bool = False
    """whether nominal value and bounds scale with the weight of the arm"""
    by_time: int = 0
    """their power of the time of motion under gravity, sqrt(reach)"""
    by_speed: bool = False
    """whether they scale with the arm's speed"""
