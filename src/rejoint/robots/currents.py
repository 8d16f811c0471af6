"""Currents of a myCobot's servos as loads: asked for in every cycle that has time for it.

The vendor's client knows the question but has no method for it. Answers are milliamperes without a sign; the sign is
that of the error, since a servo that stands pulls its joint towards its command.
"""

from __future__ import annotations

import contextlib
import time

import numpy as np

from rejoint.arms import Array
from rejoint.errors import ImpossibleReplyError, NoReplyError
from rejoint.robots.link import VendorLink
from rejoint.robots.plausibility import read_bytes
from rejoint.robots.vendor import CURRENTS
from rejoint.stopping import pause

LARGEST_MA = 3250.0
"""[mA] that a servo tells at most: 500 units of 6.5 mA (pymycobot 4.0.7, `get_servo_currents` of the myCobot 320)"""
TRIES = 2
"""Times that a firmware is asked before it is taken to tell no currents (chosen: one answer may be garbled)"""
SPARE = 1.25
"""Times what the question costs that a cycle must have left for it (chosen: in 50 ms there is time for a command and
three questions of 12 ms, so that health need not wait)"""
_SMOOTHING = 0.2  # share of the newest cost in its running mean
_HICCUP = 2.0  # times that mean which a newest cost counts for at most: one answer asked for again is no slow link
_RECOVERY = 0.99  # of that mean stays with every cycle that had no time: what was slow may be quick again


class Currents:
    """What the servos of one arm last told of their currents; None where their firmware says nothing."""

    def __init__(self, link: VendorLink, joints: int) -> None:
        self._link, self._joints = link, joints
        self._told: Array | None = None
        self._known = False
        self.cost = 0.0
        """[s] that the question takes; 0 where it is not asked"""

    def find(self) -> None:
        """Learn whether this firmware tells currents."""
        for _ in range(TRIES):
            with contextlib.suppress(NoReplyError, ImpossibleReplyError):
                self._ask()
                self._known = True
                return
        self.cost = 0.0

    def poll(self, read_at: float) -> None:
        """Ask just before ``read_at`` [s, `time.monotonic`], when positions are asked for, if there is time for it."""
        spare = read_at - time.monotonic()
        if not self._known:
            return
        if spare <= SPARE * self.cost:
            self.cost *= _RECOVERY
            return
        pause(spare - self.cost)
        with contextlib.suppress(ImpossibleReplyError):  # the next cycle asks again
            self._ask()

    def take(self, error: Array | None) -> Array | None:
        """Return the newest loads (n,), once: shares of `LARGEST_MA` with the sign of ``error`` (n,) [rad].

        NaN where there are no new ones or no error is known; None where this firmware tells none.
        """
        told, self._told = self._told, None
        if not self._known:
            return None
        return np.full(self._joints, np.nan) if told is None or error is None else np.sign(error) * told / LARGEST_MA

    def _ask(self) -> None:
        began = time.monotonic()
        told = read_bytes(self._link.ask(*CURRENTS), self._joints)
        if not ((told >= 0.0) & (told <= LARGEST_MA)).all():
            raise ImpossibleReplyError(f"servos cannot take currents of {told.tolist()} mA")
        self._told = told
        took = time.monotonic() - began
        self.cost += _SMOOTHING * (min(took, _HICCUP * self.cost) - self.cost) if self.cost else took
