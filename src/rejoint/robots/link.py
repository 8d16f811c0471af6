"""The vendor's client, kept honest: every failure becomes an error with a name.

pymycobot reports failures as -1, as None, as struct.error from a cut frame, or as whatever the
operating system raised. Over TCP it never resynchronises: once an answer came late, every later
call returns the previous call's answer, until a new connection is made. So a failed or late call
closes the connection; the call is repeated on a new one, once. Only calls that may be repeated go
through here: reads, and orders that name an absolute position or state.

The client's `async` mode is never used: over TCP it leaves answers behind that nobody reads.
"""

from __future__ import annotations

import contextlib
import io
import logging
import select
import socket
import struct
import termios
import time
import warnings
from collections.abc import Iterator
from typing import Any

from rejoint.errors import (
    AddressError,
    ConnectionLostError,
    ImpossibleReplyError,
    NoReplyError,
    RobotError,
    StaleReplyError,
    first_line,
)
from rejoint.robots.address import SerialAddress, TcpAddress
from rejoint.robots.vendor import MyCobot280, MyCobot280Socket

PROBE_PATIENCE = 2.0
"""[s] for a TCP connection to be accepted; a robot in the same network needs milliseconds (chosen)"""
LATE = 0.3
"""[s] the client's own TCP timeout: a call that took longer was sent more than once"""
REOPEN_ATTEMPTS = 3
REOPEN_PAUSE = 0.5
"""[s] between attempts to connect again; together with the client's 1.5 s start a pause of 2-5 s (chosen)"""
RELAY_BUSY = 0.6
"""[s] during which the vendor's server may still wait for a robot's answer (its own limit is 0.5 s)"""
POWER_UP = 3.0
"""[s] to wait for the servos after power_on (chosen)"""
_CUT_FRAME = (struct.error, IndexError, KeyError, TypeError, ValueError, UnicodeError)
_BROKEN = (OSError, EOFError, termios.error)


