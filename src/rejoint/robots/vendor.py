"""What is used of the vendor's package: two clients, their table of limits, what keeps them quiet, and their clock.

Importing pymycobot 4.0.7 asks the locale in a way that Python has deprecated; the user can do
nothing about it and does not hear of it. On a serial line the client waits for an answer by the wall clock: where that
is set back meanwhile it would wait for as long as that, and hear no signal. It gets the clock that is never set.
"""

from __future__ import annotations

import contextlib
import errno
import locale
import logging
import time
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from types import SimpleNamespace

from rejoint.robots.address import SerialAddress, TcpAddress

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from pymycobot import MyCobot280, MyCobot280Socket, common
    from pymycobot.robot_info import RobotLimit

_silent: ContextVar[bool] = ContextVar("silent", default=False)


def _print(*words: object) -> None:
    """Print as the client does, but where it is `silenced`."""
    if not _silent.get():
        print(*words)  # noqa: T201 - for programs that use the client themselves


# What the client prints is kept back at the client: standard output belongs to all threads of the user's program.
common.print = _print
common.locale = SimpleNamespace(getdefaultlocale=locale.getlocale)  # the same, without a deprecation at each question
common.time = SimpleNamespace(time=time.monotonic, sleep=time.sleep)  # all that it uses of it

LOWEST_DEG: tuple[float, ...] = tuple(RobotLimit.robot_limit["MyCobot280"]["angles_min"])
"""[deg] lowest joint angles that the clients accept"""
HIGHEST_DEG: tuple[float, ...] = tuple(RobotLimit.robot_limit["MyCobot280"]["angles_max"])
"""[deg] highest joint angles that the clients accept"""


def make_client(address: TcpAddress | SerialAddress) -> MyCobot280 | MyCobot280Socket:
    """Construct the vendor's client, and take back what it does to the logging of the whole process.

    Its constructor connects, and then sleeps for 1.5 s. OSError where another program of ours has the serial port: it
    would let both drive the arm.
    """
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        if isinstance(address, TcpAddress):
            return MyCobot280Socket(address.host, address.port)
        client = MyCobot280(address.device, address.baud)
    finally:
        root.handlers[:], root.level = handlers, level
        logging.getLogger("pymycobot").setLevel(logging.CRITICAL)  # failures become errors in `rejoint.robots.link`
    try:
        client._serial_port.exclusive = True  # it opens the port for everybody
    except OSError as error:
        client.close()
        if error.errno != errno.EWOULDBLOCK:
            raise
        raise OSError("another program drives the arm there; end it first") from error
    return client


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Keep what the client prints in this thread from the user."""
    before = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(before)


__all__ = ["HIGHEST_DEG", "LOWEST_DEG", "MyCobot280", "MyCobot280Socket", "make_client", "silenced"]
