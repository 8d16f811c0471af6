"""Paths: places over time, smooth between the points that they are given by."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path as FilePath

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.targets import beyond_reach
from rejoint.control.moving.posture import PathPostures
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_bounded

_HEADER = ["time", "x", "y", "z"]
_MOST = 4_000_000
"""[bytes] largest file that is read (chosen: ten minutes at 100 Hz)"""
_LOOK = 0.04
"""[s] between the places of a path that are judged before the arm moves (chosen: a control cycle or two)"""
SPEED_SHARE = 0.8
"""Share of what its joints can do that a path may ask of an arm (chosen: the firmware of a myCobot moves its own
references that fast, and what corrects errors needs some as well)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """Places over time; between the points a cubic spline, so that velocity and acceleration are continuous."""

    time: Array
    """(T,) [s] increasing, from 0"""
    place: Array
    """(T, 3) [m]"""
    name: str = "path"
    _slope: Array = field(init=False, repr=False)  # (T, 3) [m/s]

    def __post_init__(self) -> None:
        time, place = (np.array(value, dtype=float) for value in (self.time, self.place))
        if time.ndim != 1 or place.shape != (len(time), 3) or len(time) < 2:
            raise InputError(f"path: times {time.shape} and places {place.shape}, expected (T,) and (T, 3), T > 1")
        if not (np.isfinite(time).all() and np.isfinite(place).all()):
            raise InputError("path: some times or places are no finite numbers")
        late = np.flatnonzero(np.diff(time) <= 0.0)
        if len(late):
            k = int(late[0]) + 1
            raise InputError(f"path: the time {time[k]:g} s of point {k + 1} is not after {time[k - 1]:g} s before it")
        time = time - time[0]
        for name, value in (("time", time), ("place", place), ("_slope", spline_slopes(time, place))):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return float(self.time[-1])

    def at(self, time: Array | float) -> Array:
        """Return the places (..., 3) [m] at ``time`` (...) [s]; before the start and after the end it stands still."""
        return self._spline(time)[0]

    def velocity(self, time: Array | float) -> Array:
        """Return the velocities (..., 3) [m/s] at ``time`` (...) [s]."""
        return self._spline(time)[1]

    def acceleration(self, time: Array | float) -> Array:
        """Return the accelerations (..., 3) [m/s^2] at ``time`` (...) [s]."""
        return self._spline(time)[2]

    def _spline(self, time: Array | float) -> tuple[Array, Array, Array]:
        inside = np.clip(time, 0.0, self.duration)
        k = np.clip(np.searchsorted(self.time, inside, side="right") - 1, 0, len(self.time) - 2)
        h = (self.time[k + 1] - self.time[k])[..., None]
        u = (inside - self.time[k])[..., None] / h
        p, q, a, b = self.place[k], self.place[k + 1], h * self._slope[k], h * self._slope[k + 1]
        c, d = 3.0 * (q - p) - 2.0 * a - b, 2.0 * (p - q) + a + b
        moving = np.asarray((np.asarray(time) >= 0.0) & (np.asarray(time) <= self.duration))[..., None]
        speed = (a + u * (2.0 * c + 3.0 * u * d)) / h
        return p + u * (a + u * (c + u * d)), moving * speed, moving * (2.0 * c + 6.0 * u * d) / h**2

    def require_followable(self, arm: Arm) -> None:
        """Raise InputError, which says where, unless ``arm`` can reach every place and is fast enough for it."""
        times = np.union1d(np.linspace(0.0, self.duration, max(2, round(self.duration / _LOOK))), self.time[:1])
        places = self.at(times)
        beyond = beyond_reach(arm, places)
        if beyond.any():
            k = int(beyond.argmax())
            raise InputError(
                f"path: at {times[k]:.2f} s {_point(places[k])} is out of reach, {1e3 * beyond[k]:.0f} mm too far; "
                "give places that the tool can reach"
            )
        postures = PathPostures(arm, places[:1]).along(places[:, None])[:, 0]
        share = np.abs(np.diff(postures, axis=0)) / np.diff(times)[:, None] / arm.max_speed
        k, j = (int(index) for index in np.unravel_index(int(share.argmax()), share.shape))
        if share[k, j] > SPEED_SHARE:
            raise InputError(
                f"path: at {times[k]:.2f} s {_point(places[k])} {arm.joint_names[j]} would have to turn at "
                f"{np.degrees(share[k, j] * arm.max_speed[j]):.0f} deg/s, "
                f"{np.degrees(SPEED_SHARE * arm.max_speed[j]):.0f} at most were expected; give the path more time there"
            )


