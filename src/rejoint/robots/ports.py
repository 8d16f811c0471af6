"""Serial ports of this computer, why one cannot be opened, and which kind of arm answers there."""

import errno
import os
import socket
import time
from contextlib import suppress
from pathlib import Path
from select import select
from typing import Any
from urllib.parse import urlsplit

import serial
from serial.tools.list_ports import comports

from rejoint.robots.family import Place, Wire
from rejoint.system.errors import AddressError
from rejoint.system.files import read_shipped
from rejoint.system.records import value_type

HEARD = 0.15
"""[s] in which an arm answers (chosen: ten times its usual time)"""


@value_type
class Kind:
    """How arms of a kind are asked for a sign of life."""

    name: str
    tcp: str
    serial: str
    hello: tuple[str, ...]
    """questions, in hexadecimal digits"""
    begins: str
    """of an answer, in hexadecimal digits"""
    bauds: tuple[int, ...]
    """[1/s] the usual one first"""

    def scheme(self, wire: Wire) -> str:
        """Scheme of its address."""
        return self.tcp if wire.host else self.serial


KINDS = tuple(read_shipped(__file__, "kinds.toml", dict[str, Kind]).values())


def ports() -> dict[str, str]:
    """Return the serial ports of this computer, each with what the system says of it."""
    return {one.device: one.description for one in sorted(comports()) if one.vid is not None or "AMA" in one.device}


def why_closed(error: BaseException, device: str) -> str | None:
    """Say why a ``device`` cannot be opened and what to do, where its number tells."""
    match getattr(error, "errno", None):
        case errno.ENOENT | errno.ENODEV | errno.ENXIO:
            found = ", ".join(ports()) or "none; is the cable in, and the arm switched on?"
            return f"there is no port {device}; ports of this computer: {found}"
        case errno.EACCES | errno.EPERM:
            group = "dialout"
            with suppress(OSError, KeyError):
                group = Path(device).group()
            return f"no permission for {device}; run: sudo usermod -aG {group} $USER, then log out and in again"
        case errno.EBUSY | errno.EWOULDBLOCK:
            return "another program drives the arm there; end it first"
    return None


def refused(device: str) -> str | None:
    """Say why this user may not open a ``device``, and what to do; None: they may."""
    return None if os.access(device, os.R_OK | os.W_OK) else why_closed(PermissionError(errno.EACCES, ""), device)


def arm_at(device: str) -> str | None:
    """Return the address of the arm that answers at a serial port, or None."""
    wire = Wire(text=device, device=device)
    heard = answering(wire)
    return None if heard is None else address_at(wire, *heard)


def answering(wire: Wire) -> tuple[Kind, int] | None:
    """Ask every kind of arm for a sign of life; its kind and baud rate (TCP: 0), or None."""
    bauds = (0,) if wire.host else dict.fromkeys(baud for kind in KINDS for baud in kind.bauds)
    with suppress(OSError, ValueError):
        for baud in bauds:
            with opened(wire, baud, 1.0) as port:
                for kind in KINDS:
                    asked = kind.hello if not baud or baud in kind.bauds else ()
                    if any(bytes.fromhex(kind.begins) in _answer(port.fileno(), bytes.fromhex(one)) for one in asked):
                        return kind, baud
    return None


def opened(wire: Wire, baud: int, timeout: float) -> Any:  # noqa: ANN401 - a socket, or a serial line
    """Open a serial line at ``baud`` [1/s] for this program alone, or connect within ``timeout`` [s]; OSError."""
    if wire.device:
        return serial.Serial(wire.device, baud, exclusive=True)
    connection = socket.create_connection((wire.host, wire.port), timeout)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # small packets do not wait
    return connection


def _answer(port: int, question: bytes) -> bytes:
    """Return what comes within `HEARD`, or until it is longer than the question."""
    os.write(port, question)
    until, came = time.monotonic() + HEARD, b""
    while (left := until - time.monotonic()) > 0.0 and len(came) <= len(question):
        if select([port], [], [], left)[0]:
            if not (data := os.read(port, 64)):
                break
            came += data
    return came.removeprefix(question)  # some adapters echo


def other_arm(place: Place[Any]) -> str:
    """Say which arm answers at a ``place`` that another one does not; empty where nothing does."""
    wire = getattr(place.detail, "wire", place.detail)
    if not isinstance(wire, Wire) or (found := answering(wire)) is None:
        return ""
    kind, baud = found
    if (kind.scheme(wire), baud) == (place.family.scheme, wire.baud):
        return ""
    return f"{kind.name} answers there: give {address_at(wire, kind, baud)}"


def address_at(wire: Wire, kind: Kind, baud: int) -> str:
    """Return the address of an arm that answers at a ``baud`` rate."""
    where = f"{wire.host}:{wire.port}" if wire.host else wire.device
    return f"{kind.scheme(wire)}://{where}{f'?baud={baud}' if baud and baud != kind.bauds[0] else ''}"


def why_not(place: Place[Any], error: AddressError) -> str | None:
    """Say why the arm at a ``place`` could not be opened, if more than the ``error`` is known."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and (why := why_closed(cause, urlsplit(place.text).path)):
            return f"{place}: {why}"
        cause = cause.__cause__
    other = other_arm(place)
    return f"another arm than expected is at {place}; {other}" if other else None
