"""References: planned paths (files, standard ones), and streams of targets.

Constants without a source are chosen.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from threading import Lock
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline

from rejoint.arms import Arm, Array, Mask, Motors, gravity_torque, tcp_position
from rejoint.arms.arm import frozen
from rejoint.arms.postures import NEAR, TURNED, body_of, missed_pose, pool_of, redundancy, too_heavy
from rejoint.arms.rotations import Orientation, stacked
from rejoint.arms.workspace import length_size
from rejoint.control.correction import tool_error
from rejoint.control.moving.tracker import PathPostures, joint_weights
from rejoint.control.reference import Reference
from rejoint.control.robot import ControlInput
from rejoint.control.targets import (
    PLACE,
    Pose,
    Poses,
    in_mm,
    knots_of,
    oriented,
    placed,
    read_poses,
    refused,
    turned_as,
    unit_hint,
)
from rejoint.system.errors import FileError, InputError
from rejoint.system.numbers import as_floats, as_place, interpolated

_HEADER = ("time", *PLACE)
_MOST = 4_000_000
"""[bytes]"""
LONGEST = 3600.0
"""[s]"""
SHORTEST = 0.1
"""[s]"""
_LOOK = 0.04
"""[s] between judged places"""
_OPPOSITE = -0.5
"""Cosine of the largest turn between points"""
SPEED_SHARE = 0.8
"""Largest share of joint speed"""
_STEP = 0.02  # [s] between the points of a standard path, and of `Path.grid`

_HOMES = 64
"""Stored postures that are tried as the home of a path (chosen)"""
_FOLD = np.radians(60.0)
"""(chosen among 30 to 90 deg)"""
_SURELY, _LIGHT, _HEAVY = 0.4, 0.85, 1.15
"""Least share of a limit that a motor lifts, and shares of that: well, and at most (chosen on worn arms)"""

LEAD_IN = 2.0
"""[s] at rest before a path"""


class Route(NamedTuple):
    """What an arm was to do, when it is over."""

    begin: float
    """[s] on the clock of the run"""
    time: Array
    """(K,) [s] from then on"""
    place: Array
    """(K, 3) [m]"""
    aim: Array
    """(K, 3) [m] the same, corrected"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """Places over time, as a cubic spline."""

    time: Array
    """(T,) [s] increasing, from 0"""
    place: Array
    """(T, 3) [m]"""
    name: str = "path"
    turn: Orientation | None = None
    """(T,) of one kind and one weight; None: any"""
    aim: Path | None = None
    """corrected path with the same times; None: this one"""
    _values: CubicSpline = field(init=False, repr=False)  # of places, then of directions (3,) or quaternions (4,)

    def __post_init__(self) -> None:
        time = as_floats("path", self.time, "times (T,) in seconds")
        place = as_place("path", self.place, "places (T, 3) in metres", axes=(2,))
        if time.ndim != 1 or place.shape != (len(time), 3) or len(time) < 2:
            raise InputError(f"path: times {time.shape} and places {place.shape}, expected (T,) and (T, 3), T > 1")
        step = np.diff(time)
        late = np.flatnonzero(~((step > 0.0) & (step < np.inf)))
        if len(late):
            k = int(late[0]) + 1
            raise InputError(f"path: the time {time[k]:g} s of point {k + 1} is not after {time[k - 1]:g} s before it")
        time = time - time[0]
        object.__setattr__(self, "time", frozen(time))
        object.__setattr__(self, "place", frozen(place))
        rows = place
        if self.turn is not None:
            knots = knots_of(self.turn)
            if ((knots[1:] * knots[:-1]).sum(axis=-1) < _OPPOSITE).any():
                raise InputError("path: the tool would turn round between two points; give points between them")
            rows = np.hstack([place, knots])
        # Parabolic ends: the slopes of the parabolas through the outer three points.
        slope = np.gradient(rows, time, axis=0, edge_order=1 if len(time) == 2 else 2)
        object.__setattr__(self, "_values", CubicSpline(time, rows, bc_type=((1, slope[0]), (1, slope[-1]))))

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.time[-1])

    @property
    def grid(self) -> Array:
        """(K,) [s] times every 20 ms, at which the path is corrected or judged."""
        return np.linspace(0.0, self.duration, max(2, round(self.duration / _STEP) + 1))

    def poses(self, time: Array | float) -> Poses:
        """Places (..., 3) [m] and orientations (...) at ``time`` (...) [s]; constant outside."""
        turn, rows = self.turn, np.asarray(self._values(np.clip(time, 0.0, self.duration)))
        return rows[..., :3], turn and turned_as(rows[..., 3:], turn.axis, float(turn.weight[0]))

    def at(self, time: Array | float) -> Array:
        """Places (..., 3) [m] at ``time`` (...) [s]."""
        return self.poses(time)[0]

    # --- as a guide of an arm, which first rests for `LEAD_IN` at the start --------------------

    @property
    def aimed(self) -> Path:
        """The corrected path."""
        return self.aim or self

    def target(self, now: float) -> Array:
        """Target (3,) [m] at ``now`` [s] on the clock of the run."""
        return self.at(now - LEAD_IN)

    def ahead(self, now: float, later: Array) -> Poses:
        """Corrected targets (k, 3) [m] and orientations (k,) in ``later`` (k,) [s]."""
        return self.aimed.poses(now - LEAD_IN + later)

    def route(self) -> Route:
        """Return all targets."""
        return Route(LEAD_IN, self.grid, self.at(self.grid), self.aimed.at(self.grid))

    def home(self, arm: Arm, motors: Motors | None = None) -> Array:
        """Home (n,) [rad] near which ``arm`` with its ``motors`` can follow; InputError."""
        if not SHORTEST <= self.duration <= LONGEST:
            raise InputError(
                f"path: it takes {self.duration:g} s, {SHORTEST:g} to {LONGEST:.0f} s were expected; give times in "
                "seconds, and what takes longer as paths one after the other"
            )
        time = np.linspace(0.0, self.duration, max(2, round(self.duration / _LOOK)))
        return _home(arm, motors, time, *self.poses(time))


def _home(arm: Arm, motors: Motors | None, time: Array, places: Array, turns: Orientation | None) -> Array:
    """Home (n,) [rad] near which ``arm`` passes poses (T,) at ``time`` (T,) [s]; InputError.

    Rest. Where that is impossible, or ``motors`` may not lift it: the lightest of rest with a light joint folded; else
    of stored postures at the first place.
    """
    loads = _loads(arm, motors)

    def ways(homes: Array) -> Array:
        """Postures (H, T, n) [rad] near ``homes`` (H, n)."""
        each = np.broadcast_to(places[:, None], (len(places), len(homes), 3))
        turned = turns and turns[np.repeat(np.arange(len(places))[:, None], len(homes), axis=1)]
        return PathPostures(arm, each[0], turned and turned[0], homes).along(each, turned).swapaxes(0, 1)

    def weight(way: Array) -> float:
        """Largest torque over the usual; infinite: impossible."""
        bad = _impossible(arm, way, places, turns, loads)[0].any() or _speeds(arm, way, time).max() > SPEED_SHARE
        return np.inf if bad else float((np.abs(gravity_torque(arm, way)) / loads[0]).max())

    usual = ways(arm.rest[None])[0]
    if weight(usual) <= 1.0:
        return arm.rest
    fold = _FOLD * np.eye(arm.joints)[joint_weights(arm) > 1.0]
    folds = np.vstack([0.0 * arm.rest, fold, -fold])
    if motors is not None:  # a joint that may not lift itself is folded down
        torque = gravity_torque(arm, arm.rest)
        folds = folds[((np.abs(torque) <= motors.usable) | (folds * torque <= 0.0)).all(axis=-1)]
    pool = pool_of(arm)
    near = np.linalg.norm(pool.place - places[0], axis=-1).argsort()[: _HOMES if turns is None else _HOMES // 4]
    for homes in arm.rest + folds, pool.posture[near]:
        homes = np.clip(homes, arm.lower, arm.upper)
        found = np.array([weight(way) for way in ways(homes)])
        if found.min() < np.inf:
            return homes[found.argmin()]
    raise InputError(f"path: {_problem(arm, usual, time, places, turns, loads)}{unit_hint(places)}")


def _loads(arm: Arm, motors: Motors | None) -> Array:
    """Usual and largest torque (2, n) [N m] along a path."""
    lifted = np.inf if motors is None else np.maximum(motors.usable, _SURELY * motors.most)
    return np.outer([_LIGHT, _HEAVY], lifted * np.ones(arm.joints))


def _impossible(arm: Arm, way: Array, places: Array, turns: Orientation | None, loads: Array) -> tuple[Mask, Array]:
    """Which postures (T,) of a ``way`` (T, n) [rad] miss their pose, touch something, or are too heavy; misses [m]."""
    off, angle, cost = tool_error(arm, way, places), np.zeros(len(way)), np.empty(len(way))
    redundancy.judge_all(body_of(arm), np.ascontiguousarray(way), loads, cost)
    if turns is not None:
        angle = np.nan_to_num(missed_pose(arm, way, places, turns)[1])
    return (off > NEAR) | (angle > TURNED) | (cost >= redundancy.FAR), off


def _speeds(arm: Arm, way: Array, time: Array) -> Array:
    """Shares (T - 1, n) of the joints' speeds on a ``way`` (T, n) [rad] at ``time`` (T,) [s]."""
    return np.abs(np.diff(way, axis=0)) / np.diff(time)[:, None] / arm.max_speed


