"""The vendor's client, kept honest and kept going: every failure becomes an error with a name, or is got over.

pymycobot reports failures as -1, as None, as struct.error from a cut frame, or as whatever the
operating system raised. Over TCP it never resynchronises: once an answer came late, every later
call returns the previous call's answer. So after a failed or late call both sides are brought into
step again (`_resynchronise`), or the connection is made anew, and the question is asked again, with
bounded patience; meanwhile the arm holds. Only calls that may be repeated go through here: reads, and
orders that name an absolute position or state.

The client's `async` mode is never used: over TCP it leaves answers behind that nobody reads.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import termios
import time
from collections.abc import Callable
from typing import Any, TypeVar

from rejoint.robots.address import SerialAddress, TcpAddress
from rejoint.robots.vendor import make_client, silenced
from rejoint.system.errors import (
    AddressError,
    ConnectionLostError,
    ImpossibleReplyError,
    NoReplyError,
    PowerLostError,
    RobotError,
    StaleReplyError,
    first_line,
)
from rejoint.system.stopping import check, ending, pause

PROBE_PATIENCE = 2.0
"""[s] for a TCP connection to be accepted; a robot in the same network needs milliseconds (chosen)"""
LATE = 0.3
"""[s] the client's own TCP timeout: a call that took longer was sent more than once"""
ATTEMPTS = 6
"""Times that a question is asked, each up to three times by the client itself, before its failure is an error (chosen:
where one answer in fifty is lost, three times fail once in twenty minutes, six times once in a lifetime)"""
PATIENCE = 10.0
"""[s] for which a link may be dead while an arm is driven, before that is an error (chosen: a server that is started
again needs less; the arm holds meanwhile)"""
LAST_PATIENCE = 3.0
"""[s] of the same for the order to stop (chosen: it should still get through a lost answer)"""
SILENCE = 3.0
"""[s] of silence on a standing connection after which a new one is tried (chosen: twice the pauses that a firmware
takes which was asked too much: 1.5 to 2.6 s, as a debug log of a myCobot 280 shows)"""
REOPEN_PAUSE = 0.5
"""[s] between attempts to connect again; each also takes the 1.5 s that the client sleeps (chosen)"""
QUIET = 0.03
"""[s] of silence after which no answer is on its way any more (chosen: twice what an answer takes)"""
RELAY_BUSY = 0.6
"""[s] during which the vendor's server may still wait for a robot's answer (its own limit is 0.5 s)"""
POWER_UP = 3.0
"""[s] to wait for the servos after power_on (chosen)"""
_CUT_FRAME = (struct.error, IndexError, KeyError, TypeError, ValueError, UnicodeError)
_BROKEN = (OSError, EOFError, termios.error)

