"""What judging twins on logs comes to: plain data, which need no simulator."""

from __future__ import annotations

from dataclasses import dataclass

from rejoint.twin.repeatability import Repeatability

NO_TWIN = "no twin"
"""Name of the prediction that the arm is where it was told to be"""


@dataclass(frozen=True, kw_only=True)
class Error:
    """Distance between a prediction and the encoders, root mean square over time."""

    joint: float
    """[rad] over all joints"""
    joints: tuple[float, ...]
    """(n,) [rad]"""
    tcp: float
    """[m]"""


@dataclass(frozen=True, kw_only=True)
class Errors:
    """One prediction of one motion, or the mean over motions; None where there are no such rows."""

    free: Error | None
    contact: Error | None
    all: Error | None


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
    repeatability: Repeatability | None
    """of the arm itself: no twin can be asked for less; None where no motion repeats"""
    worst: Trace
    doubts: tuple[str, ...] = ()
    """why no prediction is to be trusted, however small its error (`rejoint.twin.doubts`); empty where nothing is
    missing"""
