"""The result of judging twins on logs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.system.results import Readable
from rejoint.system.statistics import above_zero, bootstrap_mean

FEWEST = 3
"""Motions that an interval needs; chosen"""
CLEARLY = 0.8
"""Relative error that is clearly smaller in fewer motions; chosen"""
NO_TWIN = "no twin"
"""The prediction that the arm is at its command"""


@dataclass(frozen=True, kw_only=True)
class PredictionError:
    """Root mean square error of a prediction, by encoders."""

    joint: float
    """[rad] over all joints"""
    joints: tuple[float, ...]
    """(n,) [rad]"""
    tcp: float
    """[m] of the TCP by encoders"""


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Errors of one motion, or their mean; None without rows."""

    free: PredictionError | None
    contact: PredictionError | None
    all: PredictionError | None


@dataclass(frozen=True, kw_only=True)
class MotionErrors:
    """All predictions of one motion."""

    motion: str
    seconds: float
    contact_seconds: float
    """with the table, recovery included"""
    left_out_seconds: float
    """at stops or with dead readings, recovery included"""
    errors: dict[str, Errors]


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Residual of the worst motion of the first candidate."""

    motion: str
    time: tuple[float, ...]
    """(T,) [s]"""
    contact: tuple[bool, ...]
    """(T,)"""
    tcp: dict[str, tuple[float, ...]]
    """(T,) [m] by prediction"""
    joints: tuple[tuple[float, ...], ...]
    """(n, T) [rad] predicted minus measured, first candidate"""


@dataclass(frozen=True, kw_only=True, repr=False)
class Judgement(Readable):
    """Result of a replay of logs."""

    arm: str
    joint_names: tuple[str, ...]
    table_height: float | None
    """[m] of the tip in contact; None without contact"""
    motions: tuple[MotionErrors, ...]
    mean: dict[str, Errors]
    """over motions with equal weight, by prediction"""
    worst: Trace
    doubts: tuple[str, ...] = ()
    """why no prediction is trusted (`rejoint.twin.judge`)"""


def prediction_error(arm: Arm, predicted: Array, measured: Array) -> PredictionError:
    """Compare positions (T, n) [rad]."""
    difference = predicted - measured
    joints = np.sqrt(np.mean(difference**2, axis=0))
    gap = tcp_position(arm, predicted) - tcp_position(arm, measured)
    tcp = np.sqrt(np.mean(np.sum(gap**2, axis=-1)))
    return PredictionError(joints=tuple(joints.tolist()), joint=float(np.sqrt(np.mean(difference**2))), tcp=float(tcp))


def smaller(ours: Array, theirs: Array) -> bool:
    """Whether errors (K,) are measurably smaller in the same motions."""
    if len(ours) < FEWEST:
        return bool(len(ours) and ours.mean() < CLEARLY * theirs.mean())
    return above_zero(bootstrap_mean(theirs - ours, np.arange(len(ours)), fewest=FEWEST))
