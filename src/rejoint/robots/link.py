"""A bus kept going: every failure becomes an error with a name, or is got over.

After a failed or late answer both sides are brought into step again, or the connection is made anew, and the question
is asked again, with bounded patience; meanwhile the arm holds. Only what may be repeated goes through here: reads, and
orders that name an absolute position or state.
"""

from __future__ import annotations

import contextlib
import struct
import termios
from collections.abc import Callable
from typing import TypeVar

from rejoint.robots.bus import Bus, Clock
from rejoint.system.errors import (
    AddressError,
    ConnectionLostError,
    ImpossibleReplyError,
    NoReplyError,
    PowerLostError,
    RejointError,
    RobotError,
    StaleReplyError,
    first_line,
)
from rejoint.system.stopping import check, ending

ATTEMPTS = 6
"""Times that a question is asked before its failure is an error (chosen: where one answer in fifty is lost, three times
fail once in twenty minutes, six times once in a lifetime)"""
TIMEOUT = 10.0
"""[s] for which a link may be dead while an arm is driven, before that is an error (chosen: a server that is started
again needs less; the arm holds meanwhile)"""
LAST_TIMEOUT = 3.0
"""[s] of the same for the order to stop (chosen: it should still get through a lost answer)"""
SILENCE = 3.0
"""[s] of silence on a standing connection after which a new one is tried (chosen: twice the pauses that a firmware
takes which was asked too much: 1.5 to 2.6 s, as a debug log of a myCobot 280 shows)"""
REOPEN_PAUSE = 0.5
"""[s] between attempts to connect again (chosen)"""
BROKEN = (OSError, EOFError, termios.error)
"""What a connection raises that is no more"""
_GARBLED = (struct.error, ValueError, IndexError)
_AGAIN = (NoReplyError, StaleReplyError, ImpossibleReplyError, ConnectionLostError)

T = TypeVar("T")


class Link:
    """The bus of one arm at ``address``; opened by `open`, not by construction."""

    def __init__(self, bus: Bus, address: str) -> None:
        self.address = address
        self._bus = bus
        self._connected = False

    def open(self) -> None:
        """Connect and get the arm ready; AddressError if nothing usable answers there. Nothing moves."""
        try:
            self._connect()
        except ConnectionLostError as error:
            raise AddressError(str(error)) from error
        try:
            self._once(self._bus.prepare)
        except _AGAIN as error:
            self.close()
            found = str(error).removeprefix(f"{self.address}: ")
            raise AddressError(
                f"something listens at {self.address}, but no {self._bus.name} answers ({found}); "
                "is it switched on, and is no other client connected?"
            ) from error
        except RobotError as error:  # it answers, and is not to be driven as it is
            self.close()
            raise AddressError(f"{self.address}: {error}") from error

    def ask(self, question: Callable[[], T]) -> T:
        """Ask a ``question`` that may safely be repeated, and return its answer.

        After a failure both sides are brought into step, or connected anew, and it is asked again. Raises
        NoReplyError, ImpossibleReplyError (garbled, or impossible), StaleReplyError (late), ConnectionLostError or, if
        the arm lost its power meanwhile, PowerLostError.
        """
        if not self._connected:
            raise ConnectionLostError(f"{self.address}: not connected; open the robot again")
        return persist(lambda: self._once(question), self._recover, self._bus.clock)

    def close(self) -> None:
        """Drop the connection; the arm holds."""
        self._connected = False
        with contextlib.suppress(*BROKEN):
            self._bus.close()

    def _once(self, question: Callable[[], T]) -> T:
        """Ask once; what the bus raises becomes an error with a name."""
        try:
            return question()
        except RejointError:
            raise
        except TimeoutError as error:
            raise NoReplyError(f"{self.address}: no answer ({first_line(error)})") from error
        except BROKEN as error:
            raise ConnectionLostError(f"{self.address}: the connection broke ({first_line(error)})") from error
        except _GARBLED as error:
            raise ImpossibleReplyError(f"{self.address}: garbled answer ({first_line(error)})") from error

    def _recover(self, error: RobotError, deadline: float) -> None:
        """Bring both sides into step after ``error``, on a new connection if there is no other way."""
        if not isinstance(error, ConnectionLostError):
            until = min(deadline, self._bus.clock.now() + SILENCE)
            try:
                self._once(lambda: self._bus.resynchronise(until))
            except _AGAIN as broken:  # silent again, as a wire is that stalls twice
                error = broken
            else:
                return
        self._reopen(error, deadline)

    def _reopen(self, cause: RobotError, deadline: float) -> None:
        """Connect again; ConnectionLostError if that fails, PowerLostError if the arm lost its power meanwhile."""
        while True:
            try:
                self._connect()
                self._once(lambda: self._bus.prepare(deadline))
                return
            except PowerLostError:
                raise
            except RobotError as error:
                if self._bus.clock.now() + REOPEN_PAUSE > deadline:
                    raise ConnectionLostError(f"{cause}; connecting again failed: {error}") from cause
                self._bus.clock.wait(REOPEN_PAUSE)

    def _connect(self) -> None:
        """Open the bus; ConnectionLostError in one line if nothing is there."""
        self.close()
        try:
            self._bus.open()
        except (*BROKEN, ValueError) as error:
            raise ConnectionLostError(
                f"nothing answers at {self.address} ({first_line(error)}); {self._bus.advice}"
            ) from error
        self._connected = True


def persist(
    question: Callable[[], T],
    recover: Callable[[RobotError, float], None],
    clock: Clock,
    until: float | None = None,
) -> T:
    """Ask up to `ATTEMPTS` times, each failure but the last followed by ``recover(error, deadline)``.

    The deadline is ``until`` [s], or where there is none yet, the patience from now on.
    """
    attempt, began = 0, clock.now()
    while True:
        attempt += 1
        try:
            return question()
        except PowerLostError:
            raise
        except _AGAIN as error:
            check()
            deadline = began + (LAST_TIMEOUT if ending() else TIMEOUT) if until is None else until
            if attempt >= ATTEMPTS or clock.now() > deadline:
                raise
            recover(error, deadline)
