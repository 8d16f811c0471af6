"""Postures to measure an arm at, the most informative first, devices, and the way from posture to posture.

Each posture lessens the tool's variance most (I-optimal design; Atkinson and Donev, Optimum Experimental Designs, 1992,
chapter 10). Joints approach alternately from below and above.
"""

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import (
    Arm,
    Array,
    Mask,
    Motors,
    PlanningError,
    collides,
    gravity_torque,
    heights,
    levers,
    plan,
    solve_position,
    tcp_position,
)
from rejoint.arms.kinematics import floating
from rejoint.arms.postures import comfortable_postures
from rejoint.arms.workspace import least_load, length_size, reach, rising_frames
from rejoint.control.comparison.protocols import reversal
from rejoint.control.guard import GuardLimits
from rejoint.control.recording import Recording
from rejoint.control.robot import Robot
from rejoint.control.start import Stance, begin, move
from rejoint.diagnosis.calibration.calibration import (
    PLAY,
    PLAY_SIGMA,
    Belief,
    Calibration,
    DisplacementLayout,
    PriorCase,
    belief,
    floor_of,
    scatter,
)
from rejoint.diagnosis.calibration.fit import earlier
from rejoint.diagnosis.calibration.measurements import NOISE, Measurements
from rejoint.logs.joints import TIME_UNITS
from rejoint.system.errors import LOGGER, FileError, InputError, NotReadyError
from rejoint.system.files import MEGABYTE, digest, reading, require_file
from rejoint.system.progress import Progress, no_progress
from rejoint.system.records import entity
from rejoint.system.stopping import check, noted
from rejoint.system.textfile import LENGTHS, split_unit

CANDIDATES = 300
"""Postures to choose from; chosen"""
BEFORE = np.radians(6.0)
"""[rad] of each approach; chosen: three times the play"""
MARGIN = 0.05
"""Part of a joint's range kept from each limit; chosen"""
CLEARANCE = 0.03
"""[m] above the floor at a myCobot 280's reach; chosen: worn arms sag"""
WITHIN = 100
"""Candidates in the region of targets; chosen"""
LINKS = 0.3
"""Scale of the links' errors for the choice; chosen: little is lost with exact links"""
_WIDEST = PLAY + 2.0 * PLAY_SIGMA  # [rad] play that a joint may have
_PLACES = 32  # postures in the region of targets, and as many elsewhere, over which the error is expected (chosen)


@entity
class Suggestion:
    """Postures to visit in order."""

    postures: Array
    """(K, n) [rad]"""
    posture: NDArray[np.int64]
    """(K,) visits of one posture share a number"""

    @property
    def digest(self) -> str:
        """Digest of the postures, to a microradian."""
        return digest(np.round(1e6 * self.postures).astype("<i8").tobytes())


def before(posture: Array, visit: int) -> Array:
    """Where visit number ``visit`` comes to a ``posture`` (n,) [rad] from: below and above in turn."""
    return posture - BEFORE * (-1.0) ** visit


def suggest(
    arm: Arm,
    count: int,
    *,
    visits: int = 2,
    sigma: float = 5e-4,
    prior: Calibration | None = None,
) -> Suggestion:
    """Choose ``count`` visits for measurements of ``sigma`` [m] per coordinate, ``visits`` (1 or 2) per posture.

    InputError for too few free postures.
    """
    known = earlier(arm, prior) if prior else belief(arm, PriorCase(twist=LINKS))
    postures = np.concatenate(_candidates(arm, 0))
    if len(postures) * visits < count:
        raise InputError(
            f"arm {arm.name}: only {len(postures)} postures are free of limits, floor and collisions, {count} are to "
            "be measured; ask for fewer"
        )
    slopes, noises = _seen(arm, known, postures, sigma)
    covariance = np.linalg.inv(known.precision).astype(float)
    places = [np.random.default_rng(0).permutation(one)[:_PLACES] for one in _candidates(arm, 1)]
    region = _seen(arm, known, np.concatenate(places), 0.0)[0]
    weight = np.einsum("pik,pil->kl", region, region)
    chosen = list[int]()
    while len(chosen) < count:
        best = chosen[-1] if len(chosen) % visits else _most_telling(slopes, noises, covariance, weight, chosen)
        covariance = narrowed(covariance, slopes[best], noises[best])
        chosen.append(best)
    return Suggestion(postures=postures[chosen], posture=np.unique(chosen, return_inverse=True)[1])


