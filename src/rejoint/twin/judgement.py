"""What judging twins on logs comes to: plain data, which need no simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, tcp_position

NO_TWIN = "no twin"
"""Name of the prediction that the arm is where it was told to be"""


@dataclass(frozen=True, kw_only=True)
class PredictionError:
    """Distance between a prediction and the encoders, root mean square over time."""

    joint: float
    """[rad] over all joints"""
    joints: tuple[float, ...]
    """(n,) [rad]"""
    tcp: float
    """[m] of the TCP by forward kinematics of the encoders"""


@dataclass(frozen=True, kw_only=True)
class Errors:
    """One prediction of one motion, or the mean over motions; None where there are no such rows."""

    free: PredictionError | None
    contact: PredictionError | None
    all: PredictionError | None


@dataclass(frozen=True, kw_only=True)
class MotionErrors:
    """All predictions of one motion."""

    motion: str
    seconds: float
    """[s]"""
    contact_seconds: float
    """[s] with the tip on the table, recovery included"""
    left_out_seconds: float
    """[s] at stops or with dead readings, recovery included"""
    errors: dict[str, Errors]
    """by the name of the prediction"""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Residual over time of the motion that the first candidate predicts worst, for a figure."""

    motion: str
    time: tuple[float, ...]
    """(T,) [s] since its start"""
    contact: tuple[bool, ...]
    """(T,)"""
    tcp: dict[str, tuple[float, ...]]
    """(T,) [m] error by the name of the prediction"""
    joints: tuple[tuple[float, ...], ...]
    """(n, T) [rad] predicted minus measured positions of the first candidate"""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """What a replay of logs says about twins."""

    arm: str
    joint_names: tuple[str, ...]
    table_height: float | None
    """[m] where the tip touched a table; None if it never did"""
    motions: tuple[MotionErrors, ...]
    mean: dict[str, Errors]
    """over the motions, each counting the same, by the name of the prediction"""
    worst: Trace
    doubts: tuple[str, ...] = ()
    """why no prediction is to be trusted, however small its error (`rejoint.twin.judge`); empty where nothing is
    missing"""


def prediction_error(arm: Arm, predicted: Array, measured: Array) -> PredictionError:
    """Compare positions (T, n) [rad]."""
    difference = predicted - measured
    joints = np.sqrt(np.mean(difference**2, axis=0))
    gap = tcp_position(arm, predicted) - tcp_position(arm, measured)
    tcp = np.sqrt(np.mean(np.sum(gap**2, axis=-1)))
    return PredictionError(joints=tuple(joints.tolist()), joint=float(np.sqrt(np.mean(difference**2))), tcp=float(tcp))
