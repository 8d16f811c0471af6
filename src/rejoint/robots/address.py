"""Forms of address that robot families share: a server's host and port, a serial device."""

from __future__ import annotations

import os
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

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
