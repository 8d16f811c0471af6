"""How well an arm followed: the error along the way, and what is left of it after the best single lag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array

_LAGS = np.arange(0.0, 0.3001, 0.005)  # [s] that are tried


@dataclass(frozen=True, kw_only=True)
class Along:
    """Errors along a path."""

    rms: float
    """[m] root mean square"""
    largest: float
    """[m]"""
    lag: float
    """[s] by which the path has to be shifted for the least root mean square"""
    rms_after: float
    """[m] the same after that shift"""
    largest_after: float
    """[m]"""


def along(time: Array, tool: Array, at: Array, places: Array) -> Along:
    """Compare the ``tool`` (T, 3) [m] at ``time`` (T,) [s] with ``places`` (K, 3) [m] at times ``at`` (K,) [s]."""
    errors = [np.linalg.norm(tool - interpolated(time - lag, at, places), axis=-1) for lag in _LAGS]
    sizes = [float(np.sqrt((error**2).mean())) for error in errors]
    best = int(np.argmin(sizes))
    return Along(
        rms=sizes[0], largest=float(errors[0].max()), lag=float(_LAGS[best]), rms_after=sizes[best],
        largest_after=float(errors[best].max()),
    )  # fmt: skip


def interpolated(time: Array, at: Array, places: Array) -> Array:
    """Return ``places`` (K, 3) at times ``at`` (K,), straight in between, at ``time`` (T,): (T, 3)."""
    return np.stack([np.interp(time, at, column) for column in places.T], axis=-1)
