"""Learning from repetition: where the same path is run again, what was missed is added to where it is aimed.

Iterative learning control of Arimoto's type, in the space of the tool: aims(s) + a share of the error at s, smoothed
forwards and backwards, so that nothing is late. It works through any controller, and what was learned is a path.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.control.moving.path import Path, path_of

GAIN, LEAST, FADE = 0.7, 0.15, 0.6
"""Share of the first error that is added, the least one later, and the power of the number of times by which it falls
(chosen: a part of every error is another one each time, and would be learned as well; measured on two arms, with 0.5 or
0.8 each time a slow circle gets worse from 0.8 to 1.0 mm)"""
HIGHEST = 3.0
"""[Hz] up to which an error is learned (chosen: beyond, a worn joint does not do what it is told)"""
MOST = 0.02
"""[m] by which an aim may leave the path (chosen)"""
_STEP = 0.02  # [s] between the points of what is learned


def learned(path: Path, aim: Path, time: Array, error: Array, number: int) -> Path:
    """Return what to aim at next time where ``aim`` left errors (T, 3) [m] at ``time`` (T,) [s] on ``path``.

    ``number`` says how often the path was run before this time.
    """
    grid = np.linspace(0.0, path.duration, max(2, round(path.duration / _STEP) + 1))
    missed = np.stack([np.interp(grid, time, error[:, i]) for i in range(3)], axis=-1)
    shift = smooth(aim.at(grid) - path.at(grid) + max(GAIN / (1 + number) ** FADE, LEAST) * missed, grid[1] - grid[0])
    size = np.linalg.norm(shift, axis=-1, keepdims=True)
    place = path.at(grid) + shift * np.minimum(1.0, MOST / np.maximum(size, MOST))
    return path_of(grid, place, path.turn_at(grid), path.name)


def smooth(values: Array, step: float) -> Array:
    """Take frequencies above `HIGHEST` out of ``values`` (T, 3), ``step`` [s] apart, without delay."""
    width = 1.0 / (2.0 * np.pi * HIGHEST * step)
    reach = int(np.ceil(4.0 * width))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, weights / weights.sum(), "valid") for column in padded.T], axis=-1)
