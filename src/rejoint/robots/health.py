"""Temperatures and faults of a myCobot's servos, asked for as often as the wire has time for it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.errors import ImpossibleReplyError, NoReplyError
from rejoint.robots.link import VendorLink
from rejoint.robots.plausibility import read_bytes

T = TypeVar("T", bound=NDArray[Any])

ALARMING = 60.0
"""[deg C] from which a temperature is asked for once more before it is believed (chosen: below what trips the guard)"""

DOUBTS = 5
"""Times that it is asked for at most (chosen: two garbled answers in a row hardly ever agree)"""
SAME = 2.0
"""[deg C] by which two such answers may differ (chosen: what a servo warms in a second, and a count)"""

_SPARE = 1.5
"""Times what a question costs that a cycle must have left for one (chosen: answers jitter)"""
_SMOOTHING = 0.2  # share of the newest cost in its running mean


class Health:
    """What the servos of one arm last said of themselves; None where their firmware says nothing."""

    def __init__(self, link: VendorLink, joints: int, interval: float) -> None:
        self._link, self._joints, self._interval = link, joints, interval
        self.temperature: Array | None = None
        """(1, n) [deg C]"""
        self.fault: NDArray[np.bool_] | None = None
        """(1, n) whether a servo reports a fault"""
        self._reported = False
        self._turn = 0
        self._due = 0.0
        self._cost = 0.0

    def find(self) -> None:
        """Learn whether this firmware reports temperatures and faults; older ones are silent."""
        try:
            self._link.insist(self._ask)
            self._link.insist(self._ask)
        except NoReplyError:
            self.temperature = self.fault = None
        else:
            self._reported = True

    def poll(self, spare: float) -> None:
        """Ask for one of the two, in turn, if ``spare`` [s] are enough for it or the last answer is too old."""
        if self._reported and (spare > _SPARE * self._cost or time.monotonic() >= self._due):
            self._link.insist(self._ask)

    def _ask(self) -> None:
        began = time.monotonic()
        if self._turn == 0:
            self._ask_temperature()
        else:
            self._ask_fault()
        now = time.monotonic()
        self._cost += (_SMOOTHING if self._cost else 1.0) * (now - began - self._cost)
        self._turn, self._due = 1 - self._turn, now + self._interval

    def _ask_temperature(self) -> None:
        def ask() -> Array:
            return read_bytes(self._link.ask("get_servo_temps"), self._joints)

        self.temperature = _believed(ask, lambda found: bool(found.max() >= ALARMING))[None]

    def _ask_fault(self) -> None:
        def ask() -> NDArray[np.bool_]:
            return _faults(self._link.ask("get_servo_status"), self._joints)

        self.fault = _believed(ask, lambda found: bool(found.any()))[None]


def _believed(ask: Callable[[], T], alarming: Callable[[T], bool]) -> T:
    """Ask again after an alarming answer until two in a row say the same: a wrong byte on the wire is no alarm."""
    found = ask()
    for _ in range(DOUBTS):
        if not alarming(found):
            return found
        before, found = found, ask()
        if np.abs(np.subtract(found, before, dtype=float)).max() <= SAME:
            return found
    return found


def _faults(reply: object, count: int) -> NDArray[np.bool_]:
    """Whether each servo reports a fault: 0, or a list of set bits (or a bit mask)."""
    if not isinstance(reply, list) or len(reply) != count:
        raise ImpossibleReplyError(f"expected the status of {count} servos, got {reply!r}")
    return np.array([bool(status) for status in reply])