def _candidates(arm: Arm, seed: int) -> tuple[Array, Array]:
    """Free postures (C, n) [rad] in the region of targets, and elsewhere, approachable from both sides."""
    rng = np.random.default_rng(seed)
    (inside, most), anywhere = _inside(arm, rng), comfortable_postures(arm)
    ways = np.stack([anywhere - BEFORE, anywhere, anywhere + BEFORE])
    light = anywhere[(np.abs(gravity_torque(arm, ways)) <= most).all(axis=(0, 2))]
    within = _approachable(arm, inside)[:WITHIN]
    return within, _approachable(arm, rng.permutation(light))[: CANDIDATES - len(within)]


def _inside(arm: Arm, rng: np.random.Generator) -> tuple[Array, Array]:
    """Postures (C, n) [rad] in the region of targets, and the torques (n,) [N m] with which motors hold them."""
    solution = solve_position(arm, arm.targets.sample(rng, (CANDIDATES,)), arm.rest)
    inside = solution.q[solution.converged]
    return inside, np.abs(gravity_torque(arm, inside)).max(axis=0, initial=floating(arm))


def _approachable(arm: Arm, q: Array) -> Array:
    """Those of postures (C, n) [rad] that are free, and from both sides, where play hardly moves the tool."""
    free = [_free(arm, q - away) for away in (0.0, BEFORE, -BEFORE)]
    loads = [gravity_torque(arm, q + side * 0.5 * _WIDEST) for side in (1.0, -1.0)]
    either = (np.minimum(*loads) < -floating(arm)) & (np.maximum(*loads) > floating(arm))
    either &= _WIDEST * levers(arm, q) > floor_of(arm)
    return q[np.logical_and.reduce(free) & ~either.any(axis=1)]


def _free(arm: Arm, q: Array) -> Mask:
    """Which postures (C, n) keep clear of limits, floor and collisions."""
    room = MARGIN * (arm.upper - arm.lower)
    inside = ((q > arm.lower + room) & (q < arm.upper - room)).all(axis=1)
    moving = np.append(rising_frames(arm), True)
    above = (heights(arm, q)[:, moving] > arm.floor + CLEARANCE * length_size(arm)).all(axis=1)
    return inside & above & ~collides(arm, q)


def _seen(arm: Arm, known: Belief, postures: Array, sigma: float) -> tuple[Array, Array]:
    """Return derivatives (C, 3, k) and covariances (C, 3, 3) of the tool."""
    layout = DisplacementLayout(arm)
    slope = layout.linearised(known.mean, postures)[1][:, :3]
    believed = layout.displacement(known.mean)
    variance = np.diag(np.linalg.inv(known.precision))[layout.at("play")]
    noise = scatter(arm, replace(believed, play=np.hypot(believed.play, np.sqrt(variance))), postures)
    return slope, noise[:, :3, :3] + (sigma**2 + floor_of(arm) ** 2) * np.eye(3)


def _most_telling(slope: Array, noise: Array, covariance: Array, weight: Array, chosen: list[int]) -> int:
    """Candidate that lessens the trace of ``weight`` (k, k) times ``covariance`` (k, k) most.

    Candidates have ``slope`` (C, d, k) and ``noise`` (C, d, d).
    """
    told = slope @ covariance
    gain = np.linalg.solve(told @ slope.mT + noise, told @ weight @ told.mT)
    variance = np.trace(gain, axis1=1, axis2=2)
    variance[chosen] = -np.inf
    return int(np.argmax(variance))


def narrowed(covariance: Array, slope: Array, noise: Array) -> Array:
    """Return the ``covariance`` (k, k) after a measurement with derivative (d, k)."""
    told = covariance @ slope.T
    return covariance - told @ np.linalg.solve(slope @ told + noise, told.T)


