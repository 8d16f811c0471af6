"""Trials in virtual time shared between this process and a helper beside it.

What drives arms side by side is Python for the most part, of which one process runs one line at a time. Two of them
take trials from the two ends of one list. What a trial brings does not depend on who drives it; where the helper is
lost, this process drives the rest.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Protocol

from rejoint.control.comparison.driven import Driven, Places
from rejoint.control.comparison.protocols import Kind
from rejoint.control.recording import Recording
from rejoint.system.stopping import pause

Task = tuple[str, Kind]
"""Controller and protocol"""
Result = tuple[Driven, Recording]
"""What the trials of a task brought, and what was recorded of the first ones: as many as somebody keeps"""

_LOOK = 0.02
"""[s] between two looks at a helper that is waited for (chosen: far below what a trial takes)"""


class HelperLostError(Exception):
    """A helper ended, or could not do what it was asked."""


class Helper(Protocol):
    """Another process that drives trials."""

    def drive(self, task: Task, places: Places) -> Result:
        """Drive the trials of a task and wait for what comes out; HelperLostError if that fails."""

    def rank(self, task: Task) -> int:
        """Tell how near a task is to be done by it: it takes the highest first."""

    def close(self) -> None:
        """End it, whatever it does."""


class Shared:
    """Tasks, of which a helper takes the nearest one whenever it is free, and of these the last."""

    def __init__(self, tasks: Sequence[Task], helper: Helper | None, places: Places) -> None:
        ordered = tasks if helper is None else sorted(tasks, key=helper.rank)
        self._left, self._helper, self._places = deque(ordered), helper, places
        self._done: SimpleQueue[Result] = SimpleQueue()
        self._courier = Thread(target=self._carry, daemon=True)
        if helper is not None and len(tasks) > 1:
            self._courier.start()

    def here(self) -> Iterator[Task]:
        """Yield what is to be driven in this process, until everything is done."""
        while True:
            while self._left:
                try:
                    yield self._left.popleft()
                except IndexError:  # the helper was quicker
                    break
            if not self._courier.is_alive() and not self._left:
                return
            pause(_LOOK)

    def arrived(self) -> Iterator[Result]:
        """Yield what the helper has brought since it was last asked for."""
        while True:
            try:
                yield self._done.get_nowait()
            except Empty:
                return

    def _carry(self) -> None:
        """Hand the helper one task after the other, and a task that it did not do back."""
        assert self._helper is not None  # noqa: S101 - for the type checker
        while True:
            try:
                task = self._left.pop()
            except IndexError:
                return
            try:
                self._done.put(self._helper.drive(task, self._places))
            except HelperLostError:
                self._left.append(task)
                return
