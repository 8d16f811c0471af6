"""What drives the arm of `rejoint.connect`: one open robot, one controller, one log of all its motions."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.arms import Array
from rejoint.arms.orientation import Orientation
from rejoint.control.contract import check_controller_period
from rejoint.control.controller import ControlInput, Controller
from rejoint.control.correction import Modelled
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import Schedule
from rejoint.control.loop import run as drive
from rejoint.control.moving.drive import GiveUp, approach, follow_guide
from rejoint.control.moving.routes import Ahead, Stream
from rejoint.control.playback import Playback
from rejoint.control.recording import PIECE, Cycle, Recording, recording_of
from rejoint.control.robot import Mask, Robot
from rejoint.control.start import Stance, begin
from rejoint.runs.run import Run
from rejoint.runs.stages.longlog import LongLog
from rejoint.runs.stages.pathdrive import Piece

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable


LABEL = "move"
"""Names the logs"""


class EndedError(Exception):
    """A motion was asked to end, and has ended: no error."""


@dataclass(kw_only=True, eq=False)
class ArmDrive:
    """Drives one arm from motion to motion, and remembers the command in force."""

    run: Run
    robot: Robot
    controller: Controller
    turning: Controller
    """drives to poses; the same, where that turns tools"""
    name: str
    """of the controller"""
    limits: GuardLimits | None
    stance: Stance | None
    correction: Modelled | None
    say: Callable[[str], object]
    """told what a person should know"""
    last: Cycle | None = None
    """the last control cycle"""
    _sent: Array | None = None
    _usual: float = float("nan")
    _pieces: list[Recording] = field(default_factory=list)
    _log: LongLog | None = None

    def begin(self) -> tuple[Array, float]:
        """Return the command (1, n) [rad] in force, and the usual control period [s].

        Before the first motion the arm is looked at, and goes slowly to its rest posture.
        """
        if self._sent is None:
            start = begin(self.robot, self.limits, self.stance, self.see)
            self._usual = start.usual_period()
            check_controller_period(self.controller, self._usual)
            self._sent = start.command[-1]
            self._log = LongLog(self.run, self.robot, LABEL, f"{LABEL}/{self.name}", self.say)
        return self._sent, self._usual

    def to_target(self, target: Array, turn: Orientation | None, timeout: float, give_up: GiveUp) -> None:
        """Drive to ``target`` (3,) [m], with the tool turned as in ``turn`` ()."""
        sent, _ = self.begin()
        schedule = Schedule(dwell=timeout, sent=sent, give_up=give_up)
        controller = self.controller if turn is None else self.turning
        self.kept(
            lambda: drive(
                self.robot, controller, target[None, None], schedule, limits=self.limits,
                correction=self.correction, on_cycle=self.see, turns=None if turn is None else turn[None, None],
            )
        )  # fmt: skip

    def keep(self) -> None:
        """Write the log of the motions that are not in one yet."""
        if self._log is not None:
            self._log.end(_joined(self._pieces) if self._pieces else None)

    def kept(self, motion: Callable[[], Recording]) -> Recording:
        """Carry out a motion and keep what is recorded of it, also where it fails."""
        try:
            recording = motion()
        except BaseException as error:
            partial = recording_of(error)
            if partial is not None and len(partial.time):
                self._take(partial)
            raise
        self._take(recording)
        return recording

    def _take(self, recording: Recording) -> None:
        self._sent = recording.command[-1]
        self._pieces.append(recording)
        if self._log is not None and sum(len(piece.time) for piece in self._pieces) * self._usual > PIECE:
            self._log.turn(_joined(self._pieces))
            self._pieces.clear()

    def see(self, cycle: Cycle) -> None:
        """Take over a control cycle."""
        self.last = cycle
        if self._log is not None:
            self._log.see(cycle)


@dataclass(frozen=True, kw_only=True, eq=False)
class ArmCarrier:
    """Carries the arm along a path; `EndedError` once ``ended`` is set."""

    drive: ArmDrive
    ended: threading.Event

    def approach(self, posture: Array, sent: Array) -> Recording:
        """See `rejoint.runs.stages.pathdrive.Carrier`."""
        return self._piece(
            lambda see: approach(
                self.drive.robot, posture, sent, self.drive.limits, give_up=self._give_up, on_cycle=see
            )
        )  # fmt: skip

    def carry(self, guide: Ahead | Stream, controller: Controller, sent: Array, piece: Piece) -> Recording:
        """See `rejoint.runs.stages.pathdrive.Carrier`."""
        return self._piece(
            lambda see: follow_guide(
                self.drive.robot, controller, guide, piece.duration, sent, limits=self.drive.limits,
                give_up=self._give_up, on_cycle=see,
            )
        )  # fmt: skip

    def _piece(self, motion: Callable[[Callable[[Cycle], None]], Recording]) -> Recording:
        recording = self.drive.kept(lambda: motion(self.drive.see))
        if self.ended.is_set():
            raise EndedError
        return recording

    def _give_up(self, inputs: ControlInput) -> Mask:  # noqa: ARG002 - the end is asked for from outside
        return np.array([self.ended.is_set()])


def _joined(pieces: list[Recording]) -> Recording:
    """Return one recording of several, in their order."""
    arrays = [item.name for item in fields(Recording) if isinstance(getattr(pieces[0], item.name), np.ndarray)]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in arrays if name != "tripped"
    }
    names = list(dict.fromkeys(piece.controller for piece in pieces if piece.controller != Playback.name))
    return replace(pieces[-1], controller=", ".join(names) or pieces[-1].controller, **joined)
