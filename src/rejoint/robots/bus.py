"""The wire of a robot family (`Bus`), and its recovery from failures (`Link`)."""

from __future__ import annotations

import contextlib
import struct
import termios
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from rejoint.arms import Array, Mask
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
from rejoint.system.records import entity
from rejoint.system.stopping import check, ending, pause

ALARMING = 60.0
"""[deg C] a higher one is asked for again (chosen: below the guard's trip)"""
SAME = 2.0
"""[deg C] allowed difference of two such answers (chosen)"""
LOST = 1.0
"""[s] until a silent robot's state is not reported (chosen: five slow periods)"""


@entity
class Vitals:
    """State of n servos; None: unknown this time."""

    temperature: Array | None = None
    """(n,) [deg C]"""
    fault: Mask | None = None
    """(n,)"""
    trouble: tuple[str, ...] | None = None
    """(n,) faults in words, or empty"""

    @property
    def alarming(self) -> bool:
        """Whether this would end a motion."""
        hot = self.temperature is not None and bool(np.max(self.temperature) >= ALARMING)
        return hot or (self.fault is not None and bool(np.any(self.fault)))

    def agrees(self, other: Vitals) -> bool:
        """Whether two answers are equal."""
        pairs = (self.temperature, other.temperature, SAME), (self.fault, other.fault, 0.0)
        return not any(
            this is not None and that is not None and np.abs(np.subtract(this, that, dtype=float)).max() > slack
            for this, that, slack in pairs
        )


@entity
class Reading(Vitals):
    """An answer of a bus."""

    position: Array
    """(n,) [rad], NaN: unreadable servo"""
    load: Array | None = None
    """(n,) share of the largest torque, -1 to 1, positive with the joint"""
    voltage: Array | None = None
    """(n,) [V] measured supply"""


_CLOCK: int | None = getattr(time, "CLOCK_BOOTTIME", None)  # on Linux `time.monotonic` stands still in a sleep


class Clock:
    """Wall-clock time; a simulated bus brings its own."""

    def now(self) -> float:
        """Return the monotonic time [s], which includes the computer's sleep."""
        return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)

    def wait(self, duration: float) -> None:
        """Wait for ``duration`` [s]; raises `Interrupted`."""
        pause(duration)


class Bus(ABC):
    """One arm behind its wire, without timing, repetition or checks.

    After TimeoutError, ValueError, IndexError or struct.error `Link` asks again; after another OSError it reopens the
    bus.
    """

    name: str = "robot"
    """in messages"""
    advice: str = "is the arm switched on, its server running and no other program on it, and the address right?"
    """hint where nothing answers"""
    clock: Clock = Clock()

    @abstractmethod
    def open(self) -> None:
        """Connect, also after `close` of a broken connection."""

    def prepare(self, until: float | None = None) -> None:  # noqa: B027 - nothing is a sensible answer
        """Prepare a connected arm without motion, by ``until`` [s].

        PowerLostError if a prepared arm has lost its power.
        """

    @abstractmethod
    def read(self) -> Reading:
        """Ask for the joint positions, and what comes with them."""

    def vitals(self) -> tuple[Callable[[], Vitals], ...]:
        """Further questions for vitals, asked in turn when there is time."""
        return ()

    @abstractmethod
    def send(self, goal: Array) -> None:
        """Send joint positions (n,) [rad], clipped to the wire's range."""

    @abstractmethod
    def stop(self) -> None:
        """Hold here, with power on: a worn arm would collapse."""

    def servo_gains(self) -> ServoGains | None:
        """Return the servo gains as last read; None: unknown."""
        return None

    def rungs(self) -> tuple[Rung, ...]:
        """Return the search order of gains, see `rejoint.control.servogains.Tunable`."""
        return ()

    def tune(self, gains: ServoGains) -> None:
        """Set gains in small steps until power-off; RobotError."""
        raise RobotError(f"the gains of a {self.name} cannot be set: {gains}")

    def keep(self, gains: ServoGains) -> None:
        """Set gains permanently."""
        raise RobotError(f"the gains of a {self.name} cannot be kept: {gains}")

    def relay(self, command: int, payload: bytes) -> bytes | None:  # noqa: ARG002 - most wires have nothing to pass on
        """Ask another device, such as a gripper; None: no answer."""
        return None

    def resynchronise(self, deadline: float) -> None:  # noqa: B027 - nothing is a sensible answer
        """Make sure by ``deadline`` [s] that no late answer is pending."""

    @abstractmethod
    def close(self) -> None:
        """Release the wire; the arm holds. May be called twice."""