def _why(arm: Arm, posture: Array, place: Array, loads: Array) -> str:
    """Why an impossible ``posture`` (n,) [rad] is it."""
    joint, why = too_heavy(arm, posture, loads[1])
    if joint is None:
        return f"{in_mm(place)} is out of reach on this way in its time, or something would touch"
    return f"{in_mm(place)} is too heavy: {why}"


def _problem(arm: Arm, way: Array, time: Array, places: Array, turns: Orientation | None, loads: Array) -> str:
    """Why ``arm`` cannot pass poses (T,) at ``time`` (T,) [s] on a ``way`` (T, n) [rad].

    ``loads`` (2, n) [N m]: usual and largest torque.
    """
    bad, off = _impossible(arm, way, places, turns, loads)
    k, at = int((off if off.max() > NEAR else bad).argmax()), [f"at {now:.2f} s" for now in time]
    if bad[k]:
        one = slice(k, k + 1)
        return refused(arm, at[one], places[one], turns and turns[one]) or (
            f"{at[k]}: {_why(arm, way[k], places[k], loads)}; give other places, or another way to them"
        )
    share = _speeds(arm, way, time)
    k, j = divmod(int(share.argmax()), arm.joints)
    speed, most = np.degrees(np.array([share[k, j], SPEED_SHARE]) * arm.max_speed[j])
    return (
        f"{at[k]}: {in_mm(places[k])} {arm.joint_names[j]} would have to turn at {speed:.0f} deg/s, {most:.0f} at most "
        "were expected; give the path more time there"
    )


