"""What tells where the tool is while the arm stands still: a ruler, a tracker's file, or an emulator's secret."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from rejoint.arms import Array
from rejoint.arms.workspace import reach
from rejoint.control.robot import Robot
from rejoint.diagnosis.calibration.measurements import NOISE
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import MEGABYTE, require_file

SPAN = 0.5
"""[s] of a tracker's newest rows that are averaged (chosen: the arm stands still for longer)"""
PATIENCE = 5.0
"""[s] for which a tracker may write nothing before it is taken to be off (chosen)"""
TRACK_MOST = 1000 * MEGABYTE
"""Largest file of a tracker that is read; only its end is (chosen: a day at 100 Hz)"""
FAR = 0.08
"""Share of an arm's summed link lengths by which a coordinate may differ from the encoders' before it is asked for once
more, 42 mm on a myCobot (chosen: three times what worn arms are off)"""
_TAIL = 64_000  # [bytes] of its end (chosen: 500 rows)
_UNITS = {"m": 1.0, "mm": 1e-3}


@dataclass(frozen=True)
class Stop:
    """A posture in which the arm stands and waits to be measured."""

    number: int
    """from 1"""
    total: int
    believed: Array
    """(3,) [m] where its encoders see the tool, in the frame of the base"""
    again: str = ""
    """why it is measured once more; empty the first time"""


class Gauge(Protocol):
    """Measures the tool of an arm that stands still."""

    source: str
    """``touch``, ``camera``, ``tracker``, or ``emulated`` where nothing measured: an emulator told"""
    frame: str
    """``base`` where points are in the frame of the arm's base, else a name"""
    sigma: float
    """[m] standard deviation of each coordinate"""

    def measure(self, robot: Robot, stop: Stop) -> Array:
        """Return where the tool is (3,) [m]; NaN where a coordinate was not measured, all of them: leave it out."""


@dataclass(kw_only=True)
class EmulatedGauge:
    """Asks an emulated arm where its tool is, with the noise of somebody who measures it."""

    sigma: float = NOISE
    seed: int = 0
    source: str = "emulated"
    frame: str = "base"
    _rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng([self.seed, 13])

    def measure(self, robot: Robot, stop: Stop) -> Array:  # noqa: ARG002 - it knows by itself
        """Return the true place, with noise."""
        place = robot.true_tcp()[0]
        if not np.isfinite(place).all():
            raise InputError(
                "calibration: this arm does not tell where its tool is; measure it with touch or a tracker"
            )
        return np.asarray(place + self._rng.normal(0.0, self.sigma, 3))


@dataclass(kw_only=True)
class TouchGauge:
    """Asks a person, who types what a ruler, a calliper or a height gauge says."""

    ask: Callable[[Stop], str]
    """prints where the arm stands and returns the answer: x, y and z in millimetres, ``-`` for one not measured"""
    complain: Callable[[str], None]
    """prints why an answer cannot be used; then it is asked again"""
    sigma: float = NOISE
    source: str = "touch"
    frame: str = "base"

    def measure(self, robot: Robot, stop: Stop) -> Array:
        """Ask until the answer can be used; what ``ask`` raises ends it.

        A point in the base far from where the encoders see the tool is a slip more often than a worn arm: it counts
        where the same is said again.
        """
        doubted = None
        while True:
            answer = self.ask(stop)
            try:
                point = parse_point(answer)
            except InputError as error:
                self.complain(str(error))
                continue
            off = float(np.nanmax(np.abs(point - stop.believed), initial=0.0))
            if self.frame != "base" or off <= FAR * reach(robot.arm) or _same(point, doubted):
                return point
            self.complain(
                f"that is {1e3 * off:.0f} mm from where the encoders see the tool, along one axis; check sign, unit "
                "and axes, and type it again if it is right"
            )
            doubted = point


def _same(point: Array, other: Array | None) -> bool:
    return other is not None and np.array_equal(point, other, equal_nan=True)


