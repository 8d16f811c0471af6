"""What is believed of an arm of which only links and masses are known: much wider than of a worn myCobot.

Logs from elsewhere say little about the arm that made them. So every range spans what is on the market,
from hobby servos to geared industrial joints, in units of the arm's own gravity load. The ranges only
have to contain the truth: a prior of a factor of 2.5 weighs less than a second of motion.
"""

from __future__ import annotations

from dataclasses import replace

from rejoint.arms import Arm
from rejoint.twin.parameters import PARAMETERS, Parameter, Prior, prior

_NOMINAL: dict[str, dict[str, float]] = {
    # chosen: geometric middle of worn (7) and healthy (35 N m/rad) hobby servos; stiffer ones within three sigma
    "stiffness": {"nominal": 16.0, "sigma": 0.9, "upper": 1000.0, "wrist": 1.0},
    # chosen: a servo that follows within 50 ms; damping over stiffness is that lag
    "damping": {"nominal": 0.8, "sigma": 0.9, "upper": 100.0, "wrist": 1.0},
    "coulomb": {"nominal": 0.2, "sigma": 1.0, "upper": 10.0, "wrist": 1.0},
    # measured: 0.01 to 0.03 kg m^2 for geared hobby servos
    "armature": {"nominal": 0.015, "sigma": 1.0, "lower": 5e-4, "upper": 1.0},
    # chosen: twice and more what the arm weighs, or nobody would have recorded it moving
    "torque_limit": {"nominal": 3.0, "sigma": 0.7, "upper": 50.0, "wrist": 1.0},
    "offset": {"sigma": 0.02, "lower": -0.2, "upper": 0.2},
    # chosen: a bus servo answers within a few periods; below zero where a position is read up to a period of 20 ms
    # later than its row is stamped
    "delay": {"nominal": 0.01, "sigma": 0.015, "lower": -0.02, "upper": 0.2},
    # chosen: faster than most motions, so that a ramp must show itself in the data
    "ramp_speed": {"nominal": 8.0, "sigma": 0.7, "upper": 50.0, "by_speed": False},
}

UNKNOWN_PARAMETERS: tuple[Parameter, ...] = tuple(replace(p, **_NOMINAL[p.name]) for p in PARAMETERS)  # type: ignore[arg-type]
"""The table of parameters with the ranges of an unknown arm."""


def unknown_prior(arm: Arm) -> Prior:
    """Prior of an arm of which nothing is known but its URDF or MJCF."""
    return prior(arm, UNKNOWN_PARAMETERS)
