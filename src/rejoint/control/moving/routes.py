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
from rejoint.control.moving.path import Path
from rejoint.system.errors import InputError

LEAD_IN = 2.0
"""[s] in which an arm stands at the start of a path before it moves off (chosen: in it the observer finds what pushes
each joint)"""
LAG = 0.08
"""[s] by which an arm goes behind a stream, at all times alike (chosen: the next target at 30 Hz has then mostly
come when its command goes out)"""
EXTRAPOLATED = 0.2
"""[s] for which a stream that pauses is taken to go on as it went; then it is held (chosen)"""
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


@dataclass(eq=False)
class Stream:
    """A target that arrives as it goes, at 10 to 100 Hz, with jitter and gaps.

    The arm goes `LAG` behind it: between targets the way is straight, after the last one it goes on for `EXTRAPOLATED`
    and is then held. `put` may be called by another thread.
    """

    lag: float = LAG
    """[s]"""
    corrected: Callable[[Array], Array] | None = None
    """turns targets (k, 3) [m] into aims"""
    time: list[float] = field(default_factory=list)
    """[s] at which the targets came, on the clock of the run"""
    targets: list[Array] = field(default_factory=list)
    _now: float = 0.0
    _lock: Lock = field(default_factory=Lock, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 <= self.lag <= 1.0:
            raise InputError(f"stream: the lag must be between 0 and 1 s, got {self.lag}")

    def put(self, target: Sequence[float] | Array, time: float | None = None) -> None:
        """Take over a ``target`` (3,) [m] that came at ``time`` [s], by default in the present control cycle.

        InputError where it is no place, or came before the last one.
        """
        place = np.asarray(target, dtype=float)
        time = self._now if time is None else time
        if place.shape != (3,) or not np.isfinite(place).all() or not np.isfinite(time):
            raise InputError(f"stream: a target is three finite numbers in metres, got {target} at {time} s")
        with self._lock:
            if self.time and time < self.time[-1]:
                raise InputError(f"stream: a target of {time:g} s came after one of {self.time[-1]:g} s")
            if self.time and time == self.time[-1]:
                self.targets[-1] = place
                return
            self.time.append(time)
            self.targets.append(place)

    def place(self, now: float) -> Array:
        """Return the target (3,) [m] in force: the last one that came."""
        self._now = now
        return self._between(np.array([now]), now)[0]

    def aims(self, now: float, later: Array) -> Array:
        """Return where the arm is to be, by what has come until ``now``."""
        self._now = now
        places = self._between(now + later - self.lag, now)
        return places if self.corrected is None else self.corrected(places)

    def turns(self, now: float, later: Array) -> Orientation | None:  # noqa: ARG002 - a stream is of places
        """Return None: the tool may be turned as it likes."""
        return None

    def _between(self, time: Array, now: float) -> Array:
        with self._lock:
            count = bisect_right(self.time, now)
            first = max(0, bisect_right(self.time, now - _RECENT, hi=count) - 2)
            times, places = np.array(self.time[first:count]), np.array(self.targets[first:count])
        if not len(times):
            raise InputError("stream: nothing has come yet; put the first target before the arm moves")
        if len(times) == 1:
            return np.broadcast_to(places[0], (len(time), 3))
        found = np.stack([np.interp(time, times, places[:, i]) for i in range(3)], axis=-1)
        beyond = np.clip(time - times[-1], 0.0, EXTRAPOLATED)[:, None]
        return found + beyond * _last_velocity(times, places)


def _last_velocity(times: Array, places: Array) -> Array:
    """Velocity (3,) [m/s] of the last targets: a line through those of 0.1 s, or the last two."""
    recent = np.flatnonzero(times >= times[-1] - 0.1)
    recent = recent if len(recent) > 1 else np.arange(len(times) - 2, len(times))
    since = times[recent] - times[recent].mean()
    return np.asarray(since @ (places[recent] - places[recent].mean(axis=0)) / (since @ since))


@dataclass(frozen=True, eq=False)
class Routes:
    """The guides of B arms side by side."""

    guides: Sequence[Guide]

    @property
    def count(self) -> int:
        """Number B of arms."""
        return len(self.guides)

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


def played(path: Path, rate: float, lead_in: float = LEAD_IN) -> Stream:
    """Return a stream that tells a path ``rate`` [Hz] times a second, as it goes, after a time at its start.

    InputError for a rate that is not between 1 and 1000 Hz.
    """
    if not 1.0 <= rate <= 1000.0:
        raise InputError(f"stream: the rate must be between 1 and 1000 Hz, got {rate}")
    stream = Stream()
    stream.put(path.at(0.0), 0.0)
    for time in np.arange(lead_in, lead_in + path.duration + 1.0 / rate, 1.0 / rate):
        stream.put(path.at(time - lead_in), float(time))
    return stream
