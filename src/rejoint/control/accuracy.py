"""A true error, how far the tool itself is from its target, and how that is known.

It is never mixed up with the encoder error, which is a plain number: a true error always tells where it comes from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from rejoint.arms import Array
from rejoint.system.statistics import Estimate

How = Literal["known", "measured", "modelled", "not known"]

REMEDY = "not known: calibrate"
"""What stands where a true error would"""


class ToolModel(Protocol):
    """Tells how far the tool of an arm is from a target without seeing it, as a `Calibration` does."""

    def expected(self, position: Array, target: Array) -> Array:
        """Mean (...) [m] of the distance from ``target`` (..., 3) [m] at ``position`` (..., n) [rad]."""

    def interval(self, position: Array, target: Array) -> tuple[Array, Array]:
        """95 % interval (...), (...) [m] of the same."""


@dataclass(frozen=True, kw_only=True)
class TrueError:
    """Distance of the tool itself from its target; without a value nobody knows it."""

    how: How = "not known"
    """``known``: an emulated arm tells; ``measured``: from outside; ``modelled``: by a calibration of the arm"""
    value: float | None = None
    """[m]"""
    low: float | None = None
    """[m] lower end of its 95 % interval; None where there is none"""
    high: float | None = None
    """[m] upper end"""

    @classmethod
    def of(cls, how: How, estimate: Estimate, unit: float = 1.0) -> TrueError:
        """Return an estimate in units of ``unit`` [m] as a true error."""
        ends = (None if end is None else unit * end for end in (estimate.low, estimate.high))
        low, high = ends
        return cls(how=how, value=unit * estimate.value, low=low, high=high)

    def __str__(self) -> str:
        """Say it in millimetres, with how it is known."""
        if self.value is None:
            return REMEDY
        return f"{self.millimetres} mm, {self.how}{f' ({self.range})' if self.range else ''}"

    @property
    def millimetres(self) -> str:
        """The value in millimetres, with two decimals below one; empty where it is not known."""
        return "" if self.value is None else f"{1e3 * self.value:.{2 if self.value < 1e-3 else 1}f}"

    @property
    def range(self) -> str:
        """95 % interval in millimetres, such as ``0.4 to 2.6``; empty where there is none."""
        if self.low is None or self.high is None or self.low == self.high:
            return ""
        return f"{1e3 * self.low:.1f} to {1e3 * self.high:.1f}"


NOT_KNOWN = TrueError()


def modelled(model: ToolModel, position: Array, target: Array) -> Array:
    """Return value, lower and upper end (3, ...) [m] of what a model says; NaN where a position is none."""
    found = np.full((3, *np.shape(position)[:-1]), np.nan)
    there = np.isfinite(position).all(axis=-1) & np.isfinite(target).all(axis=-1)
    if there.any():
        low, high = model.interval(position[there], target[there])
        found[:, there] = model.expected(position[there], target[there]), low, high
    return found


def mean_modelled(found: Array) -> TrueError:
    """Mean of ``found`` (3, ...) [m], value and ends as `modelled` tells them; not known where all are NaN.

    What a calibration has wrong, it has wrong at all targets alike. So the ends are means of the ends: too far apart
    rather than too near.
    """
    known = np.isfinite(found[0])
    if not known.any():
        return NOT_KNOWN
    value, low, high = (float(part[known].mean()) for part in found)
    return TrueError(how="modelled", value=value, low=low, high=high)
