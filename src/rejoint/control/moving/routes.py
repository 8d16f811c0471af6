"""Routes: paths that are known ahead, and targets that arrive as they go."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from threading import Lock
from typing import Protocol

import numpy as np

from rejoint.arms import Array
from rejoint.arms.orientation import Orientation, stacked
from rejoint.arms.rotations import same_side
from rejoint.control.moving.errors import interpolated
from rejoint.control.moving.path import Path
from rejoint.control.poses import Pose, turn_knot, turned_as
from rejoint.control.robot import Mask
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_floats

LEAD_IN = 2.0
"""[s] in which an arm stands at the start of a path before it moves off (chosen: in it the observer finds what pushes
each joint)"""
LAG = 0.08
"""[s] by which an arm goes behind a stream, at all times alike (chosen: the next target at 30 Hz has then mostly
come when its command goes out)"""
EXTRAPOLATED = 0.2
"""[s] for which a stream that pauses is taken to go on as it went; then it is held (chosen)"""
_MOST_TURN = float(np.radians(120.0))
"""[rad] from one target of a stream to the next (chosen, as on a path: farther, the way between them is not certain)"""
_FARTHEST = 10.0  # [m] from the base that a target lies at most (chosen: what is farther is in millimetres)
_RECENT = 2.0  # [s] of a stream that are looked at (chosen: more than the longest lag and what follows look back)


class Guide(Protocol):
    """Where the target of one arm is over time."""

    def place(self, now: float) -> Array:
        """Return the target (3,) [m] at ``now`` [s]."""

    def aims(self, now: float, later: Array) -> Array:
        """Return where the encoders are to see the tool ``later`` (k,) [s] than ``now``, (k, 3) [m]."""

    def turns(self, now: float, later: Array) -> Orientation | None:
        """Return how the tool is to be turned then, (k,); None where that does not matter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ahead:
    """A path that is known ahead, after a time at its start."""

    path: Path
    aim: Path | None = None
    """where the encoders are to see the tool, with the same times; None: on the path"""
    lead_in: float = LEAD_IN
    """[s] at the start of the path"""

    def place(self, now: float) -> Array:
        """Return the place (3,) [m] on the path."""
        return self.path.at(now - self.lead_in)

    def aims(self, now: float, later: Array) -> Array:
        """Return the places (k, 3) [m] that are to come."""
        return (self.aim or self.path).at(now - self.lead_in + later)

    def turns(self, now: float, later: Array) -> Orientation | None:
        """Return the orientations (k,) that are to come."""
        return (self.aim or self.path).turn_at(now - self.lead_in + later)


Corrected = Callable[[Array, Orientation | None], tuple[Array, Orientation | None]]
"""Turns targets (k, 3) [m], with tools turned so (k,), into aims"""


