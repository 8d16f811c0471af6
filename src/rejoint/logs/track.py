"""What readers return: columns of a file (`ColumnFrame`), samples of the arm's joints (`Track`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.logs.runlog import Array

MEASURED = ("torque", "current", "gain")
"""What else a log may hold of each joint and row"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ColumnFrame:
    """Columns of numbers on one clock, T rows."""

    path: Path
    titles: tuple[str, ...]
    values: Callable[[Sequence[int]], Array]
    """reads some columns (T, k) in the units of the file"""
    number: NDArray[np.int64]
    """(T,) place of each row in the file"""
    place: str = "row"
    """what the file counts: ``line``, ``message`` or ``row``"""
    time: Array | None = None
    """(T,) [s] where the reader knows it; else a column holds it"""
    angle_unit: str | None = None
    """of angles where neither title nor user says another"""
    found: str = "a table"
    """what the file is, in words"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """States or commands; T samples of n joints."""

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
    more: Mapping[str, Array] = field(default_factory=dict)
    """(T, n) of those of `MEASURED` that the file holds"""

    def __len__(self) -> int:
        return len(self.time)

    def where(self, sample: int) -> str:
        """Where in the file a sample stands, such as ``line 17``."""
        return f"{self.place} {self.number[sample]}"

    def take(self, chosen: NDArray[np.bool_]) -> Track:
        """Return the samples where ``chosen`` (T,) holds."""
        more = {name: values[chosen] for name, values in self.more.items()}
        return replace(
            self, time=self.time[chosen], value=self.value[chosen], number=self.number[chosen], more=more
        )  # fmt: skip

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
    units: Mapping[str, str] = field(default_factory=dict)
    """of what `Track.more` holds"""
    points: dict[str, Points] = field(default_factory=dict)
    """``target`` and ``true_tcp`` where the file has them"""
    extra: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def tracks(self) -> tuple[Track, ...]:
        """States, and commands where there are any."""
        return (self.state,) if self.command is None else (self.state, self.command)


Pending = tuple[str, Callable[[], RecordedMotion]]
"""Name of a motion, and what reads it"""
