"""Run logs of a session: on file before the process can die, and in pieces."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from rejoint.control.recording import PIECE, Cycle, Recording, recorded, recording_of
from rejoint.control.robot import Robot
from rejoint.control.start import Playback
from rejoint.logs.journal import Journal
from rejoint.logs.runlog import RunLog, write_log
from rejoint.runs.run import Run
from rejoint.system.errors import FileError, RejointError
from rejoint.system.files import require_space, unused

EVERY = 0.02
"""[s] between readings of an arm that is not driven (chosen)"""


class RunRecorder:
    """Writes ``logs/NAME-DATE.parquet`` of a run, one log for motions of a kind, a new one every `PIECE`.

    FileError without disk space before the arm moves; later ``say`` reports once that the log ends.
    """

    def __init__(self, run: Run | None, say: Callable[[str], object]) -> None:
        self._run, self._say = run, say
        self._robot: Robot | None = None
        self._kind: tuple[str, str] | None = None
        self._journal: Journal | None = None
        self._pieces: list[Recording] = []
        self._told = False

    def begin(self, robot: Robot, name: str, label: str) -> None:
        """Start or continue a log of this kind."""
        if self._kind == (name, label):
            if sum(float(np.ptp(piece.time)) for piece in self._pieces if len(piece.time)) > PIECE:
                self.turn()
            return
        self.end()
        self._robot, self._kind = robot, (name, label)
        self._journal = self._start()

    def see(self, cycle: Cycle) -> None:
        """Take a control cycle."""
        if self._journal is not None:
            self._journal.see(cycle)

    def take(self, recording: Recording) -> None:
        """Take a motion that is over."""
        if self._run is not None:
            self._pieces.append(recording)

    def turn(self, *, keep: bool = True) -> None:
        """Write what was taken if it is worth it, and continue in a new log."""
        kind = self._kind
        try:
            self.end(keep=keep)
            self._kind = kind
            self._journal = self._start()
        except FileError as error:
            self._kind = kind
            if not self._told:
                self._say(f"{error}; until then the arm goes on without a log of its motion")
                self._told = True

    def end(self, *, keep: bool = True, extra: Mapping[str, str] | None = None) -> None:
        """Write what was taken; FileError where that fails."""
        journal, pieces, kind = self._ended()
        if journal is not None and kind is not None and keep and pieces:
            journal.finish(_joined(pieces).log(0, kind[1], extra))
        elif journal is not None:
            journal.discard()

    def rescue(self, error: BaseException) -> None:
        """Write what was taken until ``error``; its note says where."""
        journal, pieces, kind = self._ended()
        partial = recording_of(error)
        began = not pieces and partial is not None and partial.controller == Playback.name
        pieces += [partial] if partial is not None and len(partial.time) else []
        if self._run is None or kind is None:
            return
        if journal is None:
            error.add_note("The disk had no room for what was recorded until then.")
        elif pieces:
            label = f"{kind[0]}/begin" if began else kind[1]
            error.add_note(journal.keep(_joined(pieces).log(0, f"{label}/stopped")))
        else:
            journal.discard()

    def _ended(self) -> tuple[Journal | None, list[Recording], tuple[str, str] | None]:
        ended = self._journal, self._pieces, self._kind
        self._journal, self._pieces, self._kind = None, [], None
        return ended

    def _start(self) -> Journal | None:
        if self._run is None or self._kind is None or self._robot is None:
            return None
        require_space(self._run.path)  # some is left for other programs
        return start_journal(self._run, self._kind[0], self._robot, self._kind[1])


class StateRecord:
    """What an arm does; see `ArmSession.record`.

    Between motions of the session ``look`` reads the arm.
    """

    log: RunLog | None = None
    """after the end"""

    def __init__(self, robot: Robot, recorder: RunRecorder, name: str, look: Callable[[], object]) -> None:
        self._robot, self._name, self._cycles = robot, name, list[Cycle]()
        self._recorder, self._look = recorder, look
        self._over = threading.Event()
        self._error: RejointError | None = None
        recorder.begin(robot, name, name)
        self._thread = threading.Thread(target=self._watch, name=name, daemon=True)

    def see(self, cycle: Cycle) -> None:
        """Take a cycle."""
        if not self._over.is_set():
            self._cycles.append(cycle)
            self._recorder.see(cycle)

    def lasts(self, seconds: float) -> bool:
        """Whether it is this long, or ended by an error."""
        cycles = self._cycles
        return self._error is not None or bool(cycles and cycles[-1].time[0] - cycles[0].time[0] >= seconds)

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
        taken = recorded(self._robot, self._name, self._cycles, np.zeros(1, dtype=np.uint16))
        driven = np.isfinite(taken.command[:, 0, 0])
        if driven.any():  # in between, the last command stays in force
            last = np.maximum.accumulate(np.where(driven, np.arange(len(driven)), -1))
            before = np.where((last >= 0)[:, None, None], taken.command[last], taken.position)
            taken = replace(taken, command=before)
        self._recorder.take(taken)
        self._recorder.end()
        self.log = taken.log(0, taken.controller)
        if self._error is not None and kind is None:
            raise self._error


def start_journal(run: Run, name: str, robot: Robot, label: str) -> Journal:
    """Start the journal of a dated run log."""
    arm = run.arm
    return Journal(_dated(run, name), arm=arm.name, joint_names=arm.joint_names, robot=robot.address, label=label)


@contextmanager
def kept_if_stopped(run: Run | None, name: str) -> Iterator[None]:
    """Keep a motion that ends early as a log that the error names."""
    try:
        yield
    except BaseException as error:
        partial = recording_of(error)
        if run is not None and partial is not None and len(partial.time):
            part = "begin" if partial.controller == Playback.name else partial.controller
            path = _dated(run, name)
            try:
                write_log(path, partial.log(0, f"{name}/{part}/stopped"))
            except FileError as full:  # the first error is the one to report
                error.add_note(f"What was recorded until then is lost: {full}")
            else:
                error.add_note(f"What was recorded until then: {path}")
        raise


def _dated(run: Run, name: str) -> Path:
    return unused(run.folder.log(f"{name}-{datetime.now():%Y%m%d-%H%M%S}"))


def _joined(pieces: list[Recording]) -> Recording:
    if len(pieces) == 1:
        return pieces[0]
    arrays = [item.name for item in fields(Recording) if isinstance(getattr(pieces[0], item.name), np.ndarray)]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in arrays if name != "tripped"
    }
    names = list(dict.fromkeys(piece.controller for piece in pieces if piece.controller != Playback.name))
    return replace(pieces[-1], controller=", ".join(names) or pieces[-1].controller, **joined)
