"""What a robot family with a wire of its own writes: how its bus is opened, read, commanded and stopped.

All else is shared: `rejoint.robots.busrobot` keeps the control period and judges what is read, `rejoint.robots.link`
asks again and connects anew.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.control.servogains import Rung, ServoGains
from rejoint.system.errors import RobotError
from rejoint.system.stopping import pause

ALARMING = 60.0
"""[deg C] from which a temperature is asked for once more before it is believed (chosen: below what trips the guard)"""
SAME = 2.0
"""[deg C] by which two such answers may differ (chosen: what a servo warms in a second, and a count)"""


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
    """One arm behind its wire. Nothing here waits for the control period, repeats a question or judges an answer.

    Methods may raise what the libraries below them raise. TimeoutError, no answer, and ValueError, IndexError or
    struct.error, a garbled one, have the question asked again; any other OSError, a broken connection, has the bus
    closed and opened first. Every method must therefore bear to be called again. `RobotError` ends the motion at once.
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
        """Get a connected arm ready, without moving it: by default there is nothing to do.

        Called after every `open`; where the connection broke, nothing is asked again after ``until`` [s].
        PowerLostError if an arm that was ready has lost its power meanwhile: nobody but its owner may switch it on
        again.
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
        """Return the gains of the servos' own loops, as they were read last; None: nobody knows them."""
        return None

    def rungs(self) -> tuple[Rung, ...]:
        """Return what a search for better gains tries, see `rejoint.control.servogains.Tunable`."""
        return ()

    def tune(self, gains: ServoGains) -> None:
        """Bring these gains in small steps to what is given, until the power goes; RobotError where that is not borne.

        Only what was read before is asked for, so a bus that tells no gains needs neither this nor `keep`.
        """
        raise RobotError(f"the gains of a {self.name} cannot be set: {gains}")

    def keep(self, gains: ServoGains) -> None:
        """Bring these gains to what is given, and have the servos keep them without power."""
        raise RobotError(f"the gains of a {self.name} cannot be kept: {gains}")

    def relay(self, command: int, payload: bytes) -> bytes | None:  # noqa: ARG002 - most wires have nothing to pass on
        """Ask what is none of the joints, as a gripper, in the words of the arm's own wire; None: no answer."""
        return None

    def resynchronise(self, deadline: float) -> None:  # noqa: B027 - nothing is a sensible answer
        """Make sure by ``deadline`` [s] that no late answer is taken for that of a later question.

        Called after every failed question. Where it fails as well, the bus is opened anew.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the wire; the arm holds. A bus that is closed or was never opened bears it."""
