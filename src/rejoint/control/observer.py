"""Observers of a drive."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rejoint.system.progress import Progress, RateLimit

if TYPE_CHECKING:
    from rejoint.control.recording import Cycle
    from rejoint.control.robot import Robot


class Observer:
    """Receives progress, messages and cycles; override the methods you need.

    The thread that drives the arm calls the methods: return at once. An exception ends the motion.

    Examples
    --------
    >>> class Printing(rejoint.Observer):
    ...     def message(self, line: str) -> None:
    ...         print(line)
    >>> rejoint.deploy("emulated:worn", observer=Printing())
    """

    shows: bool = False
    """shows moving arms: trials then run in this process"""

    def message(self, line: str) -> None:
        """Receive a sentence for the user."""

    def progress(self, share: float, what: str) -> None:
        """Receive the done share, 0 to 1, and its label, at most ten times a second."""

    def stage(self, stage: object) -> None:
        """Receive a `Stage` of a repair at its start and end."""

    def partial(self, result: object) -> None:
        """Receive the result of a motion up to its error."""

    def served(self, address: str) -> None:
        """Receive the address of a served arm."""

    def cycle(self, cycle: Cycle) -> None:
        """Receive a control cycle."""

    def watch(
        self, robot: Robot, *, twin: object = None, within: float | None = None, paced: bool | None = None
    ) -> Robot:
        """Return the robot to drive, perhaps wrapped.

        ``twin``: the `Twin` or None; ``within`` [m]: accepted error; ``paced``: virtual time may be slowed (None: by
        the address).
        """
        del twin, within, paced
        return robot


class Observers(Observer):
    """Passes everything on to several observers."""

    def __init__(self, *observers: Observer) -> None:
        self._observers = observers
        self.shows = any(one.shows for one in observers)

    def message(self, line: str) -> None:
        """See `Observer`."""
        self._all("message", line)

    def progress(self, share: float, what: str) -> None:
        """See `Observer`."""
        self._all("progress", share, what)

    def stage(self, stage: object) -> None:
        """See `Observer`."""
        self._all("stage", stage)

    def partial(self, result: object) -> None:
        """See `Observer`."""
        self._all("partial", result)

    def served(self, address: str) -> None:
        """See `Observer`."""
        self._all("served", address)

    def cycle(self, cycle: Cycle) -> None:
        """See `Observer`."""
        self._all("cycle", cycle)

    def _all(self, method: str, *given: object) -> None:
        for one in self._observers:
            getattr(one, method)(*given)

    def watch(
        self, robot: Robot, *, twin: object = None, within: float | None = None, paced: bool | None = None
    ) -> Robot:
        """See `Observer`."""
        for one in self._observers:
            robot = one.watch(robot, twin=twin, within=within, paced=paced)
        return robot


class StageObserver(Observers):
    """Observer of one stage; its progress goes from ``start`` to ``end``."""

    def __init__(self, observer: Observer, start: float, end: float) -> None:
        super().__init__(observer)
        self._start, self._end = start, end

    def progress(self, share: float, what: str) -> None:
        """See `Observer`."""
        super().progress(self._start + (self._end - self._start) * share, what)


@contextmanager
def pacing(observer: Observer | None) -> Iterator[Progress]:
    """Rate-limited progress of an observer; reports the end."""
    pace = RateLimit((observer or Observer()).progress)
    yield pace
    pace(1.0, "done")