ATTEMPTS = 6
"""Attempts per question (chosen: one answer in fifty may be lost)"""
TIMEOUT = 10.0
"""[s] of a dead link while an arm is driven (chosen)"""
FIRST = 4.0
"""[s] in which an arm answers that is opened (chosen)"""
LAST_TIMEOUT = 3.0
"""[s] the same for a stop (chosen)"""
SILENCE = 3.0
"""[s] without answers before a new connection (chosen)"""
REOPEN_PAUSE = 0.5
"""[s] between connections (chosen)"""
BROKEN = (OSError, EOFError, termios.error)
"""Errors of a broken connection"""
_GARBLED = (struct.error, ValueError, IndexError)
UNANSWERED = (NoReplyError, StaleReplyError, ImpossibleReplyError)
"""Errors after which the same connection can be asked again"""
_AGAIN = (*UNANSWERED, ConnectionLostError)

T = TypeVar("T")


class Link:
    """The bus of one arm at ``address``; connects in `open`."""

    def __init__(self, bus: Bus, address: str) -> None:
        self.address = address
        self._bus = bus
        self._connected = False

    def open(self) -> None:
        """Connect and prepare the arm without motion; AddressError."""
        try:
            self._connect()
        except ConnectionLostError as error:
            raise AddressError(str(error)) from error
        try:
            asked(lambda: self._bus.prepare(self._bus.clock.now() + FIRST), self.address)
        except BaseException as error:
            self.close()
            if not isinstance(error, RobotError):
                raise
            why = f"{self.address}: {error}"  # it answers, and is not to be driven as it is
            if isinstance(error, _AGAIN):
                why = (
                    f"something listens at {self.address}, but no {self._bus.name} answers "
                    f"({str(error).removeprefix(f'{self.address}: ')}); is it switched on, and is no other client "
                    "connected?"
                )
            raise AddressError(why) from error

    def ask(self, question: Callable[[], T]) -> T:
        """Ask a repeatable ``question``.

        Raises NoReplyError, ImpossibleReplyError, StaleReplyError, ConnectionLostError or PowerLostError.
        """
        if not self._connected:
            raise ConnectionLostError(f"{self.address}: not connected; open the robot again")
        return persist(question, self._recover, self._bus.clock, self.address, errors=_AGAIN)

    def close(self) -> None:
        """Close the connection; the arm holds."""
        self._connected = False
        with contextlib.suppress(*BROKEN):
            self._bus.close()

    def _recover(self, error: RobotError, deadline: float) -> None:
        if not isinstance(error, ConnectionLostError):
            until = min(deadline, self._bus.clock.now() + SILENCE)
            try:
                asked(lambda: self._bus.resynchronise(until), self.address)
            except _AGAIN as broken:  # silent again, as a wire is that stalls twice
                error = broken
            else:
                return
        while True:
            try:
                self._connect()
                asked(lambda: self._bus.prepare(deadline), self.address)
                return
            except PowerLostError:
                raise
            except RobotError as again:
                if self._bus.clock.now() + REOPEN_PAUSE > deadline:
                    raise ConnectionLostError(f"{error}; connecting again failed: {again}") from error
                self._bus.clock.wait(REOPEN_PAUSE)

    def _connect(self) -> None:
        self.close()
        try:
            self._bus.open()
        except (*BROKEN, ValueError) as error:
            raise ConnectionLostError(
                f"nothing answers at {self.address} ({first_line(error)}); {self._bus.advice}"
            ) from error
        self._connected = True


def asked(question: Callable[[], T], place: object) -> T:
    """Ask once; errors of the wire get the names of `rejoint.system.errors`, and the ``place``."""
    try:
        return question()
    except RejointError:
        raise
    except TimeoutError as error:
        raise NoReplyError(f"{place}: no answer ({first_line(error)})") from error
    except BROKEN as error:
        raise ConnectionLostError(f"{place}: the connection broke ({first_line(error)})") from error
    except _GARBLED as error:
        raise ImpossibleReplyError(f"{place}: garbled answer ({first_line(error)})") from error


def persist(
    question: Callable[[], T],
    recover: Callable[[RobotError, float], object],
    clock: Clock,
    place: object,
    until: float | None = None,
    errors: tuple[type[RobotError], ...] = UNANSWERED,
) -> T:
    """Ask up to `ATTEMPTS` times until ``until`` [s], with ``recover`` after ``errors``."""
    attempt, began = 0, clock.now()
    while True:
        attempt += 1
        try:
            return asked(question, place)
        except PowerLostError:
            raise
        except errors as error:
            check()
            deadline = began + (LAST_TIMEOUT if ending() else TIMEOUT) if until is None else until
            if attempt >= ATTEMPTS or clock.now() > deadline:
                raise
            recover(error, deadline)
