"""A TCP port that a server of ours listens on."""

from __future__ import annotations

import socket

from rejoint.system.errors import InputError

BUFFER = 1 << 16
"""[bytes] that the system may keep for a connection each way: requests ahead, answers that nobody reads (chosen)"""


def listen_tcp(host: str, port: int, backlog: int = 1) -> socket.socket:
    """Listen on a TCP port, 0 for any free one; ``backlog`` clients may wait. InputError if that is not possible."""
    refusal = f"cannot listen on {host}:{port}"
    if not 0 <= port <= 65535:
        raise InputError(f"{refusal}: a port is a number from 0 to 65535")
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)  # the vendor's client knows no IPv6
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        for buffer in (socket.SO_RCVBUF, socket.SO_SNDBUF):  # connections inherit them
            listener.setsockopt(socket.SOL_SOCKET, buffer, BUFFER)
        listener.bind((host, port))
        listener.listen(backlog)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise InputError(f"{refusal} ({error.strerror or error}); choose another host or port") from error
    return listener