T = TypeVar("T")


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

        After a failure both sides are brought into step, or connected anew, and the call is repeated. Raises
        NoReplyError, ImpossibleReplyError (garbled), StaleReplyError (late), ConnectionLostError or, if the arm lost
        its power meanwhile, PowerLostError.
        """
        if self._client is None:
            raise ConnectionLostError(f"{self.address}: not connected; open the robot again")
        return self._persist(lambda: self._once(method, arguments), self._recover)

    def insist(self, question: Callable[[], T]) -> T:
        """Ask a ``question`` again whose answer was impossible, `ATTEMPTS` times: a bad byte is no reason to end."""
        for _ in range(ATTEMPTS):
            try:
                return question()
            except ImpossibleReplyError:
                with contextlib.suppress(ConnectionLostError):  # the next question tries more than that
                    self._resynchronise(time.monotonic() + SILENCE)
        return question()

    def close(self) -> None:
        """Drop the connection; the arm holds."""
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(*_BROKEN):
                client.close()

    def _persist(
        self, question: Callable[[], T], recover: Callable[[RobotError, float], None], until: float | None = None
    ) -> T:
        """Ask up to `ATTEMPTS` times, each failure but the last followed by ``recover(error, deadline)``.

        The deadline is ``until`` [s], or where there is none yet, the patience from now on.
        """
        attempt, began = 0, time.monotonic()
        while True:
            attempt += 1
            try:
                return question()
            except PowerLostError:
                raise
            except RobotError as error:
                check()
                deadline = began + (LAST_PATIENCE if ending() else PATIENCE) if until is None else until
                if attempt >= ATTEMPTS or time.monotonic() > deadline:
                    raise
                recover(error, deadline)

    def _once(self, method: str, arguments: tuple[object, ...]) -> object:
        self._refuse_surplus()
        began = time.monotonic()
        try:
            with silenced() if method == "get_servo_status" else contextlib.nullcontext():
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
        """Refuse to ask while bytes lie there that nobody asked for: they would be taken for the next answer."""
        if self._drain(0.0):
            raise StaleReplyError(f"{self.address}: answers arrive that nobody asked for")

    def _drain(self, quiet: float) -> bool:
        """Throw away what lies on a TCP connection until nothing has come for ``quiet`` [s]; tells if there was any.

        On a serial port the client throws it away itself.
        """
        found = False
        if not isinstance(self.address, TcpAddress):
            return found
        try:
            while select.select([self._client.sock], [], [], quiet)[0]:
                found = True
                if not self._client.sock.recv(4096):
                    raise ConnectionLostError(f"{self.address}: the other side closed the connection")
                if quiet == 0.0:
                    break
        except _BROKEN as error:
            raise ConnectionLostError(f"{self.address}: the connection broke ({error})") from error
        return found

    def _recover(self, error: RobotError, deadline: float) -> None:
        """Bring both sides into step after ``error``, on a new connection if there is no other way."""
        if not isinstance(error, ConnectionLostError):
            try:
                self._resynchronise(min(deadline, time.monotonic() + SILENCE))
            except ConnectionLostError as broken:
                error = broken
            else:
                return
        self._reopen(error, deadline)

    def _resynchronise(self, deadline: float) -> None:
        """Wait until no late answer can be taken for another one; ConnectionLostError if that cannot be had.

        Answers come in the order of the questions. So once a question of another kind has been answered at once, and
        nothing comes after it, nothing of what was asked before is on its way any more.
        """
        if not isinstance(self.address, TcpAddress):
            return
        while time.monotonic() < deadline:
            self._drain(QUIET)
            with contextlib.suppress(NoReplyError, ImpossibleReplyError, StaleReplyError):
                if self._once("get_fresh_mode", ()) in (0, 1) and not self._drain(QUIET):
                    return
        raise ConnectionLostError(f"{self.address}: answers are out of step")

    def _reopen(self, cause: RobotError, deadline: float) -> None:
        """Connect again; ConnectionLostError if that fails, PowerLostError if the arm lost its power meanwhile."""
        while True:
            try:
                self._connect()
                self._prepare(power_on=False, until=deadline)
                return
            except PowerLostError:
                raise
            except RobotError as error:
                if time.monotonic() + REOPEN_PAUSE > deadline:
                    raise ConnectionLostError(f"{cause}; connecting again failed: {error}") from cause
                pause(REOPEN_PAUSE)

    def _connect(self) -> None:
        """Make a client; ConnectionLostError in one line if nothing is there."""
        self.close()
        try:
            if isinstance(self.address, TcpAddress):
                with socket.create_connection((self.address.host, self.address.port), PROBE_PATIENCE):
                    pass  # the client itself would wait for minutes
            self._client = make_client(self.address)
        except (*_BROKEN, ValueError) as error:
            raise ConnectionLostError(
                f"nothing answers at {self.address} ({first_line(error)}); is the arm switched on, its server running, "
                "and the address right? `rejoint emulate` starts an arm to try"
            ) from error

    def _prepare(self, *, power_on: bool, until: float | None = None) -> None:
        is_on = self._confirm("is_power_on", until)
        if is_on != 1 and self._confirm("is_power_on", until) != 1:  # one wrong byte is no news
            if not power_on:
                raise PowerLostError(f"{self.address}: the arm lost its power; support it, then start again")
            self._confirm("power_on")
            self._await_power()
        for _ in range(ATTEMPTS + 1):
            if self._confirm("get_fresh_mode", until) == 1:
                return
            with contextlib.suppress(NoReplyError, StaleReplyError, ImpossibleReplyError):
                self._once("set_fresh_mode", (1,))
                continue
            # The vendor's server swallows acknowledgements that equal their order, as this one does.
            pause(RELAY_BUSY)
        raise NoReplyError(f"{self.address}: the arm does not take up fresh mode; update its firmware to 7.3")

    def _confirm(self, method: str, until: float | None = None) -> object:
        """Ask during the preparation of a connection, which must not be made anew by itself; ``until`` as above."""

        def recover(error: RobotError, deadline: float) -> None:
            if isinstance(error, ConnectionLostError):
                raise error
            self._resynchronise(deadline)

        return self._persist(lambda: self._once(method, ()), recover, until)

    def _await_power(self) -> None:
        deadline = time.monotonic() + POWER_UP
        while self._confirm("is_power_on") != 1:
            if time.monotonic() > deadline:
                raise NoReplyError(f"{self.address}: the servos do not power on; check supply and emergency stop")
            pause(0.1)
