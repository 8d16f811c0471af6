"""Paths: places over time, smooth between the points that they are given by."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.orientation import WEIGHT, Orientation, tool_axis
from rejoint.arms.posing import NEAR, TURNED, missed_pose
from rejoint.arms.rotations import quaternion_of, same_side
from rejoint.control.comparison.targets import beyond_reach, lowest, parsed, too_low, unit_hint
from rejoint.control.moving.posture import PathPostures
from rejoint.control.poses import PLACE, Pose, columns, in_words, turned_as, unknown_header
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_bounded
from rejoint.system.numbers import as_floats

_HEADER = ("time", *PLACE)
_MOST = 4_000_000
"""[bytes] largest file that is read (chosen: ten minutes at 100 Hz)"""
LONGEST = 3600.0
"""[s] that a path may take (chosen: in memory it is judged every 40 ms; longer ones are rather in milliseconds)"""
SHORTEST = 0.1
"""[s] that a path takes at least (chosen: two control periods of a real arm; in less it has no cycle)"""
_LOOK = 0.04
"""[s] between the places of a path that are judged before the arm moves (chosen: a control cycle or two)"""
_OPPOSITE = -0.5
"""Cosine below which two directions are too far apart for a way between them (chosen: 120 deg)"""
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
    direction: Array | None = None
    """(T, 3) in the base frame, of any length: where the tool points; None where that does not matter"""
    quaternion: Array | None = None
    """(T, 4) w, x, y, z, of any length: the whole orientation of the tool, instead"""
    weight: float = WEIGHT
    """[m/rad] that the orientation counts"""
    axis: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]), repr=False)
    """(3,) direction of the tool in its own frame; `on` knows it"""
    _slope: Array = field(init=False, repr=False)  # (T, 3) [m/s]
    _turn: Array | None = field(init=False, repr=False, default=None)  # (T, 3) directions or (T, 4) quaternions
    _turning: Array | None = field(init=False, repr=False, default=None)  # their slopes [1/s]

    def __post_init__(self) -> None:
        time = as_floats("path", self.time, "times (T,) in seconds").copy()
        place = as_floats("path", self.place, "places (T, 3) in metres").copy()
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
        turn = self._knots()
        object.__setattr__(self, "_turn", turn)
        object.__setattr__(self, "_turning", None if turn is None else spline_slopes(time, turn))

    def _knots(self) -> Array | None:
        """Return the orientations as unit vectors; quaternions each on the side of the one before it."""
        if self.direction is not None and self.quaternion is not None:
            raise InputError("path: direction and quaternion are given, expected one of them")
        given, size = (self.quaternion, 4) if self.direction is None else (self.direction, 3)
        if given is None:
            return None
        turn = as_floats("path", given, f"orientations ({len(self.time)}, {size})")
        if turn.shape != (len(self.time), size) or not (np.linalg.norm(turn, axis=-1) > 0.0).all():
            raise InputError(
                f"path: orientations of shape {turn.shape}, expected ({len(self.time)}, {size}), none zero"
            )
        turn = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
        turn = turn if size == 3 else same_side(turn)
        if ((turn[1:] * turn[:-1]).sum(axis=-1) < _OPPOSITE).any():
            raise InputError("path: the tool would turn round between two points; give points between them")
        return turn

    @property
    def turned(self) -> bool:
        """Whether it says how the tool is to be turned."""
        return self._turn is not None

    def on(self, arm: Arm) -> Path:
        """Return the path for the tool of ``arm``."""
        return replace(self, axis=tool_axis(arm)) if self.turned else self

    def turn_at(self, time: Array | float) -> Orientation | None:
        """Return how the tool is to be turned (...) at ``time`` (...) [s]; None where that does not matter."""
        if self._turn is None or self._turning is None:
            return None
        return turned_as(on_spline(self.time, self._turn, self._turning, time)[0], self.axis, self.weight)

    def pose_at(self, time: float) -> Pose:
        """Return place and orientation at ``time`` [s] as a `Pose`."""
        place = self.at(time)
        if self._turn is None or self._turning is None:
            return Pose(place_m=place)
        knot = on_spline(self.time, self._turn, self._turning, time)[0]
        kind = "quaternion" if self.direction is None else "direction"
        return Pose(place_m=place, weight_m=self.weight, **{kind: knot})

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
        return on_spline(self.time, self.place, self._slope, time)

    def require_followable(self, arm: Arm) -> None:
        """Raise InputError, which says where, unless ``arm`` can reach every place and is fast enough for it."""
        if not SHORTEST <= self.duration <= LONGEST:
            raise InputError(
                f"path: it takes {self.duration:g} s, {SHORTEST:g} to {LONGEST:.0f} s were expected; give times in "
                "seconds, and what takes longer as paths one after the other"
            )
        times = np.union1d(np.linspace(0.0, self.duration, max(2, round(self.duration / _LOOK))), self.time[:1])
        places = self.at(times)
        beyond = beyond_reach(arm, places)
        if beyond.any():
            k = int(beyond.argmax())
            raise InputError(
                f"path: at {times[k]:.2f} s {_point(places[k])} is out of reach, {1e3 * beyond[k]:.0f} mm too far;"
                f"{unit_hint(self.place)} give places that the tool can reach"
            )
        if too_low(arm, places).any():
            k = int(places[:, 2].argmin())
            raise InputError(f"path: at {times[k]:.2f} s {_point(places[k])} {lowest(arm)}; lead it higher")
        turns = self.turn_at(times)
        begin = PathPostures(arm, places[:1], turns and turns[:1])
        postures = begin.along(places[:, None], turns and turns[:, None])[:, 0]
        if turns is not None:
            _require_turned(arm, times, places, turns, postures)
        share = np.abs(np.diff(postures, axis=0)) / np.diff(times)[:, None] / arm.max_speed
        k, j = (int(index) for index in np.unravel_index(int(share.argmax()), share.shape))
        if share[k, j] > SPEED_SHARE:
            raise InputError(
                f"path: at {times[k]:.2f} s {_point(places[k])} {arm.joint_names[j]} would have to turn at "
                f"{np.degrees(share[k, j] * arm.max_speed[j]):.0f} deg/s, "
                f"{np.degrees(SPEED_SHARE * arm.max_speed[j]):.0f} at most were expected; give the path more time there"
            )


def _require_turned(arm: Arm, times: Array, places: Array, turns: Orientation, postures: Array) -> None:
    """Raise InputError, which says where, unless ``postures`` (T, n) [rad] turn the tool as in ``turns`` (T,)."""
    off, angle = missed_pose(arm, postures, places, turns)
    askew = (off > NEAR) | (angle > TURNED)
    if askew.any():
        k = int(askew.argmax())
        raise InputError(
            f"path: at {times[k]:.2f} s {_point(places[k])} the tool cannot have {in_words(turns[k])}, at best "
            f"{1e3 * off[k]:.0f} mm and {np.degrees(angle[k]):.0f} deg off; give another orientation there"
        )


def on_spline(knots: Array, values: Array, slopes: Array, time: Array | float) -> tuple[Array, Array, Array]:
    """Return value, derivative and second derivative (..., k) at ``time`` (...) of a spline; outside it stands still.

    It goes through ``values`` (T, k) at the times ``knots`` (T,) [s] with ``slopes`` (T, k) [1/s].
    """
    inside = np.clip(time, 0.0, knots[-1])
    k = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
    h = (knots[k + 1] - knots[k])[..., None]
    u = (inside - knots[k])[..., None] / h
    p, q, a, b = values[k], values[k + 1], h * slopes[k], h * slopes[k + 1]
    c, d = 3.0 * (q - p) - 2.0 * a - b, 2.0 * (p - q) + a + b
    moving = np.asarray((np.asarray(time) >= 0.0) & (np.asarray(time) <= knots[-1]))[..., None]
    speed = (a + u * (2.0 * c + 3.0 * u * d)) / h
    return p + u * (a + u * (c + u * d)), moving * speed, moving * (2.0 * c + 6.0 * u * d) / h**2


def path_of(time: Array, place: Array, turn: Orientation | None, name: str) -> Path:
    """Return a path through ``place`` (T, 3) [m] at ``time`` (T,) [s] with orientations (T,), all of one kind."""
    if turn is None:
        return Path(time=time, place=place, name=name)
    whole = bool(turn.whole[0])
    return Path(
        time=time, place=place, name=name, weight=float(turn.weight[0]), axis=turn.axis,
        direction=None if whole else turn.rotation @ turn.axis,
        quaternion=np.stack([quaternion_of(rotation) for rotation in turn.rotation]) if whole else None,
    )  # fmt: skip


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

    More columns are those of an orientation (`rejoint.control.poses`), which every line then has.
    """
    try:
        text = read_bounded(file, _MOST, "give fewer points").decode("utf-8-sig")
        numbered = enumerate(csv.reader(io.StringIO(text, newline="")), start=1)
        rows = [(number, row) for number, row in numbered if any(map(str.strip, row))]
    except FileNotFoundError as error:
        raise FileError(
            file, "no such file, and no standard path", "standard are circle-8s, random-0.2hz and the like"
        ) from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(file, f"cannot be read as text ({error})", "give a CSV file") from error
    make = columns(rows[0][1], _HEADER) if rows else None
    if make is None:
        raise FileError(file, *unknown_header(rows[0][1] if rows else (), _HEADER))
    if len(rows) < 3:
        found = "one point" if len(rows) == 2 else "no point"
        raise FileError(file, f"{found} below the header, at least two were expected", "add lines")
    poses = [parsed(file, number, row, make) for number, row in rows[1:]]
    time = np.array([float(row[0]) for _, row in rows[1:]])
    try:
        return _through(time, poses, file.stem)
    except InputError as error:
        raise FileError(file, str(error), "give at least two lines of increasing time") from error


def _through(time: Array, poses: Sequence[Pose], name: str) -> Path:
    """Return the path through poses, all of which have an orientation or none has."""
    place = np.array([pose.place_m for pose in poses]).reshape(-1, 3)
    turned = {pose.turned for pose in poses}
    if len(turned) > 1 or len({pose.weight_m for pose in poses}) > 1:
        raise InputError("path: orientations, of one weight, are on every line or on none")
    if turned != {True}:
        return Path(time=time, place=place, name=name)
    whole = poses[0].direction is None
    rotations = [pose.rotation(np.array([0.0, 0.0, 1.0])) for pose in poses] if whole else []  # they need no axis
    return Path(
        time=time, place=place, name=name, weight=poses[0].weight_m,
        direction=None if whole else np.array([pose.direction for pose in poses]),
        quaternion=np.array([quaternion_of(one) for one in rotations]) if whole else None,
    )  # fmt: skip


def _point(place: Array) -> str:
    return f"({', '.join(f'{value * 1e3:.0f}' for value in place)}) mm"
