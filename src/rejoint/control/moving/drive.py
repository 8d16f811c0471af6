"""What a drive achieved, to points or along a path, and learning from repetition.

Repetition adds the share of the error that repeats to the path (Wiener's filter).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from scipy.fft import dct, idct
from scipy.ndimage import gaussian_filter1d

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.rotations import REACHED_TURN, Orientation
from rejoint.control.comparison.result import Protocol
from rejoint.control.correction import (
    NOT_KNOWN,
    Modelled,
    ToolModel,
    TrueError,
    checked,
    rms,
    tool_error,
    true_error,
)
from rejoint.control.guard import Reason, Reasons, reason_names
from rejoint.control.moving.reference import Guide, Path, Route, Stream
from rejoint.control.moving.tracker import PathPostures
from rejoint.control.recording import Cycle, Recording
from rejoint.control.targets import Poses, in_words
from rejoint.logs.runlog import RunLog
from rejoint.system.numbers import interpolated
from rejoint.system.records import Readable, entity, value_type

_JUDGED = 100  # places of a path at which a model is asked for the tool (chosen: it draws from its covariance at each)


@entity
class Pass:
    """One repetition of a path."""

    encoder: Along
    """by the encoders"""
    true_error: TrueError
    """rms of the tool"""
    log: RunLog | None = None
    turned: float | None = None
    """[rad] rms; None: not asked for"""


@entity
class Followed(Readable):
    """Result of a path."""

    path: str
    controller: str
    within: float
    """[m]"""
    passes: tuple[Pass, ...]
    period: float | None
    """[s] median"""
    gaps: tuple[float, ...]
    """[s]"""

    @property
    def followed(self) -> bool:
        """Whether the last pass stayed ``within`` (rms after the lag) and turned the tool."""
        last = self.passes[-1] if self.passes else None
        return last is not None and last.encoder.rms_after <= self.within and (last.turned or 0.0) <= REACHED_TURN


def corrected(arm: Arm, guide: Guide, correction: Modelled, home: Array | None = None) -> Guide:
    """Guide of an arm near ``home`` (n,) [rad] by whose corrected targets the tool goes where ``guide`` says."""
    postures = PathPostures(arm, *guide.ahead(0.0, np.zeros(1)), home)
    if isinstance(guide, Stream):

        def correct(places: Array, turns: Orientation | None) -> Poses:
            way = postures.at(places[:, None], turns and turns[:, None])[:, 0]
            aims = checked(arm, places, places - correction.shift(way))
            return aims, turns and correction.untwisted(turns, way)

        guide.corrected = correct
        return guide
    time = guide.grid
    places, wanted = aims, turns = guide.poses(time)
    for _ in range(2):  # the second changes it by less than 0.1 mm
        way = postures.along(aims[:, None], turns and turns[:, None])[:, 0]
        aims = checked(arm, places, places - correction.shift(way))
        turns = wanted and correction.untwisted(wanted, way)
        postures.last = way[:1]
    return replace(guide, aim=Path(time=time, place=aims, turn=turns, name=guide.name))


def judge(arm: Arm, recording: Recording, guide: Guide, b: int = 0, model: ToolModel | None = None) -> Pass:
    """Errors of arm ``b``."""
    route = guide.route()
    rows, time = rows_on(recording, route, b)
    wanted = interpolated(time, route.time, route.place)
    true = norm(rows.true_tcp - wanted, axis=-1)
    few = slice(None, None, max(1, len(time) // _JUDGED))
    return Pass(
        encoder=along(time, tcp_position(arm, rows.position), route.time, route.aim),
        true_error=true_error(true, model, rows.position[few], wanted[few], rms),
        turned=rms(rows.turned) if len(time) and np.isfinite(rows.turned).all() else None,
    )


def rows_on(recording: Recording, route: Route, b: int) -> tuple[Cycle, Array]:
    """Rows (T, ...) of arm ``b`` on its route, and their times (T,) [s]."""
    rows = recording.driven(b)
    time = rows.since_target - route.begin
    there = (time >= 0.0) & (time <= route.time[-1])
    return rows.at(there), time[there]


def missed(arm: Arm, recording: Recording, guide: Path, b: int = 0) -> tuple[Array, Array]:
    """Return times (T,) [s] and encoder errors (T, 3) [m] of arm ``b`` on the way of ``guide``."""
    rows, time = rows_on(recording, guide.route(), b)
    return time, guide.aimed.at(time) - tcp_position(arm, rows.position)


_LAGS = np.arange(0.0, 0.3001, 0.005)  # [s] that are tried


@value_type
class Along:
    """Errors on a path."""

    rms: float
    """[m]"""
    largest: float
    """[m]"""
    lag: float
    """[s] shift of the path for the least rms"""
    rms_after: float
    """[m] after that shift"""
    largest_after: float
    """[m]"""


def along(time: Array, tool: Array, at: Array, places: Array) -> Along:
    """Compare the ``tool`` (T, 3) [m] at ``time`` (T,) [s] with ``places`` (K, 3) [m] at ``at`` (K,) [s]."""
    errors = [norm(tool - interpolated(time - lag, at, places), axis=-1) for lag in _LAGS]
    sizes = [rms(error) for error in errors]
    best = np.argmin(sizes)
    return Along(
        rms=sizes[0],
        largest=float(errors[0].max()),
        lag=float(_LAGS[best]),
        rms_after=sizes[best],
        largest_after=float(errors[best].max()),
    )


DIFFERENT = 0.35e-3
"""[m/sqrt(Hz)] difference between repetitions (measured)"""
BELIEVED = 2.0
"""Factor on it (chosen)"""
DOUBT = 2.0
"""Weight against repeated errors (chosen)"""
HIGHEST = 3.0
"""[Hz] of learned errors (chosen)"""
MOST = 0.02
"""[m] largest shift of the path (chosen)"""
_WIDTH = 0.3  # [Hz] over which shares are alike (chosen: six turns of the slowest standard path)


def next_aim(path: Path, spectra: list[Array], aim: Path, time: Array, error: Array) -> Path:
    """Aim of the next pass of ``path`` after errors (T, 3) [m] of ``aim`` at ``time`` (T,) [s].

    ``spectra`` receives the cosine transform (K, 3) of where to aim, less the path.
    """
    grid = path.grid
    place, turn = path.poses(grid)
    spectra.append(dct(aim.at(grid) - place + interpolated(grid, time, error), axis=0))
    step, count = grid[1] - grid[0], 2 * len(grid)
    found, times = np.stack(spectra), len(spectra)
    mean, frequency = found.mean(axis=0), np.fft.rfftfreq(count, step)[:-1]
    width = _WIDTH / frequency[1]
    believed = 1.5 * DIFFERENT**2 * count / step  # of all three axes, as a power of this spectrum
    differs = _smooth(((found - mean) ** 2).sum(axis=(0, 2)), width)
    differs = (BELIEVED * believed + differs) / (BELIEVED + times - 1)
    power = np.maximum(_smooth((mean**2).sum(axis=-1), width), np.finfo(float).tiny)
    share = np.clip(1.0 - DOUBT * differs / times / power, 0.0, 1.0) / (1.0 + (frequency / HIGHEST) ** 8)
    shift = idct(mean * share[:, None], axis=0)
    size = norm(shift, axis=-1, keepdims=True)
    place = place + shift * np.minimum(1.0, MOST / np.maximum(size, MOST))
    return Path(time=grid, place=place, turn=turn, name=path.name)


def _smooth(values: Array, width: float) -> Array:
    """Average ``values`` (F,) over about ``width``."""
    return gaussian_filter1d(values, width, radius=int(np.ceil(3.0 * width)))


REACHED = Protocol.threshold
"""[m]"""

_OFTEN = 0.5  # share of its cycles from which a remark names the guard (chosen)


@entity
class Deployment:
    """Targets of a deployment."""

    controller: str
    targets: Array
    """(K, 3) [m]"""
    dwell: float
    """[s]"""
    within: float = REACHED
    """[m] accepted encoder error"""
    turns: Orientation | None = None
    """(K,); None: any"""


@value_type
class Visit:
    """Result at one target."""

    target: tuple[float, float, float]
    """[m]"""
    error: float | None = None
    """[m] by the encoders; None: not tried"""
    true_error: TrueError = NOT_KNOWN
    reached: bool = False
    remark: str = "not tried"
    """why missed"""
    sightings: int = 0
    """accepted camera detections"""
    seen_error: float | None = None
    """[m] tool error by the camera; None: not seen"""
    orientation: str = ""
    """wanted, in words, or empty"""
    turned: float | None = None
    """[rad]"""


@entity
class Deployed(Readable):
    """Result of a deployment."""

    controller: str
    visits: tuple[Visit, ...]
    period: float | None
    """[s] median"""
    gaps: tuple[float, ...]
    """[s]"""
    within: float = REACHED
    """[m] accepted encoder error"""
    log: RunLog | None = None
    """None: it ended early"""

    @property
    def missed(self) -> tuple[int, ...]:
        """Numbers of missed targets, from 1."""
        return tuple(number for number, visit in enumerate(self.visits, start=1) if not visit.reached)

    @property
    def error(self) -> float:
        """[m] mean encoder error of the targets that were tried; NaN: none was."""
        errors = [visit.error for visit in self.visits if visit.error is not None]
        return sum(errors) / len(errors) if errors else np.nan


def judge_targets(
    arm: Arm,
    recording: Recording,
    job: Deployment,
    model: ToolModel | None = None,
    *,
    overloaded: Callable[[Array], str] = lambda _: "",
    sightings: Sequence[tuple[int, float | None]] = (),
    ended: bool = False,
) -> Deployed:
    """Judge each target.

    ``overloaded`` says why a posture (n,) [rad] is too heavy, or nothing; ``sightings`` as
    `rejoint.control.seeing.Seen.visits`; ``ended``: by an error.
    """
    rows, gap, visits = recording.driven(), recording.gaps(), []
    errors = tool_error(arm, rows.position, rows.aim)
    for k, target in enumerate(job.targets):
        words = "" if job.turns is None else in_words(job.turns[k])
        visit = Visit(target=tuple(target.tolist()), orientation=words)
        here = np.flatnonzero(rows.target_index == k)
        if len(here):
            last, early = int(here[-1]), ended and k == rows.target_index[-1]
            error, turned, paused = float(errors[last]), float(rows.turned[last]), float(gap[here].max())
            far, askew = not (early or error < job.within), turned > REACHED_TURN
            remarks = {
                "ended early": early,
                f"still {1e3 * error:.0f} mm off after {job.dwell:g} s{_held_back(rows.reasons[here])}": far,
                (why := overloaded(rows.position[last])): far and bool(why),
                f"a pause of {paused:.1f} s without commands": paused > 0.0,
                f"still turned {np.degrees(turned):.0f} deg off": askew,
            }
            count, seen = sightings[k] if k < len(sightings) else (0, None)
            off = norm(target - rows.true_tcp[[last]], axis=-1)
            true = true_error(off, model, rows.position[[last]], target[None])
            if seen is not None and true.how != "known":
                true = TrueError(how="measured", value=seen)
            visit = replace(
                visit,
                error=error,
                true_error=true,
                sightings=count,
                seen_error=seen,
                reached=not (far or early or askew),
                remark="; ".join(remark for remark, said in remarks.items() if said),
                turned=None if np.isnan(turned) else turned,
            )
        visits.append(visit)
    return Deployed(controller=job.controller, visits=tuple(visits), within=job.within, **recording.timing())


def _held_back(reasons: Reasons) -> str:
    often = [
        reason_names(reason)[0]
        for reason in Reason
        if reason != Reason.GAP and np.mean((reasons & reason) != 0) > _OFTEN
    ]
    return f", held back by its limits of {' and '.join(often)}" if often else ""
