"""The wire of a robot family (`Bus`), and what keeps it going (`Link`).

Every failure becomes an error with a name, or the question is asked again.
"""

from __future__ import annotations

import contextlib
import struct
import termios
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.control.servogains import Rung, ServoGains
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
from rejoint.system.stopping import check, ending, pause

ALARMING = 60.0
"""[deg C] from which a temperature is asked for once more before it is believed (chosen: below what trips the guard)"""
SAME = 2.0
"""[deg C] by which two such answers may differ (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Vitals:
    """What n servos say of themselves; None where they say nothing, or nothing this time."""

    temperature: Array | None = None
    """(n,) [deg C]"""
    fault: NDArray[np.bool_] | None = None
    """(n,) whether a servo reports a fault"""
    trouble: tuple[str, ...] | None = None
    """(n,) what each servo complains of, in words, where its bus can tell; empty for nothing"""

    @property
    def alarming(self) -> bool:
        """Whether this would end a motion, so that it had better be asked for once more."""
        hot = self.temperature is not None and bool(np.max(self.temperature) >= ALARMING)
        return hot or (self.fault is not None and bool(np.any(self.fault)))

    def agrees(self, other: Vitals) -> bool:
        """Tell whether two answers say the same."""
        pairs = (self.temperature, other.temperature, SAME), (self.fault, other.fault, 0.0)
        return not any(
            this is not None and that is not None and np.abs(np.subtract(this, that, dtype=float)).max() > slack
            for this, that, slack in pairs
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading(Vitals):
    """One answer of a bus."""

    position: Array
    """(n,) [rad], NaN for a servo that cannot be read"""
    load: Array | None = None
    """(n,) share of the largest torque, -1 to 1, positive with the joint"""
    voltage: Array | None = None
    """(n,) [V] supply that the servos measure"""


_CLOCK: int | None = getattr(time, "CLOCK_BOOTTIME", None)  # on Linux `time.monotonic` stands still in a sleep


class Clock:
    """Wall-clock time. A simulated bus brings another one, in which waiting lets its arm move."""

    def now(self) -> float:
        """Return the time [s]; it never runs backwards, and goes on while the computer sleeps, as an arm does."""
        return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)

    def wait(self, duration: float) -> None:
        """Let ``duration`` [s] pass, none where it is negative; raises `Interrupted` when asked to end."""
        pause(duration)


class Bus(ABC):
    """One arm behind its wire. It neither waits for the control period nor repeats a question nor judges an answer.

    After TimeoutError, ValueError, IndexError or struct.error `Link` asks again; after any other OSError it opens the
    bus again first. `RobotError` ends the motion at once.
    """

    name: str = "robot"
    """what it speaks to, as messages call it"""
    advice: str = "is the arm switched on, its server running, and the address right?"
    """what to look at where nothing answers"""
    clock: Clock = Clock()
    """time in which the arm lives"""

    @abstractmethod
    def open(self) -> None:
        """Connect. Called again after the connection broke; `close` comes before."""

    def prepare(self, until: float | None = None) -> None:  # noqa: B027 - nothing is a sensible answer
        """Get a connected arm ready without moving it, by ``until`` [s] where the connection broke.

        PowerLostError if an arm that was ready has lost its power: only its owner may switch it on again.
        """

    @abstractmethod
    def read(self) -> Reading:
        """Ask for the joint positions, and for whatever comes with them at no further cost."""

    def vitals(self) -> tuple[Callable[[], Vitals], ...]:
        """Further questions, each for a part of the vitals, which are asked in turn where the period leaves time."""
        return ()

    @abstractmethod
    def send(self, goal: Array) -> None:
        """Send joint positions (n,) [rad]; the newest is in force, and is clipped to what the wire can hold."""

    @abstractmethod
    def stop(self) -> None:
        """Make the arm hold where it is. Never cuts the power: a worn arm would collapse."""

    def servo_gains(self) -> ServoGains | None:
        """Return the gains of the servos' own loops, as they were read last; None where they are unknown."""
        return None

    def rungs(self) -> tuple[Rung, ...]:
        """Return what a search for better gains tries, see `rejoint.control.servogains.Tunable`."""
        return ()

    def tune(self, gains: ServoGains) -> None:
        """Bring these gains in small steps to what is given, until the power goes.

        RobotError where a servo cannot bear it.
        """
        raise RobotError(f"the gains of a {self.name} cannot be set: {gains}")

    def keep(self, gains: ServoGains) -> None:
        """Bring these gains to what is given, and have the servos keep them without power."""
        raise RobotError(f"the gains of a {self.name} cannot be kept: {gains}")

    def relay(self, command: int, payload: bytes) -> bytes | None:  # noqa: ARG002 - most wires have nothing to pass on
        """Ask what is none of the joints, as a gripper, in the words of the arm's own wire; None: no answer."""
        return None

    def resynchronise(self, deadline: float) -> None:  # noqa: B027 - nothing is a sensible answer
        """Make sure by ``deadline`` [s] that no late answer is taken for that of a later question."""

    @abstractmethod
    def close(self) -> None:
        """Release the wire; the arm holds. A bus that is closed or was never opened bears it."""


ATTEMPTS = 6
"""Times that a question is asked before its failure is an error (chosen: one answer in fifty may be lost)"""
TIMEOUT = 10.0
"""[s] for which a link may be dead while an arm is driven (chosen: a server restarts in less)"""
LAST_TIMEOUT = 3.0
"""[s] of the same for the order to stop (chosen)"""
SILENCE = 3.0
"""[s] of silence after which a new connection is tried (chosen)"""
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

        Raises NoReplyError, ImpossibleReplyError, StaleReplyError, ConnectionLostError or PowerLostError.
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
    """Ask up to `ATTEMPTS` times until ``until`` [s].

    After each failure but the last ``recover(error, deadline)`` is called.
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
