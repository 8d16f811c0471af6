"""Run logs of a session: on file before the process can die, and in pieces."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from rejoint.control.recording import PIECE, Cycle, recorded, recording_of
from rejoint.control.robot import Robot
from rejoint.control.start import Playback
from rejoint.logs.journal import Journal
from rejoint.logs.runlog import RunLog
from rejoint.runs.run import Run, dated, start_journal
from rejoint.system.errors import FileError, RejointError
from rejoint.system.files import require_space

LogKind: TypeAlias = tuple[Robot, str, str]
"""Robot, name of the file before its date, and label of a log"""


class RunRecorder:
    """Writes ``logs/NAME-DATE.parquet`` of a run, one log for motions of a kind, a new one every `PIECE`.

    FileError without disk space before the arm moves; later ``say`` reports it once.
    """

    log: RunLog | None = None
    """newest one that has ended"""
    error: RejointError | None = None
    """why a reading failed"""

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
        kind = (robot, name, label)
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

    def end(self, *, keep: bool = True, extra: Mapping[str, str] | None = None) -> None:
        """Write what was seen; FileError where that fails."""
        journal, cycles, kind = self._ended()
        self.log = _log(kind, cycles, extra=extra) if kind is not None and cycles and keep else None
        if journal is not None and self.log is not None:
            journal.finish(self.log)
        elif journal is not None:
            journal.discard()

    def rescue(self, error: BaseException) -> None:
        """Write what was seen until ``error``; its note says where."""
        journal, cycles, kind = self._ended()
        partial = recording_of(error)
        if self._run is None or kind is None:
            return
        if journal is None:
            error.add_note("The disk had no room for what was recorded until then.")
        elif cycles:
            error.add_note(journal.rescue(_log(kind, cycles, "/stopped")))
        elif partial is not None:
            label = f"{kind[1]}/begin" if partial.controller == Playback.name else kind[2]
            error.add_note(journal.rescue(partial.log(0, f"{label}/stopped")))
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
            robot, name, label = kind
            self._journal = start_journal(dated(self._run, name), robot, label)


def _log(kind: LogKind, cycles: list[Cycle], end: str = "", extra: Mapping[str, str] | None = None) -> RunLog:
    """Log of what was seen; before the first command the positions count as commands, if any came."""
    robot, _, label = kind
    _, controller, *_ = (*label.split("/"), label)
    found = recorded(robot, controller, cycles, np.zeros(1, dtype=np.uint16))
    sent = np.isfinite(found.command)
    if sent.any():
        found = replace(found, command=np.where(sent, found.command, found.position))
    return found.log(0, label + end, extra)
