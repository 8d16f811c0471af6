"""One arm along one path, however often: what each time is aimed at, and how well it went.

Who carries the arm, and where that is written, is another's affair: `rejoint.follow` and the arm of `rejoint.connect`
each bring a `Carrier`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array
from rejoint.arms.orientation import tool_axis
from rejoint.control.accuracy import ToolModel
from rejoint.control.comparison.targets import require_reachable
from rejoint.control.controller import Controller
from rejoint.control.correction import Modelled
from rejoint.control.moving.drive import Followed, Pass, corrected_path, corrector, judge, missed
from rejoint.control.moving.folding import home_of
from rejoint.control.moving.path import Path, read_path
from rejoint.control.moving.posture import PathPostures
from rejoint.control.moving.repeating import Repetition
from rejoint.control.moving.routes import LAG, LEAD_IN, Ahead, Stream, played, require_rate
from rejoint.control.moving.sender import Sender
from rejoint.control.moving.servos import Servos
from rejoint.control.moving.standard import is_standard, standard_path
from rejoint.control.moving.tracker import Tracker
from rejoint.control.recording import Recording
from rejoint.runs.given import Period
from rejoint.runs.run import Run
from rejoint.runs.stages.controllers import ControllerLike, make_factories
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_floats, as_within

if TYPE_CHECKING:
    from rejoint.arms.orientation import Orientation
    from rejoint.twin.twin import Twin

PathLike: TypeAlias = "Path | FilePath | ArrayLike"
"""A path, its CSV file, the name of a standard one, or (T, 4) times [s] and places [m]"""

TRACKER, SENT = "tracker", "default"
"""Names of the controller that follows by the twin, and of the path sent as it comes"""

WITHIN = 5e-3
"""[m] root mean square, after the best single lag, within which a path counts as followed (chosen: as for targets)"""

Factory = Callable[[Arm, float], Controller]
"""Makes a controller for an arm and the usual length [s] of its control periods"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Follower:
    """What follows a path."""

    name: str
    """of the controller"""
    make: Factory
    """makes it, for each time along the path"""
    home: Array | None = None
    """(n,) [rad] posture that it keeps near to; None: rest"""


@dataclass(frozen=True, kw_only=True)
class Piece:
    """One time along a path."""

    label: str
    duration: float
    """[s]"""
    number: int
    """from 0"""
    total: int