def read_path(given: FilePath | str, arm: Arm, seed: int = 0) -> Path:
    """Make a standard path, or read a CSV file ``time,x,y,z`` [s, mm], perhaps with orientations; FileError."""
    if _NAME.fullmatch(str(given)):
        return standard_path(str(given), arm, seed)
    file = FilePath(given)
    if not file.exists():
        remedy = "standard are circle-8s, random-0.2hz and the like"
        raise FileError(file, "no such file, and no standard path", remedy)
    _, time, poses = read_poses(file, _MOST, _HEADER)
    if len(poses) < 2:
        found = "one point" if poses else "no point"
        raise FileError(file, f"{found} below the header, at least two were expected", "add lines")
    places, turn = placed(arm, poses)
    try:
        if turn is not None and np.ptp(turn.weight) > 0.0:
            raise InputError("path: orientations, of one weight, are on every line or on none")
        return Path(time=time, place=places, name=file.stem, turn=turn)
    except InputError as error:
        raise FileError(file, str(error), "correct its lines") from error


STANDARD = ("circle-20s", "circle-8s", "circle-4s", "random-0.2hz", "random-0.5hz")
RADIUS = 0.040
"""[m] of a myCobot's circle; scales with the reach"""
EASE = 1.0
"""[s] to start and to stop"""
LENGTH = 20.0
"""[s] of a standard path"""
_SINES, _FILL = 5, 0.7
"""waves per coordinate, and their share of the region"""
_NAME = re.compile(r"(circle)-(\d+(?:\.\d+)?)s|(random)-(\d+(?:\.\d+)?)hz")


