"""Run logs of a session: on file before the process can die, and in pieces."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from rejoint.arms import Array
from rejoint.control.recording import PIECE, Cycle, recorded, recording_of
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.control.start import Playback
from rejoint.logs.journal import Journal
from rejoint.logs.runfolder import StageCost, add
from rejoint.logs.runlog import RunLog
from rejoint.robots.wrapper import RobotWrapper
from rejoint.runs.run import Run
from rejoint.system.errors import FileError, RejointError
from rejoint.system.files import require_space, unused

EVERY = 0.02
"""[s] between readings of an arm that is not driven (chosen)"""


class LogKind(NamedTuple):
    """What a run log is of."""

    robot: Robot
    name: str
    """of the file, before its date"""
    label: str


class RunRecorder:
    """Writes ``logs/NAME-DATE.parquet`` of a run, one log for motions of a kind, a new one every `PIECE`.

    FileError without disk space before the arm moves; later ``say`` reports once that the log ends.
    """

    def __init__(self, run: Run | None, say: Callable[[str], object]) -> None:
        self._run, self._say = run, say
        self._kind: LogKind | None = None
        self._journal: Journal | None = None
        self._cycles: list[Cycle] = []
        self._told = False

    @property
    def seconds(self) -> float:
        """Length of what was seen [s]."""
        return float(self._cycles[-1].time[0] - self._cycles[0].time[0]) if self._cycles else 0.0

    def begin(self, robot: Robot, name: str, label: str) -> None:
        """Start or continue a log of this kind."""
        kind = LogKind(robot, name, label)
        if self._kind != kind:
            self.end()
            self._start(kind)
        elif self.seconds > PIECE:
            self.turn()

    def see(self, cycle: Cycle) -> None:
        """Take a control cycle."""
        self._cycles.append(cycle)
        if self._journal is not None:
            self._journal.see(cycle)

    def turn(self, *, keep: bool = True) -> None:
        """Write what was seen if it is worth it, and continue in a new log."""
        kind = self._kind
        try:
            self.end(keep=keep)
            if kind is not None:
                self._start(kind)
        except FileError as error:
            self._kind = kind
            if not self._told:
                self._say(f"{error}; until then the arm goes on without a log of its motion")
                self._told = True

    def end(self, *, keep: bool = True, extra: Mapping[str, str] | None = None) -> RunLog | None:
        """Write and return what was seen; FileError where that fails."""
        journal, cycles, kind = self._ended()
        log = _log(kind, cycles, extra=extra) if kind is not None and cycles and keep else None
        if journal is not None and log is not None:
            journal.finish(log)
        elif journal is not None:
            journal.discard()
        return log

    def rescue(self, error: BaseException) -> None:
        """Write what was seen until ``error``; its note says where."""
        journal, cycles, kind = self._ended()
        partial = recording_of(error)
        if self._run is None or kind is None:
            return
        if journal is None:
            error.add_note("The disk had no room for what was recorded until then.")
        elif cycles:
            error.add_note(journal.keep(_log(kind, cycles, "/stopped")))
        elif partial is not None and len(partial.time):
            part = "/begin" if partial.controller == Playback.name else kind.label.removeprefix(kind.name)
            error.add_note(journal.keep(partial.log(0, f"{kind.name}{part}/stopped")))
        else:
            journal.discard()

    def _ended(self) -> tuple[Journal | None, list[Cycle], LogKind | None]:
        ended = self._journal, self._cycles, self._kind
        self._journal, self._cycles, self._kind = None, [], None
        return ended

    def _start(self, kind: LogKind) -> None:
        self._kind = kind
        if self._run is not None:
            require_space(self._run.path)  # some is left for other programs
            self._journal = start_journal(_dated(self._run, kind.name), kind.robot, kind.label)


def _log(kind: LogKind, cycles: list[Cycle], end: str = "", extra: Mapping[str, str] | None = None) -> RunLog:
    """Log of what was seen; before the first command the positions count as commands, if any came."""
    _, controller, *_ = (*kind.label.split("/"), kind.label)
    found = recorded(kind.robot, controller, cycles, np.zeros(1, dtype=np.uint16))
    sent = np.isfinite(found.command)
    if sent.any():
        found = replace(found, command=np.where(sent, found.command, found.position))
    return found.log(0, kind.label + end, extra)


class StateRecord:
    """What an arm does; see `ArmSession.record`.

    Between motions of the session ``look`` reads the arm.
    """

    log: RunLog | None = None
    """after the end"""

    def __init__(self, robot: Robot, recorder: RunRecorder, name: str, look: Callable[[], object]) -> None:
        self._recorder, self._look = recorder, look
        self._over = threading.Event()
        self._error: RejointError | None = None
        recorder.begin(robot, name, name)
        self._thread = threading.Thread(target=self._watch, name=name, daemon=True)

    def see(self, cycle: Cycle) -> None:
        """Take a cycle."""
        if not self._over.is_set():
            self._recorder.see(cycle)

    def lasts(self, seconds: float) -> bool:
        """Whether it is this long, or ended by an error."""
        return self._error is not None or self._recorder.seconds >= seconds

    def _watch(self) -> None:
        try:
            while not self._over.wait(EVERY):
                self._look()
        except RejointError as error:
            self._error = error

    def __enter__(self) -> Self:
        self._look()
        self._thread.start()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self.log = self._recorder.end()
        if self._error is not None and kind is None:
            raise self._error


class StageMotion:
    """What a stage's robots do: metered, and journaled at ``path``."""

    def __init__(self, run: Run | None = None, stage: str = "", path: Path | None = None) -> None:
        self._run, self._stage, self._path = run, stage, path
        self.journal: Journal | None = None
        self.moving, self.travel = 0.0, 0.0

    def watch(self, robot: Robot) -> Robot:
        """Robot whose motion counts."""
        return _StageRobot(robot, self) if robot.count == 1 else robot

    def see(self, robot: Robot, before: JointState, command: Array, after: JointState) -> None:
        """Take a step."""
        if self.journal is None and self._path is not None:
            if self._run is not None:
                self._run.begin()
            self.journal = start_journal(self._path, robot, self._stage)
        passed, turned = after.time[0] - before.time[0], after.position[0] - before.position[0]
        self.moving += max(float(np.nan_to_num(passed)), 0.0)
        self.travel += float(np.nansum(np.abs(turned)))
        if self.journal is not None:
            self.journal.append(before.time[0], before.position[0], command[0], *np.full((2, 3), np.nan))


