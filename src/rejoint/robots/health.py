"""Temperatures and faults of servos, asked for as often as the wire has time for it, and never believed at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.robots.bus import Bus, Vitals
from rejoint.robots.link import Link
from rejoint.system.errors import NoReplyError

DOUBTS = 5
"""Times that an alarm is asked for again at most (chosen: two garbled answers in a row hardly ever agree)"""

INTERVAL = 1.0
"""[s] at most between two questions, which take turns (chosen); where the period leaves time for it, one is asked in
every cycle"""
_SPARE = 1.5
"""Times what a question costs that a cycle must have left for one (chosen: answers jitter)"""
_SMOOTHING = 0.2  # share of the newest cost in its running mean

V = TypeVar("V", bound=Vitals)


class Health:
    """What the servos of one arm last said of themselves; None where their firmware says nothing."""

    def __init__(self, link: Link, bus: Bus) -> None:
        self._link, self._clock, self._questions = link, bus.clock, bus.vitals()
        self.temperature: Array | None = None
        """(1, n) [deg C]"""
        self.fault: NDArray[np.bool_] | None = None
        """(1, n) whether a servo reports a fault"""
        self.trouble: tuple[str, ...] | None = None
        """(n,) what each complains of, in words"""
        self._turn = 0
        self._due = 0.0
        self._cost = 0.0

    def find(self) -> None:
        """Learn whether this firmware answers its questions; older ones are silent."""
        try:
            for _ in self._questions:
                self._ask()
        except NoReplyError:
            self.temperature = self.fault = None
            self._questions = ()

    def poll(self, spare: float) -> None:
        """Ask the next question if ``spare`` [s] are enough for it or the last answer is too old."""
        if self._questions and (spare > _SPARE * self._cost or self._clock.now() >= self._due):
            self._ask()

    def take(self, found: Vitals) -> None:
        """Take over what an answer says."""
        if found.temperature is not None:
            self.temperature = np.array(found.temperature, float)[None]
        if found.fault is not None:
            self.fault, self.trouble = np.array(found.fault, bool)[None], found.trouble

    def _ask(self) -> None:
        began, question = self._clock.now(), self._questions[self._turn]
        self.take(believed(lambda: self._link.ask(question)))
        now = self._clock.now()
        self._cost += (_SMOOTHING if self._cost else 1.0) * (now - began - self._cost)
        self._turn, self._due = (self._turn + 1) % len(self._questions), now + INTERVAL


def believed(ask: Callable[[], V]) -> V:
    """Ask again after an alarming answer until two in a row say the same: a wrong byte on the wire is no alarm."""
    found = ask()
    for _ in range(DOUBTS):
        if not found.alarming:
            return found
        before, found = found, ask()
        if found.agrees(before):
            return found
    return found