def standard_path(name: str, arm: Arm, seed: int = 0) -> Path:
    """Make ``circle-Ts`` (T seconds per round) or ``random-Fhz`` (up to F hertz); InputError."""
    found = _NAME.fullmatch(name)
    if found is None:
        raise InputError(f"no path is called {name!r}; standard paths: {', '.join(STANDARD)}, or give a CSV file")
    value = float(found[2] or found[4])
    if not 0.05 <= value <= 600.0:
        raise InputError(f"path {name}: expected between 0.05 and 600")
    length = max(1, round(LENGTH / value)) * value if found[1] else LENGTH
    duration = length + EASE
    time = np.linspace(0.0, duration, round(duration / _STEP) + 1)
    phase = _rising(time) - _rising(time - length)  # [s]
    if found[1]:
        angle = 2.0 * np.pi * phase / value
        circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
        shape = RADIUS * length_size(arm) * circle
    else:
        waves, half = _waves(value, phase, seed), _FILL * (arm.targets.upper - arm.targets.lower) / 2
        shape = half * waves / np.abs(waves).max(axis=0)
    return Path(time=time, place=arm.targets.middle + shape, name=name)


def _rising(time: Array) -> Array:
    share = np.clip(time / EASE, 0.0, 1.0)
    return EASE * (share**3 - share**4 / 2) + np.maximum(time - EASE, 0.0)


def _waves(highest: float, time: Array, seed: int) -> Array:
    rng = np.random.default_rng([seed, round(1e3 * highest)])
    frequency = highest * rng.uniform(0.25, 1.0, (3, _SINES))
    start, size = rng.uniform(0.0, 2.0 * np.pi, (3, _SINES)), rng.uniform(0.5, 1.0, (3, _SINES))
    return (size * np.sin(2.0 * np.pi * frequency * time[:, None, None] + start)).sum(axis=-1)


LAG = 0.08
"""[s] behind a stream"""
EXTRAPOLATED = 0.2
"""[s] in a pause of a stream"""
_MOST_TURN = np.radians(120.0)
"""[rad] between targets of a stream"""
_RECENT = 2.0  # [s] of a stream that are looked at (chosen: more than the longest lag and what follows look back)
_NEAR_ROWS = 5  # targets of a stream whose postures are found from one (chosen: half a second at 10 Hz)


Corrected = Callable[[Array, Orientation | None], Poses]
"""Corrects targets (k, 3) [m] and orientations (k,)"""


