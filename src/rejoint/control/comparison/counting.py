"""How much of a comparison is done: targets that are finished, of all there may be."""

from __future__ import annotations

from collections.abc import Callable

from rejoint.control.recording import Cycle
from rejoint.system.progress import Progress

PROGRESS_CYCLES = 40
"""Cycles between two reports of progress (chosen: about a second of a real arm)."""


class Targets:
    """Counts the targets that are finished, and reports their share."""

    def __init__(self, report: Progress, total: int) -> None:
        self._report, self._total = report, total
        self._done = self._size = self._cycles = 0
        self._text = ""

    def watch(self, text: str, size: int) -> Callable[[Cycle], None]:
        """Begin with ``size`` targets of what ``text`` says; the result is to see every cycle."""
        self._text, self._size, self._cycles = text, size, 0
        return self._see

    def finish(self) -> None:
        """Count what was begun as done."""
        self._done += self._size
        self._report(self._done / self._total, self._text)

    def skip(self, size: int) -> None:
        """Count ``size`` targets that are not driven as done."""
        self._size = size
        self.finish()

    def skip_rest(self) -> None:
        """Count all that is left as done."""
        if self._done < self._total:
            self.skip(self._total - self._done)

    def _see(self, cycle: Cycle) -> None:
        if self._cycles % PROGRESS_CYCLES == 0:
            self._report((self._done + int(cycle.target_index.sum())) / self._total, self._text)
        self._cycles += 1