def spline_slopes(time: Array, place: Array) -> Array:
    """Slopes (T, 3) [m/s] of the cubic spline through ``place`` (T, 3) [m] at ``time`` (T,) [s].

    At both ends it is that of the parabola through the last three points. Solved by elimination from one end to the
    other, since every slope is tied to its two neighbours.
    """
    h = np.diff(time)
    chord = np.diff(place, axis=0) / h[:, None]
    slope = np.empty_like(place)
    if len(time) == 2:
        slope[:] = chord
        return slope
    slope[0] = chord[0] + (chord[0] - chord[1]) * (h[0] / (h[0] + h[1]))
    slope[-1] = chord[-1] + (chord[-1] - chord[-2]) * (h[-1] / (h[-1] + h[-2]))
    upper = np.zeros(len(time))
    for k in range(1, len(time) - 1):  # h[k] s[k-1] + 2 (h[k-1] + h[k]) s[k] + h[k-1] s[k+1] = right
        right = 3.0 * (h[k] * chord[k - 1] + h[k - 1] * chord[k])
        pivot = 2.0 * (h[k - 1] + h[k]) - h[k] * upper[k - 1]
        upper[k] = h[k - 1] / pivot
        slope[k] = (right - h[k] * slope[k - 1]) / pivot
    for k in range(len(time) - 2, 0, -1):
        slope[k] -= upper[k] * slope[k + 1]
    return slope


def read_path(file: FilePath) -> Path:
    """Read a CSV file with the header ``time,x,y,z``, in seconds and millimetres; FileError names a line that is wrong.

    More columns are refused: an orientation would be ignored.
    """
    try:
        text = read_bounded(file, _MOST, "give fewer points").decode("utf-8-sig")
        rows = [(n, row) for n, row in enumerate(csv.reader(io.StringIO(text, newline="")), start=1) if any(row)]
    except FileNotFoundError as error:
        raise FileError(file, "no such file, and no standard path", "check the name") from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(file, f"cannot be read as text ({error})", "give a CSV file") from error
    if not rows or [cell.strip().lower() for cell in rows[0][1]] != _HEADER:
        found = ",".join(rows[0][1]) if rows else "nothing"
        raise FileError(file, f"the header is {found!r}, expected 'time,x,y,z'", "values are seconds and millimetres")
    values = np.array([_numbers(file, number, row) for number, row in rows[1:]]).reshape(-1, 4)
    try:
        return Path(time=values[:, 0], place=values[:, 1:] / 1e3, name=file.stem)
    except InputError as error:
        raise FileError(file, str(error), "give at least two lines of increasing time") from error


def _numbers(file: FilePath, number: int, row: list[str]) -> list[float]:
    try:
        values = [float(cell) for cell in row]
    except ValueError as error:
        raise FileError(file, f"line {number}: {','.join(row)!r} holds no numbers", "give time,x,y,z") from error
    if len(values) != len(_HEADER) or not np.isfinite(values).all():
        raise FileError(file, f"line {number}: {','.join(row)!r} is not four finite numbers", "give time,x,y,z")
    return values


def _point(place: Array) -> str:
    return f"({', '.join(f'{value * 1e3:.0f}' for value in place)}) mm"