@dataclass(eq=False)
class Stream:
    """Targets that arrive online at 10 to 100 Hz: places, or poses.

    The arm follows `LAG` behind, straight between targets, extrapolates for `EXTRAPOLATED`, then holds. `put` is
    thread-safe. A stream is followed once.
    """

    lag: float = LAG
    """[s]"""
    corrected: Corrected | None = None
    name: str = "stream"
    time: list[float] = field(default_factory=list)
    """[s] arrivals on the clock of the run"""
    rows: list[Array] = field(default_factory=list)
    """places (3,) [m], followed by the unit direction (3,) or quaternion (4,) of poses"""
    axis: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]), repr=False)
    """(3,) tool axis in the tool frame"""

    def __post_init__(self) -> None:
        self._weight, self._now, self._lock = 0.0, 0.0, Lock()
        if not 0.0 <= self.lag <= 1.0:
            raise InputError(f"stream: the lag must be between 0 and 1 s, got {self.lag}")

    def put(self, target: Sequence[float] | Array | Pose, time: float | None = None) -> None:
        """Add a ``target``, (3,) [m] or a `Pose`, at ``time`` [s] (default: the present cycle).

        InputError for another kind than the first, a turn over 120 degrees, or an earlier time.
        """
        pose = target if isinstance(target, Pose) else None
        row = as_place("stream", target if pose is None else pose.place_m)
        turn = None if pose is None else oriented(self.axis, [pose])
        if turn is not None:
            row = np.append(row, knots_of(turn)[0])
        with self._lock:
            time, last = self._now if time is None else time, self.time[-1] if self.time else -np.inf
            if not np.isfinite(time):
                raise InputError(f"stream: a target came at {time} s, expected a finite time")
            if time < last:
                raise InputError(f"stream: a target of {time:g} s came after one of {last:g} s")
            row = self._after_last(row)
            if time == last:
                del self.time[-1], self.rows[-1]
            self.time.append(time)
            self.rows.append(row)
            self._weight = self._weight if turn is None else float(turn.weight[0])

    @property
    def followed(self) -> bool:
        """Whether an arm followed it."""
        return self._now > 0.0

    def target(self, now: float) -> Array:
        """Target (3,) [m] in force."""
        self._now = now
        return self._between(np.array([now]), now)[0, :3]

    def ahead(self, now: float, later: Array) -> Poses:
        """See `Path`."""
        self._now = now
        return self._aims(self._between(now + later - self.lag, now))

    def home(self, arm: Arm, motors: Motors | None = None) -> Array:
        """See `Path`: by the first target."""
        return _home(arm, motors, np.arange(2.0), *self.ahead(0.0, np.zeros(2)))

    def route(self) -> Route:
        """See `Path`."""
        with self._lock:
            rows, time = np.array(self.rows), np.array(self.time)
        back = rows[::-1]  # from the posture that the arm has now: each part begins near the last
        aims = np.concatenate([self._aims(back[k : k + _NEAR_ROWS])[0] for k in range(0, len(back), _NEAR_ROWS)])
        return Route(self.time[0], time - time[0], rows[:, :3], aims[::-1])

    def _aims(self, rows: Array) -> Poses:
        """Corrected targets (k, 3) [m] and orientations (k,) of ``rows`` (k, m)."""
        places, turns = rows[:, :3], None
        if rows.shape[1] > 3:
            turns = turned_as(rows[:, 3:], self.axis, self._weight)
        return (places, turns) if self.corrected is None else self.corrected(places, turns)

    def _after_last(self, row: Array) -> Array:
        """Return a ``row`` (m,) whose quaternion is on the last one's side; InputError unless it is of its kind."""
        if not self.rows:
            return row
        last = self.rows[-1]
        if len(row) != len(last):
            raise InputError(
                "stream: the first target decides whether all have a direction, a whole orientation, or none; put "
                "targets of one kind, or take a stream for each"
            )
        whole, cosine = len(row) == 7, np.clip(row[3:] @ last[3:], -1.0, 1.0)
        turned = 2.0 * np.arccos(abs(cosine)) if whole else np.arccos(cosine)
        if len(row) > 3 and turned > _MOST_TURN:
            raise InputError(
                f"stream: from one target to the next the tool would turn by {np.degrees(turned):.0f} deg, at most 120 "
                "were expected; put targets between them"
            )
        return np.append(row[:3], -row[3:]) if whole and cosine < 0.0 else row

    def _between(self, time: Array, now: float) -> Array:
        """Rows (k, m) at ``time`` (k,) [s] by what arrived until ``now``."""
        with self._lock:
            count = bisect_right(self.time, now)
            first = max(0, bisect_right(self.time, now - _RECENT, hi=count) - 2)
            times, known = np.array(self.time[first:count]), np.array(self.rows[first:count])
        if not len(times):
            raise InputError("stream: nothing has come yet; put the first target before the arm moves")
        if len(times) == 1:
            return np.broadcast_to(known[0], (len(time), known.shape[1]))
        recent = min(int(np.searchsorted(times, times[-1] - 0.1)), len(times) - 2)  # a line through 0.1 s, or two
        velocity = np.polyfit(times[recent:], known[recent:], 1)[0]
        beyond = np.clip(time - times[-1], 0.0, EXTRAPOLATED)[:, None]
        return interpolated(time, times, known) + beyond * velocity


