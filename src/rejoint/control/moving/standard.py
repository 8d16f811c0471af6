"""Standard paths: circles and random ways, on which arms and controllers are compared."""

from __future__ import annotations

import re

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.size import length_size
from rejoint.control.moving.path import Path
from rejoint.system.errors import InputError

STANDARD = ("circle-20s", "circle-8s", "circle-4s", "random-0.2hz", "random-0.5hz")
"""Those of the comparison"""
RADIUS = 0.040
"""[m] of the circle of an arm of a myCobot's size; goes with the reach"""
EASE = 1.0
"""[s] in which a standard path gets going and comes to rest (chosen)"""
LENGTH = 20.0
"""[s] of a random path; a circle is repeated up to about as long (chosen)"""
_SINES, _FILL = 5, 0.7
"""waves of each coordinate of a random path, and the share of the target region that they fill (chosen: at 0.5 Hz the
tool then moves at 70 mm/s)"""
_STEP = 0.02  # [s] between the points
_NAME = re.compile(r"(circle)-(\d+(?:\.\d+)?)s|(random)-(\d+(?:\.\d+)?)hz")


def is_standard(name: str) -> bool:
    """Tell the name of a standard path from that of a file."""
    return _NAME.fullmatch(name) is not None


def standard_path(name: str, arm: Arm, seed: int = 0) -> Path:
    """Make the path called ``circle-Ts``, once round in T seconds, or ``random-Fhz``, of waves up to F hertz.

    It lies inside the target region of the arm, and begins and ends at rest. InputError for another name.
    """
    found = _NAME.fullmatch(name)
    if found is None:
        raise InputError(f"no path is called {name!r}; standard paths: {', '.join(STANDARD)}, or give a CSV file")
    value = float(found[2] or found[4])
    if not 0.05 <= value <= 600.0:
        raise InputError(f"path {name}: expected between 0.05 and 600")
    middle = (arm.targets.lower + arm.targets.upper) / 2
    if found[1]:
        laps = max(1, round(LENGTH / value))
        time, phase = _phase(laps * value)
        angle = 2.0 * np.pi * phase / value
        radius = RADIUS * length_size(arm)
        return Path(
            time=time, name=name,
            place=middle + radius * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1),
        )  # fmt: skip
    time, phase = _phase(LENGTH)
    waves = _waves(value, phase, seed)
    half = _FILL * (arm.targets.upper - arm.targets.lower) / 2
    return Path(time=time, place=middle + half * waves / np.abs(waves).max(axis=0), name=name)


def _phase(length: float) -> tuple[Array, Array]:
    """Return times (T,), and how far (T,) [s] of ``length`` [s] one that starts and ends at rest has come."""
    duration = length + EASE
    time = np.linspace(0.0, duration, round(duration / _STEP) + 1)
    return time, _rising(time) - _rising(time - length)


def _rising(time: Array) -> Array:
    """Integral of a speed that rises smoothly from 0 to 1 within `EASE`."""
    share = np.clip(time / EASE, 0.0, 1.0)
    return EASE * (share**3 - share**4 / 2) + np.maximum(time - EASE, 0.0)


def _waves(highest: float, time: Array, seed: int) -> Array:
    rng = np.random.default_rng([seed, round(1e3 * highest)])
    frequency = highest * rng.uniform(0.25, 1.0, (3, _SINES))
    start, size = rng.uniform(0.0, 2.0 * np.pi, (3, _SINES)), rng.uniform(0.5, 1.0, (3, _SINES))
    return (size * np.sin(2.0 * np.pi * frequency * time[:, None, None] + start)).sum(axis=-1)
