"""Parts of control laws.

Base law: Park et al. 2024, equation 17, with theta_t read as the last command: ``c_t = c_{t-1} + GAIN * step``, then
`limit_lead` and joint limits. A measured theta_t would lose the following error that a soft servo needs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, clip_norm, dls
from rejoint.arms.rotations import Orientation, task
from rejoint.control.robot import Mask

GAIN = 0.1
"""Share of the step per cycle (chosen: 0.2 oscillates on worn arms)"""

STEP_LIMIT = np.radians(5.0)
"""[rad] per joint; Park et al. 2024, section IV-D: 0.5 to 5 degrees"""

PROJECTION_DAMPING = 1e-4
"""[m] of the null-space projection (chosen)"""


class DlsStep(NamedTuple):
    """Damped least-squares step."""

    step: Array
    """(..., n) [rad], scaled down to STEP_LIMIT"""
    error: Array
    """(..., k) [m] target minus measured TCP, then the orientation's"""
    jacobian: Array
    """(..., k, n) [m/rad], see `rejoint.arms.rotations.task`"""


def dls_step(arm: Arm, measured: Array, target: Array, turn: Orientation | None = None) -> DlsStep:
    """Step from ``measured`` (..., n) [rad] towards ``target`` (..., 3) [m], turned as in ``turn``."""
    error, jacobian = task(arm, measured, target, turn)
    return DlsStep(clip_norm(dls(jacobian, error), STEP_LIMIT), error, jacobian)


def fade(error: Array, distance: float) -> Array:
    """Factor |e| / (|e| + distance), (..., 1), for TCP errors (..., 3) [m]: against hunting under stiction."""
    size = np.sqrt((error**2).sum(axis=-1, keepdims=True))
    return size / (size + distance)


def between(values: Array, low: Array | float, high: Array | float) -> Array:
    """Clip to [low, high]; faster than `numpy.clip` for small arrays."""
    limited: Array = np.minimum(np.maximum(values, low), high)
    return limited


def limit_lead(command: Array, measured: Array, lead: float | Array) -> Array:
    """Keep ``command`` (..., n) [rad] within ``lead`` [rad] of the measured position (anti-windup)."""
    return between(command, measured - lead, measured + lead)


def limit_position(arm: Arm, command: Array) -> Array:
    """Keep ``command`` (..., n) [rad] inside the joint limits."""
    return between(command, arm.lower, arm.upper)


def null_space(jacobian: Array, motion: Array) -> Array:
    """Part of a joint motion (..., n) [rad] that does not move the TCP, to first order."""
    moved = (jacobian @ motion[..., None])[..., 0]
    return motion - dls(jacobian, moved, PROJECTION_DAMPING)


NOMINAL_PERIOD = 0.025
"""[s] before a measurement (chosen: 20 to 30 ms)"""

LONGEST_PERIOD = 0.1
"""[s] (chosen)"""


class Pace:
    """Measures the periods of B arms."""

    def __init__(self) -> None:
        self.last: Array = np.zeros(0)
        """(B,) [s]"""

    def tick(self, time: Array) -> Array:
        """Period (B,) [s] before ``time`` (B,) [s] of joint states; 0 for an old state."""
        if len(self.last) != len(time):
            elapsed = np.full(len(time), NOMINAL_PERIOD)
        else:
            elapsed = between(time - self.last, 0.0, LONGEST_PERIOD)
        self.last = time.copy()
        return elapsed

    def begin(self, time: Array, where: Mask) -> None:
        """Restart at ``time`` (B,) [s] where ``where`` (B,)."""
        self.last = np.where(where, time, self.last) if len(self.last) == len(time) else time.copy()
