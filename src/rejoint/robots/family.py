"""Robot families: their addresses, and how a robot is opened."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar
from urllib.parse import parse_qs, urlsplit

from rejoint.arms import Arm
from rejoint.control.robot import Robot
from rejoint.system.extras import require
from rejoint.system.records import entity

T = TypeVar("T")

DEFAULT_ARM = "mycobot280"
"""Arm of the paper"""


@entity
class Opening:
    """Options of opening a robot."""

    arm: Arm
    seed: int
    """of all random numbers"""
    count: int
    """of arms; 1 unless virtual"""
    period: tuple[float, float]
    """[s] range of control periods"""


@entity
class Family(Generic[T]):
    """Robots with one kind of address; T is the parsed address."""

    scheme: str
    """before the colon of an address, and name of the entry point"""
    form: str
    """of an address: ``tcp://HOST:PORT``"""
    parse: Callable[[str], T]
    """of a whole address; ValueError"""
    connect: Callable[[Place[T], Opening], Robot]
    """opens the robot; AddressError"""
    default_arm: str | Callable[[T], str] = DEFAULT_ARM
    """name or description of the default arm"""
    default_period: tuple[float, float] = (0.050, 0.050)
    """[s] shortest and longest"""
    only: bool = False
    """other arms of the catalogue are refused: the guard would use their links"""
    virtual: bool = False
    """batches of arms in virtual time"""
    tunable: bool | Callable[[Arm], bool] = False
    """servo gains can be read and set, or for which arms"""
    needs: tuple[str, ...] = ()
    """required extras or modules"""


@entity
class Place(Generic[T]):
    """A parsed address of a robot."""

    text: str
    """as the user wrote it"""
    family: Family[T]
    detail: T
    """parsed address"""

    @property
    def spot(self) -> str:
        """Equal for two addresses of one arm, if known."""
        return str(getattr(self.detail, "spot", self.text))

    @property
    def unloaded(self) -> str:
        """Address without payload and gains, where its family reads them from it."""
        return str(getattr(self.detail, "unloaded", self.text))

    @property
    def virtual(self) -> bool:
        """Whether arms come in batches in virtual time."""
        return self.family.virtual

    def tunable(self, arm: Arm) -> bool:
        """Whether the servo gains of an ``arm`` can be read and set."""
        can = self.family.tunable
        return can if isinstance(can, bool) else can(arm)

    @property
    def default_period(self) -> tuple[float, float]:
        """Range [s] of control periods."""
        return self.family.default_period

    @property
    def default_arm(self) -> str:
        """Name or description of the arm there; MissingExtraError."""
        arm = self.family.default_arm
        if isinstance(arm, str):
            return arm
        require(self.text, *self.family.needs)
        return arm(self.detail)

    def __str__(self) -> str:
        return self.text


PORT, BAUD = 9000, 1_000_000
"""of addresses that name none: of the myCobot's server, and [1/s] of its Raspberry Pi (manual) and of set-up servos"""
_HERE = dict.fromkeys(("localhost", "0.0.0.0"), "127.0.0.1")  # noqa: S104 - names of this computer, not listened on


class Wire(NamedTuple):
    """A serial port, or an emulator's pseudo-terminal; or a server for the robot, or an emulator."""

    text: str
    """as the user wrote it"""
    device: str = ""
    """empty: a server"""
    baud: int = 0
    host: str = ""
    """empty: a device"""
    port: int = 0

    def __str__(self) -> str:
        return self.text

    @property
    def spot(self) -> str:
        """Equal for all its addresses."""
        return os.path.realpath(self.device) if self.device else f"{_HERE.get(self.host, self.host)}:{self.port}"


def wire_address(text: str) -> Wire:
    """Read ``serial:///dev/DEVICE?baud=N``, ``tcp://HOST:PORT``, or either with another scheme; ValueError."""
    return read_wire(text)[0]


def read_wire(text: str, *options: str) -> tuple[Wire, dict[str, str]]:
    """Read an address as `wire_address` does, and its other ``options``; ValueError."""
    parts, known = urlsplit(text), ("baud", *options)
    found = parse_qs(parts.query, strict_parsing=True, keep_blank_values=True) if parts.query else {}
    if found.keys() - known or any(len(values) > 1 or not values[0] for values in found.values()):
        raise ValueError(f"expected each of {', '.join(known)} once at most, got {parts.query!r}")
    given = {name: values[0] for name, values in found.items()}
    alone = parts.path in ("", "/") and not parts.username and parts.port != 0
    if parts.hostname and alone and parts.scheme != "serial":
        if "baud" in given:
            raise ValueError("the baud rate is that of the other machine; leave it out")
        return Wire(text=text, host=parts.hostname, port=parts.port or PORT), given
    if parts.netloc or not re.match("/.", parts.path) or parts.scheme == "tcp":
        raise ValueError("it names neither a device nor a server")
    baud = given.pop("baud", str(BAUD))
    if not re.fullmatch("[1-9][0-9]*", baud):
        raise ValueError(f"the baud rate must be a positive whole number, got {baud!r}")
    return Wire(text=text, device=parts.path, baud=int(baud)), given
