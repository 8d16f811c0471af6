"""Driving an arm behind a target that moves, and saying how well it followed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.orientation import REACHED_TURN, Orientation
from rejoint.control.accuracy import NOT_KNOWN, ToolModel, TrueError, modelled
from rejoint.control.controller import ControlInput, Controller
from rejoint.control.correction import Modelled, checked
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import Schedule, follow
from rejoint.control.moving.errors import Along, along, interpolated
from rejoint.control.moving.path import Path, path_of
from rejoint.control.moving.posture import PathPostures
from rejoint.control.moving.routes import Ahead, Corrected, Guide, Routes, Stream
from rejoint.control.playback import move
from rejoint.control.recording import OnCycle, Recording
from rejoint.control.robot import Mask, Robot
from rejoint.logs.runlog import RunLog

Rows = NDArray[np.intp]
GiveUp = Callable[[ControlInput], Mask]
"""Ends a motion early, see `rejoint.control.loop.Schedule`"""

_STEP = 0.02  # [s] between the places of a path that is corrected or judged
_JUDGED = 100  # places of a path at which a model is asked for the tool (chosen: it draws from its covariance at each)
_APPROACH = 15  # of those back is where an arm came from: 0.3 s (chosen: longer than play takes to turn round)


@dataclass(frozen=True, kw_only=True, eq=False)
class Pass:
    """One time along a path."""

    encoder: Along
    """errors by the encoders"""
    true_error: TrueError
    """root mean square of the tool itself, without a lag, and how it is known"""
    log: RunLog | None = None
    turned: float | None = None
    """[rad] root mean square of the orientation error by the encoders, without a lag; None where none was asked for"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Followed:
    """What became of a path."""

    path: str
    controller: str
    within: float
    """[m]"""
    passes: tuple[Pass, ...]
    """in order; more than one where the arm learned from repetition"""
    period: float | None
    """[s] middle of the measured control periods"""
    gaps: tuple[float, ...]
    """[s] lengths of the pauses in the answers"""

    @property
    def followed(self) -> bool:
        """Whether the last pass was ``within``, root mean square after the best single lag, and the tool turned so."""
        last = self.passes[-1] if self.passes else None
        return last is not None and last.encoder.rms_after <= self.within and (last.turned or 0.0) <= REACHED_TURN


def corrected_path(arm: Arm, path: Path, correction: Modelled, home: Array | None = None) -> Path:
    """Return the aims of a path, so that the tool itself is on it where the arm keeps near to ``home`` (n,) [rad]."""
    time = np.linspace(0.0, path.duration, max(2, round(path.duration / _STEP) + 1))
    places = path.at(time)
    aims = places
    wanted = turns = path.turn_at(time)
    postures = PathPostures(arm, places[:1], turns and turns[:1], home)
    for _ in range(2):  # the second changes it by less than 0.1 mm
        way = postures.along(aims[:, None], turns and turns[:, None])[:, 0]
        came = np.concatenate([way[:1].repeat(_APPROACH, axis=0), way[:-_APPROACH]])[: len(way)]
        aims = checked(places, places - correction.shift(way, came))
        turns = None if wanted is None else correction.untwisted(wanted, way, came)
        postures.last = way[:1]
    return path_of(time, aims, turns, path.name)


def corrector(
    arm: Arm, correction: Modelled, start: Array, turn: Orientation | None = None, home: Array | None = None
) -> Corrected:
    """Return what turns targets of a stream into aims, from ``start`` (3,) [m] and ``turn`` () on, near ``home``."""
    postures = PathPostures(arm, start[None], turn and turn[None], home)

    def correct(places: Array, turns: Orientation | None) -> tuple[Array, Orientation | None]:
        way = postures.at(places[:, None], turns and turns[:, None])[:, 0]
        aims = checked(places, places - correction.shift(way))
        return aims, None if turns is None else correction.untwisted(turns, way)

    return correct