class _StageRobot(RobotWrapper):
    def __init__(self, robot: Robot, motion: StageMotion) -> None:
        super().__init__(robot)
        self._motion = motion
        self._before: JointState | None = None

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Pass the command on."""
        state = super().step(command, active)
        if self._before is not None:
            self._motion.see(self, self._before, command, state)
        self._before = state
        return state


@contextmanager
def staged(run: Run | None, stage: str, path: Path | None = None) -> Iterator[Callable[[Robot], Robot]]:
    """Return what wraps the robots of a stage; the run then knows their motion.

    It adds time and travel to the stage's costs. An error comes with a note on the log of the motion until then, in the
    run or beside ``path``; what is written inside is safe from a kill.
    """
    motion = StageMotion(run, stage, _dated(run, stage) if path is None and run is not None else path)
    try:
        yield motion.watch
    except BaseException as error:
        if motion.journal is not None:
            error.add_note(motion.journal.rescue())
        raise
    else:
        if motion.journal is not None:
            motion.journal.discard()
    finally:
        if run is not None and motion.moving > 0.0:
            add(run.folder, StageCost(name=stage, moving=motion.moving, travel=motion.travel))


def start_journal(path: Path, robot: Robot, label: str) -> Journal:
    """Start the journal of a run log."""
    arm = robot.arm
    return Journal(path, arm=arm.name, joint_names=arm.joint_names, robot=robot.address, label=label)


def _dated(run: Run, name: str) -> Path:
    return unused(run.folder.log(f"{name}-{datetime.now():%Y%m%d-%H%M%S}"))
