"""Robot families: what an address of each looks like, and how the robot there is opened."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar
from urllib.parse import parse_qs, urlsplit

from rejoint.arms import Arm, load_arm
from rejoint.control.robot import Robot
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.numbers import as_period, as_seed

T = TypeVar("T")

DEFAULT_ARM = "mycobot280"
"""Arm of families that do not say: that of the paper"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Opening:
    """What a robot is opened with."""

    arm: Arm
    seed: int
    """of everything random"""
    count: int
    """number of arms side by side; 1 where the family is not virtual"""
    period: tuple[float, float]
    """[s] interval from which the length of every control cycle is drawn"""
    threads: int
    """that a simulation may use"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Family(Generic[T]):
    """Robots that are addressed and opened in one way; T is what `parse` makes of an address."""

    scheme: str
    """what stands before the colon of an address; the name of the entry point as well"""
    form: str
    """of an address, as it is shown to users: ``tcp://HOST:PORT``"""
    parse: Callable[[str], T]
    """reads a whole address; ValueError says what is wrong with it"""
    connect: Callable[[Place[T], Opening], Robot]
    """opens the robot; AddressError if nothing usable is there"""
    default_arm: str | Callable[[T], str] = DEFAULT_ARM
    """a name of the catalogue or the path of a description: the arm where none is asked for"""
    default_period: tuple[float, float] = (0.050, 0.050)
    """[s] shortest and longest control period where none is asked for"""
    virtual: bool = False
    """whether any number of arms can be opened side by side, in virtual time, which costs nothing"""
    tunable: bool | Callable[[Arm], bool] = False
    """whether the gains of the servos' own loops can be read and set there, or of which arms they can"""
    needs: tuple[str, ...] = ()
    """extras of this package, or modules of them, without which no such robot can be opened"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Place(Generic[T]):
    """Where a robot is: its address, read once."""

    text: str
    """as the user wrote it"""
    family: Family[T]
    detail: T
    """what the family read from the address"""

    @property
    def spot(self) -> str:
        """What two addresses of one arm have in common, as far as they tell."""
        return str(getattr(self.detail, "spot", self.text))

    @property
    def virtual(self) -> bool:
        """Whether arms come in batches there, in virtual time."""
        return self.family.virtual

    def tunable(self, arm: Arm) -> bool:
        """Whether the gains of the servos' own loops of an ``arm`` can be read and set there."""
        can = self.family.tunable
        return can if isinstance(can, bool) else can(arm)

    @property
    def default_period(self) -> tuple[float, float]:
        """Interval [s] of the control periods where nothing else is asked for."""
        return self.family.default_period

    @property
    def default_arm(self) -> str:
        """Name or description of the arm there; MissingExtraError where what knows it is not installed."""
        arm = self.family.default_arm
        if isinstance(arm, str):
            return arm
        require(self.text, *self.family.needs)
        return arm(self.detail)

    def open(
        self,
        *,
        arm: Arm | None = None,
        seed: int = 0,
        count: int = 1,
        period: tuple[float, float] | None = None,
        threads: int = 1,
    ) -> Robot:
        """Connect to the robot; nothing moves.

        The control period is drawn from ``period`` [s]. AddressError if nothing usable is there, MissingExtraError
        where the family needs more than is installed.
        """
        arm = arm or load_arm(self.default_arm)
        if count < 1:
            raise InputError(f"a robot needs at least one arm, got count {count}")
        if count != 1 and not self.virtual:
            raise InputError(f"{self.text} is one arm; only emulated robots come in batches, got count {count}")
        require(self.text, *self.family.needs)
        opening = Opening(
            arm=arm, seed=as_seed(seed), count=count, period=as_period(period) or self.default_period, threads=threads
        )
        return self.family.connect(self, opening)

    def __str__(self) -> str:
        return self.text


_HERE = dict.fromkeys(("localhost", "0.0.0.0"), "127.0.0.1")  # noqa: S104 - names of this computer, not listened on


@dataclass(frozen=True, kw_only=True)
class TcpAddress:
    """A server that speaks for the robot, or an emulator."""

    text: str
    """as the user wrote it"""
    host: str
    port: int

    def __str__(self) -> str:
        return self.text

    @property
    def spot(self) -> str:
        """The one place that it means, however it is written."""
        return f"{_HERE.get(self.host, self.host)}:{self.port}"


@dataclass(frozen=True, kw_only=True)
class SerialAddress:
    """A serial port, or an emulator's pseudo-terminal."""

    text: str
    """as the user wrote it"""
    device: str
    baud: int

    def __str__(self) -> str:
        return self.text

    @property
    def spot(self) -> str:
        """The one place that it means: a device has a name for each adapter and socket as well."""
        return os.path.realpath(self.device)


def tcp_address(text: str, *, port: int) -> TcpAddress:
    """Read ``SCHEME://HOST:PORT``, where ``port`` is taken if none is given; ValueError for anything else."""
    parts = urlsplit(text)
    given = port if parts.port is None else parts.port
    if not parts.hostname or parts.path not in ("", "/") or parts.query or parts.username or given == 0:
        raise ValueError(f"not of the form {parts.scheme}://HOST:PORT")
    return TcpAddress(text=text, host=parts.hostname, port=given)


def serial_address(text: str, *, baud: int) -> SerialAddress:
    """Read ``SCHEME:///dev/DEVICE?baud=N``, where ``baud`` is taken if none is given; ValueError for anything else."""
    parts = urlsplit(text)
    query = parse_qs(parts.query, strict_parsing=True) if parts.query else {}
    if parts.netloc or not parts.path.startswith("/") or parts.path == "/" or set(query) - {"baud"}:
        raise ValueError(f"not of the form {parts.scheme}:///dev/DEVICE?baud=N")
    given = query.get("baud", [str(baud)])[-1]
    if not (given.isascii() and given.isdecimal() and int(given) > 0):
        raise ValueError(f"the baud rate must be a positive whole number, got {given!r}")
    return SerialAddress(text=text, device=parts.path, baud=int(given))