SPAN = 0.5
"""[s] of a tracker's newest rows that are averaged; chosen"""
PATIENCE = 5.0
"""[s] without new rows of a tracker that is off; chosen"""
TRACK_MOST = 1000 * MEGABYTE
"""Largest tracker file; chosen: a day at 100 Hz"""
FAR = 0.08
"""Share of summed link lengths of an implausible coordinate; chosen: three times a worn arm's error"""
_TAIL = 64_000  # [bytes] of its end (chosen: 500 rows)


@dataclass(frozen=True)
class Stop:
    """A posture to measure in."""

    number: int
    """from 1"""
    total: int
    believed: Array
    """(3,) [m] tool by encoders, in the base frame"""
    again: str = ""
    """why again, or empty"""

    @property
    def question(self) -> str:
        """What is asked of the user who measures."""
        x, y, z = 1e3 * self.believed
        return (
            f"{self.again and f'{self.again}. '}Measurement {self.number} of {self.total}. The encoders see the tool "
            f"at {x:.1f} {y:.1f} {z:.1f} mm. Where is it? Type x y z in mm, - for one that you did not measure; empty "
            "leaves the posture out."
        )


class Gauge(Protocol):
    """A device that measures the tool of a stationary arm."""

    source: str
    """as in `Measurements`"""
    frame: str
    """``base``, or the name of another frame of its points"""
    sigma: float
    """[m] per coordinate"""

    def measure(self, robot: Robot, stop: Stop) -> Array:
        """Tool (3,) [m]; NaN where a coordinate was not measured."""


@runtime_checkable
class FilmingGauge(Protocol):
    """A device that takes pictures of a stationary arm, as `rejoint.camera` does."""

    @property
    def postures(self) -> int:
        """Default number of postures."""

    @property
    def film(self) -> Callable[..., Any]:
        """Takes the pictures, as `rejoint.camera.filming.CameraGauge.film`."""


@dataclass(kw_only=True)
class EmulatedGauge:
    """Reads the tool of an emulated arm, with noise."""

    sigma: float = NOISE
    seed: int
    source: str = "emulated"
    frame: str = "base"

    @cached_property
    def _rng(self) -> np.random.Generator:
        return np.random.default_rng([self.seed, 13])

    def measure(self, robot: Robot, stop: Stop) -> Array:  # noqa: ARG002 - it knows by itself
        """Return true tool (3,) [m] plus noise."""
        place = robot.true_tcp()[0]
        if not np.isfinite(place).all():
            raise InputError(
                "calibration: this arm does not tell where its tool is; measure it with touch or a tracker"
            )
        return place + self._rng.normal(0.0, self.sigma, 3)


@dataclass(kw_only=True)
class TouchGauge:
    """Asks the user, who measures with a ruler."""

    ask: Callable[[Stop], str]
    """answers x, y, z in millimetres, ``-`` for none"""
    sigma: float = NOISE
    source: str = "touch"
    frame: str = "base"

    def measure(self, robot: Robot, stop: Stop) -> Array:
        """Ask for the tool (3,) [m], again if implausible."""
        doubted = np.full(3, np.inf)
        while True:
            answer = self.ask(stop)
            try:
                point = parse_point(answer)
            except InputError as error:
                stop = replace(stop, again=str(error))
                continue
            off = np.nanmax(np.abs(point - stop.believed), initial=0.0)
            if self.frame != "base" or off <= FAR * reach(robot.arm) or np.array_equal(point, doubted, equal_nan=True):
                return point
            doubted = point
            stop = replace(
                stop,
                again=f"{answer.strip()} is {1e3 * off:.0f} mm from where the encoders see the tool, along one axis; "
                "check sign, unit and axes, and type it again if it is right",
            )


