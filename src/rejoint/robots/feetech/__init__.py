"""Arms on Feetech's servos: their addresses, and the servos' position loop.

Duty: P / 4 per mille per count beyond the dead zone, plus the startup force.
"""

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Array
from rejoint.control.servogains import ServoGains
from rejoint.robots.knobs import ServoAddress, ServoKind
from rejoint.system.files import read_shipped

KIND = read_shipped(__file__, "servo.toml", ServoKind)

FULL = 1000.0
"""Duty of full PWM"""


class FeetechAddress(ServoAddress):
    """A bus of Feetech servos."""

    kind = KIND


def torque_share(gains: ServoGains, duty: ArrayLike, error: ArrayLike) -> Array:
    """Shares (..., n) of the largest torque, -1 to 1, of ``duty`` [0.1 %] at ``error`` [counts] under ``gains``."""
    p, startup, above, below = (np.array(gains[name]) for name in ("p", "startup", "dead_cw", "dead_ccw"))
    size = np.abs(duty) - startup
    within = np.clip(error, -below, above) * p / 4 / FULL
    beyond = np.minimum((size + np.where(np.greater(duty, 0), above, below) * p / 4) / FULL, 1.0)
    return np.where(size > 0, np.copysign(beyond, duty), within)