class VendorLink:
    """A connection to a myCobot 280 through ``pymycobot``; opened by `open`, not by construction."""

    def __init__(self, address: TcpAddress | SerialAddress) -> None:
        self.address = address
        self._client: Any = None

    def open(self) -> None:
        """Connect and get the arm ready; AddressError if nothing usable answers there.

        The arm is powered on if it is off (it then holds where it is) and put into fresh mode, in
        which the newest command wins. Nothing moves. Takes 1.5 s, which the client sleeps.
        """
        try:
            self._connect()
        except ConnectionLostError as error:
            raise AddressError(str(error)) from error
        try:
            self._prepare(power_on=True)
        except RobotError as error:
            self.close()
            raise AddressError(
                f"something listens at {self.address}, but no myCobot 280 answers ({error}); "
                "is it switched on, and is no other client connected?"
            ) from error

    def ask(self, method: str, *arguments: object) -> object:
        """Call a method of the client that may safely be repeated, and return its answer.

        After a failure the connection is made again and the call repeated, once. Raises NoReplyError,
        ImpossibleReplyError (garbled), StaleReplyError (late) or ConnectionLostError.
        """
        if self._client is None:
            raise ConnectionLostError(f"{self.address}: not connected; open the robot again")
        try:
            return self._once(method, arguments)
        except RobotError as first:
            if isinstance(self.address, TcpAddress) or isinstance(first, ConnectionLostError):
                self._reopen(first)
        return self._once(method, arguments)

    def close(self) -> None:
        """Drop the connection; the arm holds."""
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(*_BROKEN):
                client.close()

    def _once(self, method: str, arguments: tuple[object, ...]) -> object:
        self._refuse_surplus()
        began = time.monotonic()
        try:
            with _silenced() if method == "get_servo_status" else contextlib.nullcontext():
                answer: object = getattr(self._client, method)(*arguments)
        except _BROKEN as error:
            raise ConnectionLostError(f"{self.address}: the connection broke during {method} ({error})") from error
        except _CUT_FRAME as error:
            raise ImpossibleReplyError(f"{self.address}: garbled answer to {method} ({error})") from error
        took = time.monotonic() - began
        if answer is None or (isinstance(answer, int) and answer == -1):
            raise NoReplyError(f"{self.address}: no usable answer to {method} within {took:.1f} s")
        if isinstance(self.address, TcpAddress) and took > LATE:
            raise StaleReplyError(
                f"{self.address}: the answer to {method} took {took:.2f} s, more than {LATE} s; "
                "later answers would be those of earlier questions"
            )
        return answer

    def _refuse_surplus(self) -> None:
        """Refuse to ask while bytes lie there that nobody asked for: they would be taken for the next answer.

        The two sides are out of step then, and only a new connection helps.
        """
        if not isinstance(self.address, TcpAddress):
            return  # on a serial port the client throws them away itself
        try:
            if not select.select([self._client.sock], [], [], 0.0)[0]:
                return
            surplus = self._client.sock.recv(4096)
        except _BROKEN as error:
            raise ConnectionLostError(f"{self.address}: the connection broke ({error})") from error
        if not surplus:
            raise ConnectionLostError(f"{self.address}: the other side closed the connection")
        raise StaleReplyError(f"{self.address}: answers arrive that nobody asked for")

    def _reopen(self, cause: RobotError) -> None:
        """Connect again; ConnectionLostError if that fails or if the arm lost its power meanwhile."""
        self.close()
        for attempt in range(REOPEN_ATTEMPTS):
            try:
                self._connect()
                break
            except ConnectionLostError as error:
                if attempt == REOPEN_ATTEMPTS - 1:
                    raise ConnectionLostError(f"{cause}; connecting again failed: {error}") from cause
                time.sleep(REOPEN_PAUSE)
        self._prepare(power_on=False)

    def _connect(self) -> None:
        """Make a client; ConnectionLostError in one line if nothing is there."""
        self.close()
        try:
            if isinstance(self.address, TcpAddress):
                with socket.create_connection((self.address.host, self.address.port), PROBE_PATIENCE):
                    pass  # the client itself would wait for minutes
            self._client = _make_client(self.address)
        except (*_BROKEN, ValueError) as error:
            raise ConnectionLostError(
                f"nothing answers at {self.address} ({first_line(error)}); is the arm switched on, its server running, "
                "and the address right? `rejoint emulate` starts an arm to try"
            ) from error

    def _prepare(self, *, power_on: bool) -> None:
        if self._once("is_power_on", ()) != 1:
            if not power_on:
                raise ConnectionLostError(f"{self.address}: the arm lost its power; support it, then start again")
            self._once("power_on", ())
            self._await_power()
        if self._once("get_fresh_mode", ()) == 1:
            return
        try:
            self._once("set_fresh_mode", (1,))
        except (NoReplyError, StaleReplyError):
            # The vendor's server swallows acknowledgements that equal their order, as this one does.
            time.sleep(RELAY_BUSY)
        if self._once("get_fresh_mode", ()) != 1:
            raise NoReplyError(f"{self.address}: the arm does not take up fresh mode; update its firmware to 7.3")

    def _await_power(self) -> None:
        deadline = time.monotonic() + POWER_UP
        while self._once("is_power_on", ()) != 1:
            if time.monotonic() > deadline:
                raise NoReplyError(f"{self.address}: the servos do not power on; check supply and emergency stop")
            time.sleep(0.1)


def _make_client(address: TcpAddress | SerialAddress) -> MyCobot280 | MyCobot280Socket:
    """Construct the vendor's client, and take back what it does to the logging of the whole process."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        if isinstance(address, TcpAddress):
            return MyCobot280Socket(address.host, address.port)
        return MyCobot280(address.device, address.baud)
    finally:
        root.handlers[:], root.level = handlers, level
        logging.getLogger("pymycobot").setLevel(logging.CRITICAL)  # failures become errors here


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Keep what the client prints, and a deprecation that it raises, from the user."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield
