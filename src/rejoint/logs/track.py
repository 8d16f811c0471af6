"""What every reader hands over: samples with the place where each stood in its file."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.logs.runlog import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """One sampled stream, states or commands; T samples of the arm's n joints."""

    path: Path
    what: str
    """``state`` or ``command``"""
    time: Array
    """(T,) [s]"""
    value: Array
    """(T, n) [rad] in the joint order of the arm"""
    columns: tuple[str, ...]
    """what the file calls the n joints"""
    place: str
    """what the file counts: ``line``, ``message`` or ``row``"""
    number: NDArray[np.int64]
    """(T,) place of each sample in the file"""

    def __len__(self) -> int:
        return len(self.time)

    def where(self, sample: int) -> str:
        """Where in the file a sample stands, such as ``line 17``."""
        return f"{self.place} {self.number[sample]}"

    def take(self, chosen: NDArray[np.bool_]) -> Track:
        """Return the samples where ``chosen`` (T,) holds."""
        return replace(self, time=self.time[chosen], value=self.value[chosen], number=self.number[chosen])

    def shifted(self, seconds: float) -> Track:
        """Return the same samples on a clock that starts ``seconds`` later."""
        return replace(self, time=self.time - seconds)


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """TCP positions along a motion."""

    time: Array
    """(M,) [s]"""
    value: Array
    """(M, 3) [m]"""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedMotion:
    """One recorded motion as a reader found it, before the checks."""

    name: str
    state: Track
    command: Track | None
    """None where the file holds no commands"""
    angle_unit: str
    """unit that the file's angles were taken to be in"""
    robot: str
    """where the log came from"""
    points: dict[str, Points] = field(default_factory=dict)
    """``target`` and ``true_tcp`` where the file has them"""
    extra: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def tracks(self) -> tuple[Track, ...]:
        """States, and commands where there are any."""
        return (self.state,) if self.command is None else (self.state, self.command)