def parse_point(text: str) -> Array:
    """Read x, y and z in millimetres, ``-`` for none; returns (3,) [m].

    Between blanks or semicolons a comma is a decimal point.
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
    if np.nanmax(np.abs(point), initial=0.0) > 10.0:
        raise InputError(f"{text.strip()!r} are not millimetres of an arm on a table")
    return point


@dataclass(kw_only=True)
class TrackerGauge:
    """Reads the end of a tracker's CSV file: time, x, y and z, with units as in other tables."""

    path: Path
    unit: str = "mm"
    """where titles name none"""
    sigma: float = NOISE
    frame: str = "tracker"
    source: str = "tracker"
    wait: Callable[[float], None] = time.sleep

    def __post_init__(self) -> None:
        if self.unit not in LENGTHS:
            raise InputError(f"tracker: the unit is {' or '.join(LENGTHS)}, got {self.unit!r}")
        self._newest()

    def measure(self, robot: Robot, stop: Stop) -> Array:  # noqa: ARG002 - it only has to stand
        """Mean (3,) [m] of the next `SPAN` seconds."""
        before, waited = self._newest()[-1, 0], 0.0
        while waited < PATIENCE + SPAN:
            self.wait(SPAN)
            waited += SPAN
            rows = self._newest()
            fresh = rows[rows[:, 0] > before]
            if len(fresh) and fresh[-1, 0] - before >= 0.8 * SPAN:
                return fresh[:, 1:].mean(axis=0)
        raise FileError(
            self.path, f"no new rows for {waited:.1f} s", "start the tracker, or look whether it sees the tool"
        )

    def _newest(self) -> Array:
        """Newest rows (T, 4) time [s], x, y, z [m]."""
        with reading(self.path, "cannot be read", "start the tracker first"):
            require_file(self.path, TRACK_MOST, "begin a new file")
            with self.path.open("rb") as file:
                head = file.readline(4096).decode().strip()
                file.seek(max(self.path.stat().st_size - _TAIL, len(head)))
                text = file.read().decode(errors="replace")
        titles, wanted = [title.strip() for title in head.casefold().split(",")], ("time", "x", "y", "z")
        names, units = zip(*(split_unit(one, TIME_UNITS if "time" in one else LENGTHS) for one in titles), strict=True)
        if {*wanted} - {*names}:
            raise FileError(self.path, f"columns {head!r}, expected time, x, y, z", "name them in its first line")
        places = [names.index(name) for name in wanted]
        lines = text.splitlines()[1:-1]  # the first and the last may be cut
        with warnings.catch_warnings(action="ignore"):  # of lines that are no rows, which are left out
            table = np.genfromtxt(lines, delimiter=",", usecols=places, invalid_raise=False).reshape(-1, 4)
        table = table[np.isfinite(table).all(axis=1)]
        if not len(table):
            raise FileError(self.path, "no rows yet", "start the tracker, or look whether it sees the tool")
        ticks, *lengths = (units[place] for place in places)
        return table * [1.0 / TIME_UNITS[ticks or "s"], *(LENGTHS[unit or self.unit] for unit in lengths)]


SPEED = 0.5
"""[rad/s] of the fastest joint; chosen"""
SETTLE = 1.5
"""[s] for an arm to settle; chosen"""
WINDOW = 0.4
"""[s] at its end whose readings are averaged; chosen"""
MOVED = np.radians(2.0)
"""[rad] motion that spoils a measurement; chosen: a centimetre at the tool"""
TRIES = 3
"""Attempts per posture if the arm moved; chosen"""


@contextmanager
def kept(measured: Callable[[], Path | None], *, fresh: bool, more: str = "") -> Iterator[None]:
    """Add to an error in which file there is what was ``measured``, and what goes on there."""
    try:
        yield
    except BaseException as error:
        if file := measured():
            same = f"the same command{' without --fresh' * fresh} goes on there"
            error.add_note(f"What was measured until then is kept ({file}); {same}{more}")
        raise


def log_resumed(file: Path, done: str) -> None:
    """Log that a session resumes, and how to restart it."""
    written = datetime.fromtimestamp(file.stat().st_mtime)
    LOGGER.warning(
        "Going on with what was interrupted at %s: %s (%s). Where arm or gauge were moved since, "
        "begin again: rejoint calibrate ROBOT RUN --fresh.",
        f"{written:%Y-%m-%d %H:%M}",
        done,
        file,
    )


