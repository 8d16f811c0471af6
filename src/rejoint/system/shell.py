"""Command lines of ours, memory, and sockets."""

import ctypes
import os
import shlex
import socket
from contextlib import suppress
from importlib import import_module
from importlib.metadata import version
from ipaddress import ip_address
from typing import Any

from rejoint.system.errors import InputError


def command(*words: object) -> str:
    """``rejoint`` with ``words``, quoted for a shell."""
    return shlex.join(["rejoint", *map(str, words)])


def free_cores() -> int:
    """Return how many processors one call may use: all, or one where OMP_NUM_THREADS says so."""
    return 1 if os.environ.get("OMP_NUM_THREADS") == "1" else os.cpu_count() or 1


def give_back() -> None:
    """Return free memory to the system (glibc)."""
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


class Late:
    """A module imported at first use.

    `importlib.util.LazyLoader` is not thread-safe in Python 3.11.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:  # noqa: ANN401
        value = getattr(import_module(self._name), attribute)
        setattr(self, attribute, value)  # the next time it is found at once
        return value


BUFFER = 1 << 16
"""[bytes] per connection and direction (chosen)"""


def host_and_port(option: str, text: str) -> tuple[str, int]:
    """Read HOST:PORT of an ``option``, or a port of this computer alone; InputError for anything else."""
    host, _, port = (text if ":" in text else f"127.0.0.1:{text}").rpartition(":")
    if not host or not (port.isascii() and port.isdecimal()) or int(port) > 65535:
        raise InputError(f"{option} {text!r}: expected HOST:PORT, such as 127.0.0.1:9000")
    return host, int(port)


def is_loopback(host: str) -> bool:
    """Whether this computer alone reaches a host name."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def listen_tcp(host: str, port: int, backlog: int = 1) -> socket.socket:
    """Listen on a TCP port, 0: any free one; one client waits, as at the vendor's; InputError."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)  # the vendor's client knows no IPv6
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        for buffer in (socket.SO_RCVBUF, socket.SO_SNDBUF):  # connections inherit them
            listener.setsockopt(socket.SOL_SOCKET, buffer, BUFFER)
        listener.bind((host, port))
        listener.listen(backlog)
        listener.setblocking(False)
    except (OSError, OverflowError) as error:
        listener.close()
        raise InputError(f"cannot listen on {host}:{port} ({error.args[-1]}); choose another host or port") from error
    return listener


__version__ = version("rejoint")