Guide: TypeAlias = Path | Stream
"""Target of one arm over time: `home`, `target`, `ahead` in ``later`` (k,) [s] than ``now``, the `route` at the end"""


class PathReference(Reference):
    """Paths and streams of B arms. Where a stream asks for the impossible, its arm holds the last possible posture."""

    def __init__(
        self,
        arm: Arm,
        guides: Sequence[Guide],
        home: Array | None = None,
        *,
        motors: Motors | None = None,
        message: Callable[[str], None] | None = None,
    ) -> None:
        """``home`` (n,) or (B, n) [rad]: postures stay near to it; None: rest. ``message`` hears of the first hold."""
        self._arm, self._guides, self.count = arm, guides, len(guides)
        self.waits = np.array([isinstance(guide, Path) for guide in guides])
        self._loads, self._message = _loads(arm, motors), message
        now = np.zeros(self.count)
        places, turns = self.poses(now, now[None])
        self._now, self._later = (PathPostures(arm, places[0], turns and turns[0], home) for _ in range(2))
        self._held = {postures: postures.last for postures in (self._now, self._later)}

    def advance(self, now: ControlInput) -> ControlInput:
        """See `Reference`."""
        since = now.since_target
        place = np.stack([guide.target(float(time)) for guide, time in zip(self._guides, since, strict=True)])
        aims, turns = self.poses(since, np.zeros((1, self.count)))
        goal, held = self._possible(self._now, aims, turns)
        if held.any() and self._message is not None:
            b = int(held[0].argmax())
            why = _why(self._arm, self._now.last[b], aims[0, b], self._loads)
            self._message(f"stream: {why}; the arm holds until it can follow again")
            self._message = None
        return replace(
            now,
            goal=goal[0],
            target=np.where(held[0, :, None], tcp_position(self._arm, goal[0]), aims[0]),
            turn=turns and replace(turns[0], weight=np.where(held[0], 0.0, turns.weight[0])),
            place=place,
            aim=aims[0],
            ahead=lambda later: self._possible(self._later, *self.poses(since, later))[0],
        )

    def _possible(self, postures: PathPostures, places: Array, turns: Orientation | None) -> tuple[Array, Mask]:
        """Postures (k, B, n) [rad] of ``places`` (k, B, 3) [m], and whether (k, B) they are held ones."""

        def impossible(way: Array) -> Mask:
            bad = np.zeros(places.shape[:2], bool)
            for b in np.flatnonzero(~self.waits):
                bad[:, b] = _impossible(self._arm, way[:, b], places[:, b], turns and turns[:, b], self._loads)[0]
            return bad

        way, last, middle = np.array(postures.at(places, turns)), self._held[postures], len(places) // 2
        held = impossible(way)
        if held.any():  # the search may have gone to another branch meanwhile
            postures.last = last
            other = postures.at(places, turns)
            way = np.where((held & ~impossible(other))[..., None], other, way)
            held = impossible(way)
        postures.last = way[middle].copy()
        for k in range(len(way)):
            last = way[k] = np.where(held[k, :, None], last, way[k])
        self._held[postures] = way[middle]
        return way, held

    def poses(self, now: Array, later: Array) -> Poses:
        """Corrected targets (k, B, 3) [m] and orientations (k, B), ``later`` (k, B) [s] than ``now`` (B,)."""
        columns = zip(self._guides, now, later.T, strict=True)
        places, turns = zip(*(guide.ahead(float(time), column) for guide, time, column in columns), strict=True)
        known = [turn for turn in turns if turn is not None]
        return np.stack(places, axis=1), stacked(known, axis=1) if known else None