@dataclass(eq=False)
class Stream:
    """A target that arrives as it goes, at 10 to 100 Hz, with jitter and gaps: places, or poses.

    The arm goes `LAG` behind it: between targets the way is straight, after the last one it goes on for `EXTRAPOLATED`
    and is then held. `put` may be called by another thread. One stream is followed once.
    """

    lag: float = LAG
    """[s]"""
    corrected: Corrected | None = None
    time: list[float] = field(default_factory=list)
    """[s] at which the targets came, on the clock of the run"""
    targets: list[Array] = field(default_factory=list)
    """each (3,) [m]"""
    axis: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]), repr=False)
    """(3,) direction of the tool in its own frame; who drives an arm knows it"""
    _knots: list[Array] = field(default_factory=list)  # (3,) directions or (4,) quaternions, unit; none of places
    _weight: float = 0.0
    _now: float = 0.0
    _lock: Lock = field(default_factory=Lock, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 <= self.lag <= 1.0:
            raise InputError(f"stream: the lag must be between 0 and 1 s, got {self.lag}")

    def put(self, target: Sequence[float] | Array | Pose, time: float | None = None) -> None:
        """Take over a ``target`` that came at ``time`` [s], by default in the present control cycle.

        It is a place (3,) [m] or a `Pose`; all of a stream are of the kind of the first one. InputError where it is
        none, of another kind, turned by more than 120 degrees from the last one, or came before it.
        """
        time = self._now if time is None else time
        pose = target if isinstance(target, Pose) else None
        place = as_floats("stream", target if pose is None else pose.place_m, "three finite numbers in metres")
        if place.shape != (3,) or not np.isfinite(place).all() or not np.isfinite(time):
            raise InputError(f"stream: a target is three finite numbers in metres, got {target} at {time} s")
        if np.abs(place).max() > _FARTHEST:
            raise InputError(f"stream: a target is in metres, got {place.tolist()}")
        knot = None if pose is None or not pose.turned else turn_knot(pose)
        with self._lock:
            if self.time and time < self.time[-1]:
                raise InputError(f"stream: a target of {time:g} s came after one of {self.time[-1]:g} s")
            self._require_alike(knot)
            if self.time and time == self.time[-1]:
                del self.time[-1], self.targets[-1], self._knots[-1:]
            self.time.append(time)
            self.targets.append(place)
            if pose is not None and knot is not None:
                self._knots.append(same_side(np.stack([*self._knots[-1:], knot]))[-1] if len(knot) == 4 else knot)
                self._weight = pose.weight_m

    @property
    def followed(self) -> bool:
        """Whether an arm has been driven behind it: its targets would be gone through again."""
        return self._now > 0.0

    def place(self, now: float) -> Array:
        """Return the target (3,) [m] in force: the last one that came."""
        self._now = now
        return self._between(self.targets, np.array([now]), now)[0]

    def aims(self, now: float, later: Array) -> Array:
        """Return where the arm is to be, by what has come until ``now``."""
        return self._poses(now, later)[0]

    def turns(self, now: float, later: Array) -> Orientation | None:
        """Return how the tool is to be turned then (k,), by what has come; None for a stream of places."""
        return self._poses(now, later)[1] if self._knots else None

    def received(self) -> tuple[Array, Orientation | None]:
        """Return all targets (K, 3) [m] that came, and how the tools were to be turned at them (K,)."""
        turns = turned_as(np.array(self._knots), self.axis, self._weight) if self._knots else None
        return np.array(self.targets), turns

    def _poses(self, now: float, later: Array) -> tuple[Array, Orientation | None]:
        self._now = now
        time = now + later - self.lag
        places, turns = self._between(self.targets, time, now), None
        if self._knots:
            turns = turned_as(self._between(self._knots, time, now), self.axis, self._weight)
        return (places, turns) if self.corrected is None else self.corrected(places, turns)

    def _require_alike(self, knot: Array | None) -> None:
        """Raise InputError where a target with the orientation ``knot`` does not go with those before it."""
        if not self.targets:
            return
        last = self._knots[-1] if self._knots else None
        if knot is None or last is None or len(knot) != len(last):
            if knot is not last:
                raise InputError(
                    "stream: the first target decides whether all have a direction, a whole orientation, or none; put "
                    "targets of one kind, or take a stream for each"
                )
        elif _turn_between(knot, last) > _MOST_TURN:
            raise InputError(
                "stream: from one target to the next the tool would turn by "
                f"{np.degrees(_turn_between(knot, last)):.0f} deg, at most 120 were expected; put targets between them"
            )

    def _between(self, values: list[Array], time: Array, now: float) -> Array:
        """Return ``values`` (k, m) at ``time`` (k,) [s], by what has come until ``now``."""
        with self._lock:
            count = bisect_right(self.time, now)
            first = max(0, bisect_right(self.time, now - _RECENT, hi=count) - 2)
            times, known = np.array(self.time[first:count]), np.array(values[first:count])
        if not len(times):
            raise InputError("stream: nothing has come yet; put the first target before the arm moves")
        if len(times) == 1:
            return np.broadcast_to(known[0], (len(time), known.shape[1]))
        found = interpolated(time, times, known)
        beyond = np.clip(time - times[-1], 0.0, EXTRAPOLATED)[:, None]
        return found + beyond * _last_velocity(times, known)


def _turn_between(one: Array, other: Array) -> float:
    """Angle [rad] between two directions (3,), or two quaternions (4,)."""
    cosine = float(np.clip(one @ other, -1.0, 1.0))
    return float(np.arccos(cosine)) if len(one) == 3 else 2.0 * float(np.arccos(abs(cosine)))


def _last_velocity(times: Array, values: Array) -> Array:
    """Velocity (m,) [1/s] of the last values (K, m): a line through those of 0.1 s, or the last two."""
    recent = np.flatnonzero(times >= times[-1] - 0.1)
    recent = recent if len(recent) > 1 else np.arange(len(times) - 2, len(times))
    since = times[recent] - times[recent].mean()
    return np.asarray(since @ (values[recent] - values[recent].mean(axis=0)) / (since @ since))


@dataclass(frozen=True, eq=False)
class Routes:
    """The guides of B arms side by side."""

    guides: Sequence[Guide]

    @property
    def count(self) -> int:
        """Number B of arms."""
        return len(self.guides)

    @property
    def waits(self) -> Mask:
        """(B,) that are known ahead, and so can wait for their arm."""
        return np.array([isinstance(guide, Ahead) for guide in self.guides])

    def place(self, now: Array) -> Array:
        """Return the targets (B, 3) [m] at ``now`` (B,) [s]."""
        return np.stack([guide.place(float(time)) for guide, time in zip(self.guides, now, strict=True)])

    def aims(self, now: Array, later: Array) -> Array:
        """Return the aims (k, B, 3) [m] ``later`` (k, B) [s] than ``now`` (B,)."""
        columns = zip(self.guides, now, later.T, strict=True)
        return np.stack([guide.aims(float(time), column) for guide, time, column in columns], axis=1)

    def turns(self, now: Array, later: Array) -> Orientation | None:
        """Return how the tools are to be turned then, (k, B); None where that does not matter."""
        columns = zip(self.guides, now, later.T, strict=True)
        found = [guide.turns(float(time), column) for guide, time, column in columns]
        known = [one for one in found if one is not None]
        return stacked(known, axis=1) if len(known) == len(found) else None


def played(path: Path, rate: float) -> Stream:
    """Return a stream that tells a path ``rate`` [Hz] times a second, as it goes, after a time at its start.

    InputError for a rate that is not between 1 and 1000 Hz.
    """
    require_rate(rate)
    stream = Stream(axis=path.axis)
    stream.put(path.pose_at(0.0), 0.0)
    for time in np.arange(LEAD_IN, LEAD_IN + path.duration + 1.0 / rate, 1.0 / rate):
        stream.put(path.pose_at(time - LEAD_IN), float(time))
    return stream


def require_rate(rate: float) -> None:
    """Raise InputError for a ``rate`` [Hz] at which no stream is told."""
    if not 1.0 <= rate <= 1000.0:
        raise InputError(f"stream: the rate must be between 1 and 1000 Hz, got {rate}")
