"""What readers return: columns of a file (`ColumnFrame`), samples of joints (`Track`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.logs.runlog import Array

MEASURED = ("torque", "current", "gain")
"""Other data per joint and row"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ColumnFrame:
    """Columns on one clock, T rows."""

    path: Path
    titles: tuple[str, ...]
    values: Callable[[Sequence[int]], Array]
    """reads columns (T, k) in file units"""
    number: NDArray[np.int64]
    """(T,) row in the file"""
    place: str = "row"
    """``line``, ``message`` or ``row``"""
    time: Array | None = None
    """(T,) [s]; None: in a column"""
    angle_unit: str | None = None
    """default of angles"""
    found: str = "a table"
    """kind of the file"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """States or commands: T samples of n joints."""

    path: Path
    what: str
    """``state`` or ``command``"""
    time: Array
    """(T,) [s]"""
    value: Array
    """(T, n) [rad] in the arm's order"""
    columns: tuple[str, ...]
    """(n,) names in the file"""
    place: str
    """``line``, ``message`` or ``row``"""
    number: NDArray[np.int64]
    """(T,) place in the file"""
    more: Mapping[str, Array] = field(default_factory=dict)
    """(T, n) of `MEASURED`"""

    def __len__(self) -> int:
        return len(self.time)

    def where(self, sample: int) -> str:
        """Place of a sample in the file: ``line 17``."""
        return f"{self.place} {self.number[sample]}"

    def take(self, chosen: NDArray[np.bool_]) -> Track:
        """Return samples where ``chosen`` (T,) holds."""
        more = {name: values[chosen] for name, values in self.more.items()}
        return replace(self, time=self.time[chosen], value=self.value[chosen], number=self.number[chosen], more=more)

    def shifted(self, seconds: float) -> Track:
        """Return samples on a clock that starts ``seconds`` later."""
        return replace(self, time=self.time - seconds)


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """TCP positions."""

    time: Array
    """(M,) [s]"""
    value: Array
    """(M, 3) [m]"""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedMotion:
    """A recorded motion before the checks."""

    name: str
    state: Track
    command: Track | None
    angle_unit: str
    """in the file"""
    robot: str
    """origin of the log"""
    half: Array | None = None
    """(n,) [rad] half ranges of normalised values"""
    units: Mapping[str, str] = field(default_factory=dict)
    """of `Track.more`"""
    points: dict[str, Points] = field(default_factory=dict)
    """``target`` and ``true_tcp``"""
    extra: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def tracks(self) -> tuple[Track, ...]:
        """States, and commands."""
        return (self.state,) if self.command is None else (self.state, self.command)


Pending = tuple[str, Callable[[], RecordedMotion]]
"""Name of a motion, and its reader"""