def approach(
    robot: Robot, posture: Array, sent: Array, limits: GuardLimits | None = None, *, give_up: GiveUp | None = None,
    on_cycle: OnCycle | None = None,
) -> Recording:  # fmt: skip
    """Bring the arm slowly from the command ``sent`` (1, n) [rad] to the ``posture`` (n,) [rad] of a path's start."""
    return move(robot, posture, sent=sent, settle=0.5, limits=limits, give_up=give_up, on_cycle=on_cycle)


def follow_guide(
    robot: Robot, controller: Controller, guide: Guide, duration: float, sent: Array, *,
    limits: GuardLimits | None = None, give_up: GiveUp | None = None, on_cycle: OnCycle | None = None,
) -> Recording:  # fmt: skip
    """Drive one arm behind a guide for ``duration`` [s]; ``sent`` (1, n) [rad] is the command in force."""
    schedule = Schedule(dwell=duration, sent=sent, give_up=give_up)
    return follow(robot, controller, Routes([guide]), schedule, limits=limits, on_cycle=on_cycle)


def judge(arm: Arm, recording: Recording, guide: Ahead | Stream, b: int = 0, model: ToolModel | None = None) -> Pass:
    """Say how well arm ``b`` followed; where nobody sees its tool, by what the ``model`` expects of that."""
    rows, time = rows_on(recording, guide, b)
    tool = tcp_position(arm, recording.position[rows, b])
    at, places, aims = route_of(guide)
    true = np.linalg.norm(recording.true_tcp[rows, b] - interpolated(time, at, places), axis=-1)
    known = bool(np.isfinite(true).all()) and len(true) > 0
    expected = NOT_KNOWN if model is None else _expected(model, recording.position[rows, b], time, at, places)
    turned = recording.turned[rows, b]
    return Pass(
        encoder=along(time, tool, at, aims),
        true_error=TrueError(how="known", value=float(np.sqrt((true**2).mean()))) if known else expected,
        turned=float(np.sqrt((turned**2).mean())) if len(turned) and np.isfinite(turned).all() else None,
    )


def _expected(model: ToolModel, position: Array, time: Array, at: Array, places: Array) -> TrueError:
    """Root mean square of what a model says of the tool at ``position`` (T, n) [rad] and ``time`` (T,) [s]."""
    few = slice(None, None, max(1, len(time) // _JUDGED))
    found = modelled(model, position[few], interpolated(time[few], at, places))
    if not np.isfinite(found).all() or not found.size:
        return NOT_KNOWN
    value, low, high = (float(np.sqrt((part**2).mean())) for part in found)
    return TrueError(how="modelled", value=value, low=low, high=high)


def rows_on(recording: Recording, guide: Ahead | Stream, b: int = 0) -> tuple[Rows, Array]:
    """Return the rows of a recording (T,) in which arm ``b`` was on its path, and the times (T,) [s] on that."""
    begin = guide.lead_in if isinstance(guide, Ahead) else guide.time[0]
    length = guide.path.duration if isinstance(guide, Ahead) else guide.time[-1] - begin
    time = recording.since_target[:, b] - begin
    rows = np.flatnonzero(recording.active[:, b] & (time >= 0.0) & (time <= length))
    return rows, time[rows]


def route_of(guide: Ahead | Stream) -> tuple[Array, Array, Array]:
    """Return times (K,) [s], targets (K, 3) and aims (K, 3) [m] of a guide."""
    if isinstance(guide, Ahead):
        time = np.linspace(0.0, guide.path.duration, max(2, round(guide.path.duration / _STEP) + 1))
        return time, guide.path.at(time), (guide.aim or guide.path).at(time)
    targets, turns = guide.received()
    aims = targets if guide.corrected is None else guide.corrected(targets, turns)[0]
    return np.array(guide.time) - guide.time[0], targets, aims


def missed(arm: Arm, recording: Recording, guide: Ahead, wanted: Path, b: int = 0) -> tuple[Array, Array]:
    """Return times (T,) [s] and how far (T, 3) [m] arm ``b`` was from ``wanted`` by its encoders, for `Repetition`."""
    rows, time = rows_on(recording, guide, b)
    return time, wanted.at(time) - tcp_position(arm, recording.position[rows, b])
