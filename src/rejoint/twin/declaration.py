"""Declaration of a twin's parameter; the time step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

TIMESTEP = 0.005
"""[s]; chosen: half of it changes predictions by less than an encoder step"""


@dataclass(frozen=True, kw_only=True)
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
    """of a servo without wear, over the median: chosen from the data sheet, as 35 N m/rad of an STS3215 under load
    (SO-ARM100, issue 134)"""
    log: bool = True
    """estimated as its logarithm"""
    difference: float = 0.045
    """finite-difference step, in `unit` unless `log`; chosen"""
    fitted: bool = True
    """whether a descent may change it"""
    per_joint: bool = True
    scaled: bool = False
    """torque known up to its joint's common scale"""
    wrist: float = 1.0
    """factor for wrist joints"""
    alike: float | None = None
    """sigma of the logarithm among equal servos (`rejoint.arms.Arm.servos`)"""
    by_load: bool = False
    """nominal value and bounds scale with the arm's weight"""
    by_time: int = 0
    """their power of sqrt(reach)"""
    by_speed: bool = False
    """they scale with the arm's speed"""
