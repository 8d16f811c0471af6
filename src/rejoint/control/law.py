"""The pieces that control laws are made of; deployed controllers and the training share them.

The base law is equation 17 of Park et al. 2024 with its theta_t read as the last command:
``c_t = c_{t-1} + GAIN * step``, with the damped least-squares step of `dls_step`, then `limit_lead`
and the joint limits. Adding to the measured position instead would forget the sag that a soft
servo needs the command to lead by.

How much time passed between two decisions of a controller: real wires and processors jitter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, clip_norm, dls
from rejoint.arms.rotations import Orientation, task
from rejoint.control.robot import Mask

GAIN = 0.1
"""Fraction of the step that is added to the command per control cycle (chosen: 0.2 already oscillates on worn arms)."""

STEP_LIMIT = np.radians(5.0)
"""[rad] largest joint change asked for by one step; Park et al. 2024, section IV-D, give 0.5 to 5 degrees a frame."""

PROJECTION_DAMPING = 1e-4
"""[m] keeps the null-space projection finite at singular postures (chosen: far below the working damping)."""


class DlsStep(NamedTuple):
    """What the kinematics say about one cycle."""

    step: Array
    """(..., n) [rad] damped least-squares step towards the target, scaled down as a whole to STEP_LIMIT"""
    error: Array
    """(..., k) [m] target minus measured TCP (encoder kinematics), and with an orientation what is missed of that"""
    jacobian: Array
    """(..., k, n) [m/rad] d(TCP)/dq at the measured position, see `rejoint.arms.rotations.task`"""


def dls_step(arm: Arm, measured: Array, target: Array, turn: Orientation | None = None) -> DlsStep:
    """Step from joint positions ``measured`` (..., n) [rad] towards ``target`` (..., 3) [m], turned as in ``turn``."""
    error, jacobian = task(arm, measured, target, turn)
    return DlsStep(clip_norm(dls(jacobian, error), STEP_LIMIT), error, jacobian)


def fade(error: Array, distance: float) -> Array:
    """Factor |e| / (|e| + distance) in [0, 1), shape (..., 1), for TCP errors (..., 3) [m].

    An integrator hunts against stiction: the command creeps until the joint breaks loose and jumps
    over the target. Steps that fade near the target make the jumps rare and small, and unlike a
    dead zone they leave no lasting error.
    """
    size = np.sqrt((error**2).sum(axis=-1, keepdims=True))
    return size / (size + distance)


def between(values: Array, low: Array | float, high: Array | float) -> Array:
    """Clip to [low, high]; a third of what `numpy.clip` costs for a single arm."""
    limited: Array = np.minimum(np.maximum(values, low), high)
    return limited


def plain(array: Array) -> Array:
    """Return the array as compiled loops know it: contiguous, of float64; itself where it is that already."""
    return np.ascontiguousarray(array, dtype=float)


def limit_lead(command: Array, measured: Array, lead: float | Array) -> Array:
    """Keep ``command`` (..., n) [rad] within ``lead`` [rad] of the measured position, joint by joint (anti-windup)."""
    return between(command, measured - lead, measured + lead)


def limit_position(arm: Arm, command: Array) -> Array:
    """Keep ``command`` (..., n) [rad] inside the joint limits."""
    return between(command, arm.lower, arm.upper)


def null_space(jacobian: Array, motion: Array) -> Array:
    """Part of a joint motion (..., n) [rad] that leaves the TCP where it is, to first order."""
    moved = (jacobian @ motion[..., None])[..., 0]
    return motion - dls(jacobian, moved, PROJECTION_DAMPING)


NOMINAL_PERIOD = 0.025
"""[s] assumed before a period has been measured (chosen: middle of the usual 20 to 30 ms)."""

LONGEST_PERIOD = 0.1
"""[s] a longer pause counts as this (chosen: what happened meanwhile is unknown)."""


class Pace:
    """Measures the periods of B arms on their own clocks."""

    def __init__(self) -> None:
        self.last: Array = np.zeros(0)
        """(B,) [s] times of the last joint states"""

    def tick(self, time: Array) -> Array:
        """Return the time (B,) [s] since the last call; ``time`` (B,) [s] is that of the joint state.

        0 where the joint state is the last one again, since it says nothing new.
        """
        if len(self.last) != len(time):
            elapsed = np.full(len(time), NOMINAL_PERIOD)
        else:
            elapsed = between(time - self.last, 0.0, LONGEST_PERIOD)
        self.last = time.copy()
        return elapsed

    def begin(self, time: Array, where: Mask) -> None:
        """Start again at ``time`` (B,) [s] for the arms in ``where`` (B,)."""
        self.last = np.where(where, time, self.last) if len(self.last) == len(time) else time.copy()