class Carrier(Protocol):
    """Drives the arm, and keeps what it does."""

    def approach(self, posture: Array, sent: Array) -> Recording:
        """Bring the arm slowly from the command ``sent`` (1, n) [rad] to the ``posture`` (n,) [rad] of a start."""

    def carry(self, guide: Ahead | Stream, controller: Controller, sent: Array, piece: Piece) -> Recording:
        """Drive the arm behind a guide; ``sent`` (1, n) [rad] is the command in force."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PathDrive:
    """What an arm is driven along paths by."""

    arm: Arm
    follower: Follower
    usual: float
    """[s] usual length of the control periods"""
    correction: Modelled | None
    within: float
    """[m] root mean square within which a path counts as followed"""
    carrier: Carrier
    model: ToolModel | None = None
    """tells how far the tool itself is off, where nobody sees it"""

    def along(self, path: Path, repeat: int, rate: float | None, sent: Array) -> Followed:
        """Go along a path, ``repeat`` times, from the command ``sent`` (1, n) [rad]; at a ``rate`` [Hz] it is told."""
        wanted = (
            path if self.correction is None else corrected_path(self.arm, path, self.correction, self.follower.home)
        )
        duration = LEAD_IN + path.duration + (0.0 if rate is None else LAG)
        aim, passes, repetition = wanted, list[Pass](), Repetition(wanted)
        last: Recording | None = None
        for number in range(repeat):
            sent = self._approach(wanted.at(0.0), wanted.turn_at(0.0), sent)
            guide = Ahead(path=path, aim=aim)
            piece = Piece(label=self._label(path.name), duration=duration, number=number, total=repeat)
            told = guide if rate is None else played(wanted, rate)
            last = self.carrier.carry(told, self.follower.make(self.arm, self.usual), sent, piece)
            done = judge(self.arm, last, Ahead(path=path, aim=wanted), model=self.model)
            passes.append(replace(done, log=last.log(0, piece.label)))
            aim, sent = repetition.learn(aim, *missed(self.arm, last, guide, wanted)), last.command[-1]
        return self._followed(path.name, passes, last)

    def behind(self, stream: Stream, duration: float, sent: Array) -> Followed:
        """Go behind a stream for ``duration`` [s], from the command ``sent`` (1, n) [rad]."""
        at_once = np.zeros(1)
        start, turns = stream.place(0.0), stream.turns(0.0, at_once)
        turn = None if turns is None else turns[0]
        if self.correction is not None and stream.corrected is None:
            stream.corrected = corrector(self.arm, self.correction, start, turn, self.follower.home)
            turns = stream.turns(0.0, at_once)
            turn = None if turns is None else turns[0]
        sent = self._approach(start, turn, sent)
        piece = Piece(label=self._label("stream"), duration=duration, number=0, total=1)
        last = self.carrier.carry(stream, self.follower.make(self.arm, self.usual), sent, piece)
        done = replace(judge(self.arm, last, stream, model=self.model), log=last.log(0, piece.label))
        return self._followed("stream", [done], last)

    def _approach(self, start: Array, turn: Orientation | None, sent: Array) -> Array:
        """Bring the arm to the place ``start`` (3,) [m] and ``turn`` (); returns the command (1, n) [rad] in force."""
        posture = PathPostures(self.arm, start[None], turn and turn[None], self.follower.home).last[0]
        return self.carrier.approach(posture, sent).command[-1]

    def _label(self, path: str) -> str:
        return f"follow/{self.follower.name}/{path}"

    def _followed(self, path: str, passes: list[Pass], last: Recording | None) -> Followed:
        period = float("nan") if last is None else last.usual_period()
        gaps = () if last is None else tuple(float(gap) for gap in last.gaps() if gap > 0.0)
        return Followed(
            path=path, controller=self.follower.name, within=self.within, passes=tuple(passes),
            period=period if np.isfinite(period) else None, gaps=gaps,
        )  # fmt: skip


def as_path(given: PathLike, arm: Arm, seed: int) -> Path:
    """Return the path itself, of its file or numbers, or the standard one of that name."""
    if isinstance(given, Path):
        return given
    if isinstance(given, str) and is_standard(given):
        return standard_path(given, arm, seed)
    if isinstance(given, str | FilePath):
        return read_path(FilePath(given))
    expected = "a Path, a file, or points (K, 4) of time [s] and x, y, z [m]"
    if isinstance(given, Iterator):
        raise InputError(
            f"path: expected {expected}, found a generator; make an array of all its points, or put them into a "
            "rejoint.Stream as they come"
        )
    points = as_floats("path", given, expected)
    if points.ndim != 2 or points.shape[-1] != 4:
        raise InputError(f"path: an array of shape {points.shape}, expected (points, 4): time [s] and x, y, z [m]")
    return Path(time=points[:, 0], place=points[:, 1:])


def followable(given: PathLike | Stream, arm: Arm, seed: int, duration: float | None) -> Path | Stream:
    """Return the stream, or the path that ``arm`` is able to follow; InputError where it cannot.

    Of a stream only the first target can be looked at ahead.
    """
    if isinstance(given, Stream):
        seconds = as_floats("follow", np.nan if duration is None else duration, "a duration in seconds")
        if seconds.shape != () or not 0.0 < seconds < np.inf:
            raise InputError("follow: a stream needs a duration in seconds for which it is followed")
        if given.followed:
            raise InputError(
                "follow: this stream was followed already, up to its last target; put targets into another"
            )
        given.axis = tool_axis(arm)
        turns = given.turns(0.0, np.zeros(1))
        require_reachable(arm, given.place(0.0)[None, None], turns and turns[None])
        return given
    if duration is not None:
        raise InputError("follow: a duration is of a stream; a path takes as long as its times say")
    path = as_path(given, arm, seed).on(arm)
    path.require_followable(arm)
    return path


def turned(given: Path | Stream) -> bool:
    """Tell whether a path, or the first target of a stream, says how the tool is to be turned."""
    start = np.zeros(1)
    return (given.turn_at(start) if isinstance(given, Path) else given.turns(0.0, start)) is not None


def require_repeatable(path: PathLike | Stream, repeat: int, rate: float | None, within: float = WITHIN) -> None:
    """Raise InputError where a path cannot be gone along ``repeat`` times, told at a ``rate``, ``within`` a length."""
    if rate is not None:
        require_rate(rate)
    as_within("follow", within)
    if (
        not isinstance(repeat, int | np.integer)
        or repeat < 1
        or (repeat > 1 and (rate is not None or isinstance(path, Stream)))
    ):
        raise InputError("follow: to be repeated at least once, and more often only where the path is known ahead")
    if rate is not None and isinstance(path, Stream):
        raise InputError("follow: a rate is of a path that is told as it goes; a stream has that of its targets")


def servos_of(twin: Twin) -> Servos:
    """Return what a tracker takes from the twin of one arm."""
    own = twin.parameters.repeat(1)
    return Servos(
        stiffness=own.stiffness, damping=own.damping, coulomb=own.coulomb, armature=own.armature,
        torque_limit=own.torque_limit, offset=own.offset, delay=own.delay,
    )  # fmt: skip


def follower_of(
    given: ControllerLike, arm: Arm, usual: Period | None, run: Run | None, twin: Twin | None
) -> Follower:  # fmt: skip
    """Return what follows under the name of a controller, or what is given."""
    if given == SENT:
        return Follower(name=SENT, make=lambda arm, period: Sender(arm))  # noqa: ARG005 - it knows no time
    if given == TRACKER:
        if twin is None:
            raise InputError(
                "follow: the tracker needs a twin; run `rejoint identify` first, or take --controller default"
            )
        servos = servos_of(twin)
        home = home_of(arm, servos)
        return Follower(
            name=TRACKER, make=lambda arm, period: Tracker(arm, servos, period=period, home=home), home=home[0]
        )
    if isinstance(given, str) and not given.endswith(".onnx"):
        raise InputError(f"no controller called {given!r} follows paths; known: {TRACKER}, {SENT}")
    ((name, make),) = make_factories([given], arm, usual, run=run, twin=twin).items()
    return Follower(name=name, make=lambda arm, period: make(arm))  # noqa: ARG005 - its own affair
