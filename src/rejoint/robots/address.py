"""Robot addresses: ``emulated:PROFILE``, ``tcp://HOST:PORT``, ``serial:///dev/DEVICE?baud=N``."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

from rejoint.system.errors import AddressError

FORMS = "emulated:PROFILE (such as emulated:worn, or a .toml file), tcp://HOST:PORT, serial:///dev/DEVICE"
DEFAULT_PORT = 9000
"""TCP port of the vendor's server on the robot."""
DEFAULT_BAUD = 1_000_000
"""[1/s] of the serial port on the robot's Raspberry Pi (vendor's manual); the M5 version needs 115200."""


@dataclass(frozen=True, kw_only=True)
class EmulatedAddress:
    """An arm in this process, in virtual time."""

    profile: str


@dataclass(frozen=True, kw_only=True)
class TcpAddress:
    """A myCobot's server, or an emulator."""

    text: str
    """as the user wrote it"""
    host: str
    port: int

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, kw_only=True)
class SerialAddress:
    """A myCobot's serial port, or an emulator's pseudo-terminal."""

    text: str
    """as the user wrote it"""
    device: str
    baud: int

    def __str__(self) -> str:
        return self.text


Address = EmulatedAddress | TcpAddress | SerialAddress


def parse_address(text: str) -> Address:
    """Read an address; AddressError names the forms for anything else."""
    scheme, colon, rest = text.partition(":")
    try:
        if colon and scheme == "emulated" and rest and not rest.startswith("//"):
            return EmulatedAddress(profile=rest)
        if colon and scheme == "tcp":
            return _tcp(text)
        if colon and scheme == "serial":
            return _serial(text)
    except ValueError as error:
        raise AddressError(f"robot address {text!r}: {error}; expected {FORMS}") from error
    raise AddressError(f"unknown robot address {text!r}; expected {FORMS}")


def _tcp(text: str) -> TcpAddress:
    parts = urlsplit(text)
    port = DEFAULT_PORT if parts.port is None else parts.port
    if not parts.hostname or parts.path not in ("", "/") or parts.query or parts.username or port == 0:
        raise ValueError("not of the form tcp://HOST:PORT")
    return TcpAddress(text=text, host=parts.hostname, port=port)


def _serial(text: str) -> SerialAddress:
    parts = urlsplit(text)
    query = parse_qs(parts.query, strict_parsing=True) if parts.query else {}
    if parts.netloc or not parts.path.startswith("/") or parts.path == "/" or set(query) - {"baud"}:
        raise ValueError("not of the form serial:///dev/DEVICE?baud=N")
    baud = query.get("baud", [str(DEFAULT_BAUD)])[-1]
    if not (baud.isascii() and baud.isdecimal() and int(baud) > 0):
        raise ValueError(f"the baud rate must be a positive whole number, got {baud!r}")
    return SerialAddress(text=text, device=parts.path, baud=int(baud))