def parse_point(text: str) -> Array:
    """Read x, y and z in millimetres, ``-`` for one that was not measured, nothing for none; returns (3,) [m].

    Where blanks or semicolons part them, a comma inside of one is a decimal comma.
    """
    cells = [cell.strip(",") for cell in text.replace(";", " ").split() if cell.strip(",")]
    cells = cells[0].split(",") if len(cells) == 1 else [cell.replace(",", ".") for cell in cells]
    if not cells:
        return np.full(3, np.nan)
    if len(cells) != 3:
        raise InputError(f"expected x, y and z in millimetres, such as `171.5 -20 203`, found {text.strip()!r}")
    try:
        point = np.array([np.nan if cell == "-" else 1e-3 * float(cell) for cell in cells])
    except ValueError:
        raise InputError(
            f"expected three numbers, or - for one that was not measured, found {text.strip()!r}"
        ) from None
    if np.isinf(point).any() or np.nanmax(np.abs(point), initial=0.0) > 10.0:
        raise InputError(f"{text.strip()!r} are not millimetres of an arm on a table")
    return point


@dataclass(kw_only=True)
class TrackerGauge:
    """Reads the end of a CSV file that a tracker goes on writing: columns time [s], x, y and z."""

    path: Path
    unit: str = "mm"
    """of x, y and z: ``mm`` or ``m``"""
    sigma: float = NOISE
    frame: str = "tracker"
    """``base`` where its points are in the frame of the arm's base"""
    source: str = "tracker"
    wait: Callable[[float], None] = time.sleep

    def __post_init__(self) -> None:
        if self.unit not in _UNITS:
            raise InputError(f"tracker: the unit is mm or m, got {self.unit!r}")
        self._newest()

    def measure(self, robot: Robot, stop: Stop) -> Array:  # noqa: ARG002 - it only has to stand
        """Return the mean of what is written in the next `SPAN` seconds."""
        before = self._newest()[-1, 0]
        waited = 0.0
        while waited < PATIENCE + SPAN:
            self.wait(SPAN)
            waited += SPAN
            rows = self._newest()
            fresh = rows[rows[:, 0] > before]
            if len(fresh) and fresh[-1, 0] - before >= 0.8 * SPAN:
                return np.asarray(_UNITS[self.unit] * fresh[:, 1:].mean(axis=0))
        raise FileError(
            self.path, f"no new rows for {waited:.1f} s", "start the tracker, or look whether it sees the tool"
        )

    def _newest(self) -> Array:
        """Newest rows (T, 4) time, x, y, z."""
        try:
            require_file(self.path, TRACK_MOST, "begin a new file")
            with self.path.open("rb") as file:
                head = file.readline(4096).decode().strip()
                file.seek(max(self.path.stat().st_size - _TAIL, len(head)))
                text = file.read().decode(errors="replace")
        except FileNotFoundError as error:
            raise FileError(self.path, "no such file", "start the tracker first") from error
        except (OSError, UnicodeDecodeError) as error:
            raise FileError(self.path, f"cannot be read ({error})", "check what the tracker writes") from error
        names = [name.strip().lower() for name in head.split(",")]
        if not {"time", "x", "y", "z"} <= set(names):
            raise FileError(self.path, f"columns {head!r}, expected time, x, y, z", "name them in its first line")
        places = [names.index(name) for name in ("time", "x", "y", "z")]
        lines = list(csv.reader(io.StringIO(text)))[1:-1]  # the first and the last may be cut
        rows = []
        for line in lines:
            try:
                rows.append([float(line[place]) for place in places])
            except (ValueError, IndexError):
                continue
        table = np.array(rows).reshape(-1, 4)
        table = table[np.isfinite(table).all(axis=1)]
        if not len(table):
            raise FileError(self.path, "no rows yet", "start the tracker, or look whether it sees the tool")
        return table
