"""``--live``: a page that shows the arm while a command drives it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from ipaddress import ip_address
from typing import TYPE_CHECKING

from rejoint.cli.console import Terminal
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.progress import Progress

if TYPE_CHECKING:
    from rejoint.pages.live.view import LiveView

OPTION = "--live"
HERE = "127.0.0.1:8080"
"""Where the page is unless something else is said: this computer alone reaches it"""
_PLACE = re.compile(r"(?P<host>[A-Za-z0-9_.-]+):(?P<port>\d{1,5})")


def with_place(words: Sequence[str]) -> list[str]:
    """Give a bare ``--live`` its place: what follows belongs to it only where it reads HOST:PORT."""
    return [
        f"{OPTION}={HERE}" if word == OPTION and not _PLACE.fullmatch("".join(words[k + 1 : k + 2])) else word
        for k, word in enumerate(words)
    ]


@contextmanager
def live_view(terminal: Terminal, place: str | None, title: str) -> Iterator[LiveView | None]:
    """Serve the page at ``place`` while a command, called ``title``, does its work; None where nobody asked for it."""
    if place is None:
        yield None
        return
    require(f"rejoint {title} {OPTION}", "live")
    from rejoint.pages.live.view import LiveView

    host, port = host_and_port(place)
    view = LiveView(host, port)
    with view:
        terminal.say(f"Live view: {view.address}")
        if not _loopback(host):
            terminal.say(
                "Whoever reaches this computer can look and press the button there: nobody is asked for a password. "
                f"Better use {OPTION} alone, and on the computer with the browser: ssh -L {port}:127.0.0.1:{port} HOST"
            )
        view.begin(title)
        yield view
    if view.failure:
        terminal.say(f"The live view ended early ({view.failure}); the arm was driven all the same.")


def shared(update: Progress, view: LiveView | None) -> Progress:
    """Return a progress that tells the terminal and the page."""
    if view is None:
        return update
    heard: tuple[Callable[[float, str], object], ...] = (update, view.progress)
    return lambda share, what: [hear(share, what) for hear in heard]


def host_and_port(place: str) -> tuple[str, int]:
    """Read HOST:PORT; InputError for anything else."""
    found = _PLACE.fullmatch(place)
    if found is None or int(found["port"]) > 65535:
        raise InputError(f"{OPTION} {place!r}: expected HOST:PORT, such as {HERE}, or nothing")
    return found["host"], int(found["port"])


def _loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
