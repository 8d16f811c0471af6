"""Run logs of a drive that may last for weeks: a piece at a time, so that neither memory nor a full disk ends it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from rejoint.control.recording import Cycle, Recording
from rejoint.control.robot import Robot
from rejoint.runs.run import Run
from rejoint.runs.stages.keeping import start_journal
from rejoint.system.errors import FileError
from rejoint.system.files import require_space

if TYPE_CHECKING:
    from rejoint.logs.journal import Journal


class LongLog:
    """Keeps what one arm does in ``logs/NAME-DATE.parquet``, a file for each piece.

    The first piece must have room: FileError before anything moves. Where there is none for a later one, the arm goes
    on without a log; that is told once, and tried again with the next piece.
    """

    def __init__(self, run: Run, robot: Robot, name: str, label: str, say: Callable[[str], object]) -> None:
        """Begin the first piece."""
        self._run, self._robot, self._name, self._label, self._say = run, robot, name, label, say
        self._told = False
        self._journal: Journal | None = self._begin()

    def see(self, cycle: Cycle) -> None:
        """Take a control cycle."""
        if self._journal is not None:
            self._journal.see(cycle)

    def turn(self, piece: Recording | None) -> None:
        """End a piece, which is kept unless it is None, and begin the next one."""
        try:
            self.end(piece)
            self._journal = self._begin()
        except FileError as error:
            if not self._told:
                self._say(f"{error}; until then the arm goes on without a log of its motion")
                self._told = True

    def end(self, piece: Recording | None) -> None:
        """End the last piece; FileError where it cannot be kept."""
        journal, self._journal = self._journal, None
        if journal is not None and piece is not None:
            journal.finish(piece.log(0, self._label))
        elif journal is not None:
            journal.discard()

    def rescue(self, piece: Recording | None) -> str:
        """End a piece that failed; returns a sentence that says where it is, or why it is not."""
        journal, self._journal = self._journal, None
        if journal is None:
            return "The disk had no room for what was recorded until then."
        if piece is not None and len(piece.time):
            return journal.keep(piece.log(0, f"{self._label}/stopped"))
        journal.discard()
        return "Nothing was recorded."

    def _begin(self) -> Journal:
        require_space(self._run.path)  # some is left for others
        return start_journal(self._run, self._name, self._robot, self._label)
