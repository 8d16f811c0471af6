"""What is believed of an arm of which only links and masses are known: much wider than of a worn myCobot.

Logs from elsewhere say little about the arm that made them. So every range spans what is on the market,
from hobby servos to geared industrial joints, in units of the arm's own gravity load. The ranges only
have to contain the truth: a prior of a factor of 2.5 weighs less than a second of motion.
"""

from __future__ import annotations

from dataclasses import replace

from rejoint.arms import Arm
from rejoint.twin.declaration import Parameter
from rejoint.twin.parameters import PARAMETERS, Prior, prior

UNKNOWN_PARAMETERS: tuple[Parameter, ...] = tuple(replace(p, **p.wide) for p in PARAMETERS)  # type: ignore[arg-type]
"""The table of parameters with the ranges of an unknown arm."""


def unknown_prior(arm: Arm) -> Prior:
    """Prior of an arm of which nothing is known but its URDF or MJCF."""
    return prior(arm, UNKNOWN_PARAMETERS)