class StandingDrive:
    """Moves one arm to postures, slowly and guarded; it begins with the first."""

    def __init__(self, robot: Robot, limits: GuardLimits | None = None, stance: Stance | None = None) -> None:
        self.robot, self._limits, self._stance = robot, limits or GuardLimits.of(robot.arm), stance
        most = np.maximum(_inside(robot.arm, np.random.default_rng(0))[1], least_load(robot.arm))
        self._motors = Motors(limit=most, usable=most)
        self._sent: Array | None = None

    def stand(self, posture: Array, visit: int) -> Array:
        """Go to ``posture`` (n,) [rad] from the side of this ``visit``; return its reading."""
        self._go(before(posture, visit), settle=0.3, motors=self._motors)
        there = self._go(posture, settle=SETTLE)
        rows = there.time[:, 0] > there.time[-1, 0] - WINDOW
        return there.position[rows, 0].mean(axis=0)

    def rest(self) -> None:
        """Go back to rest, if the arm has moved."""
        if self._sent is not None:
            self._go(self.robot.arm.rest, settle=0.0, motors=self._motors)

    def _go(self, posture: Array, settle: float, motors: Motors | None = None) -> Recording:
        if self._sent is None:
            with noted():
                self._sent = begin(self.robot, self._limits, self._stance).command[-1]
        arm, start = self.robot.arm, self._sent[0]
        try:
            ways = [plan(arm, start, posture, motors=motors)]
        except PlanningError:
            ways = [plan(arm, *ends, motors=motors) for ends in pairwise([start, arm.rest, posture])]
        corners = np.vstack([way.start + np.cumsum(way.moves, axis=0) for way in ways])
        for corner in (*corners[:-1], posture):
            wait = settle if corner is posture else 0.0
            with noted():
                gone = move(self.robot, corner, sent=self._sent, speed=SPEED, settle=wait, limits=self._limits)
            self._sent = gone.command[-1]
        return gone


def measure(
    drive: StandingDrive,
    gauge: Gauge,
    plan: Suggestion,
    found: Measurements | None = None,
    done: int = 0,
    on_progress: Progress = no_progress,
) -> Iterator[tuple[Measurements | None, int]]:
    """Measure the tool at the postures of ``plan`` after the first ``done``, which brought ``found``.

    Yields all measurements, and the number of postures done, after each. NotReadyError for a moving arm; errors of
    `run`.
    """
    total = len(plan.posture)
    for number in range(done, total):
        on_progress(number / total, f"measurement {number + 1} of {total}")
        row = _measured(drive, gauge, plan, number)
        if row is not None:
            found = row if found is None else found.joined(row)
        yield found, number + 1


def _measured(drive: StandingDrive, gauge: Gauge, plan: Suggestion, number: int) -> Measurements | None:
    robot, again = drive.robot, ""
    for _ in range(TRIES):
        try:
            position = drive.stand(plan.postures[number], number)
        except PlanningError as error:
            LOGGER.warning("posture %d is left out: %s", number + 1, error)
            return None
        again = again and f"{again}; it is measured once more"
        point = gauge.measure(robot, Stop(number + 1, len(plan.posture), tcp_position(robot.arm, position), again))
        check()
        if not np.isfinite(point).any():
            return None
        again = _gone(robot, position)
        if not again:
            return Measurements(
                position=position[None],
                point=point[None],
                sigma=np.array([gauge.sigma]),
                posture=plan.posture[number : number + 1],
                frame=gauge.frame,
                source=gauge.source,
            )
    raise NotReadyError(f"{again}, {TRIES} times; what moves it?")


def _gone(robot: Robot, position: Array) -> str:
    with noted():
        away = np.abs(robot.read().position[0] - position)
    j = np.argmax(away)
    told = f"{robot.arm.joint_names[j]} went {np.degrees(away[j]):.0f} deg while the arm was measured"
    return told if away[j] > MOVED else ""


def in_base(found: Calibration, measured: Measurements) -> Array:
    """Measured points (M, 3) [m] in the base frame; NaN: not measured."""
    return measured.point @ found.frame[:3, :3].T + found.frame[:3, 3]


def reversals(found: Calibration, measured: Measurements) -> tuple[float, ...]:
    """Reversal values [m] at the tool (ISO 230-2) of postures with two approaches, less the encoders' part."""
    away = in_base(found, measured) - tcp_position(found.arm, measured.position)
    pairs = [away[measured.posture == number] for number in np.unique(measured.posture)]
    whole = [both for both in pairs if len(both) == 2 and np.isfinite(both).all()]
    return tuple(float(reversal(both[:1], both[1:])) for both in whole)
