"""A myCobot 280, real or emulated, through the vendor's client.

Over TCP pymycobot never resynchronises: after a late answer every call returns the previous one. So no question is
asked while bytes wait, and failures resynchronise both sides.
"""

import contextlib
import locale
import logging
import select
import socket
import time
import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.robots.bus import ATTEMPTS, SILENCE, UNANSWERED, Bus, Reading, Vitals, asked, persist
from rejoint.robots.family import Wire
from rejoint.system.errors import (
    ConnectionLostError,
    ImpossibleReplyError,
    InputError,
    NoReplyError,
    PowerLostError,
    RobotError,
    StaleReplyError,
)

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from pymycobot import MyCobot280, MyCobot280Socket, common
    from pymycobot.robot_info import RobotLimit

common.print = lambda *_: None  # standard output belongs to the user's program
common.locale = SimpleNamespace(getdefaultlocale=locale.getlocale)  # the same, without a deprecation at each question
common.time = SimpleNamespace(time=time.monotonic, sleep=time.sleep)  # all that it uses of it

_LIMITS: dict[str, list[float]] = RobotLimit.robot_limit["MyCobot280"]
LOWEST_DEG, HIGHEST_DEG = _LIMITS["angles_min"], _LIMITS["angles_max"]
"""of the clients"""


_CODES = [(code, name.lower()) for name, code in vars(common.ProtocolCode).items() if isinstance(code, int)]
ORDERS: dict[int, str] = dict(reversed(_CODES))
"""The client's names of commands"""


def make_client(address: Wire) -> MyCobot280 | MyCobot280Socket:
    """Construct the vendor's client; OSError for a busy port."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        if address.host:
            return MyCobot280Socket(address.host, address.port)
        client = MyCobot280(address.device, address.baud)
    finally:
        root.handlers[:], root.level = handlers, level
        logging.getLogger("pymycobot").setLevel(logging.CRITICAL)  # failures become errors in `rejoint.robots.bus`
    try:
        client._serial_port.exclusive = True  # it opens the port for everybody
    except OSError:
        client.close()
        raise
    return client


SENT = 3
"""Attempts before a refusal counts (chosen)"""
SPEED_PERCENT = 100
"""of the firmware's limit (chosen: the guard limits)"""
UNREADABLE_DEG = 180.08
"""[deg] of an unreadable servo (elephantrobotics/pymycobot, issue 43)"""
PROBE_TIMEOUT = 2.0
"""[s] of a TCP connection (chosen)"""
LATE = 0.3
"""[s] the client's TCP timeout; later calls were sent twice"""
QUIET = 0.03
"""[s] without a late answer (chosen: twice an answer)"""
RELAY_BUSY = 0.6
"""[s] after a lost answer (the vendor's limit is 0.5 s)"""
QUIET_RELAY = 3.0
"""[s] of resynchronisation after an unknown command (chosen, as `link.SILENCE`)"""
POWER_UP = 3.0
"""[s] after power_on (chosen)"""
FAULTS = {0: "voltage", 1: "encoder", 2: "heat", 3: "over-current", 5: "overload"}
"""by bit of a servo's status"""
_JOINTS = len(LOWEST_DEG)


class MyCobotBus(Bus):
    """The wire of a myCobot 280, powered and in fresh mode: the newest command wins."""

    name = "myCobot 280"
    advice = f"{Bus.advice} `rejoint emulate` starts an arm to try"

    def __init__(self, address: Wire, arm: Arm) -> None:
        if arm.joints != _JOINTS:
            raise InputError(f"a myCobot 280 has {_JOINTS} joints, arm {arm.name} has {arm.joints}")
        self.address = address
        self._client: Any = None
        self._was_ready = False

    def open(self) -> None:
        """Make a client."""
        if self.address.host:
            with socket.create_connection((self.address.host, self.address.port), PROBE_TIMEOUT):
                pass  # the client itself would wait for minutes
        self._client = make_client(self.address)

    def prepare(self, until: float | None = None) -> None:
        """Check the power, switch it on the first time, and set fresh mode."""
        if all(self._confirm("is_power_on", until) != 1 for _ in range(2)):  # one wrong byte is no news
            if self._was_ready:
                raise PowerLostError(f"{self.address}: the arm lost its power; support it, then start again")
            self._confirm("power_on")
            deadline = self.clock.now() + POWER_UP
            while self._confirm("is_power_on") != 1:
                if self.clock.now() > deadline:
                    raise NoReplyError(f"{self.address}: the servos do not power on; check supply and emergency stop")
                self.clock.wait(0.1)
        for _ in range(ATTEMPTS + 1):
            if self._confirm("get_fresh_mode", until) == 1:
                self._was_ready = True
                return
            with contextlib.suppress(*UNANSWERED):
                self.ask("set_fresh_mode", 1)
                continue
            # The vendor's server swallows acknowledgements that equal their order, as this one does.
            self.clock.wait(RELAY_BUSY)
        raise NoReplyError(f"{self.address}: the arm does not take up fresh mode; update its firmware to 7.3")

    def read(self) -> Reading:
        """Ask for the joint positions."""
        return Reading(position=read_angles(self.ask("get_angles")))

    def vitals(self) -> tuple[Callable[[], Vitals], ...]:
        """Temperatures and faults; older firmware is silent."""
        return lambda: Vitals(temperature=_numbers(self.ask("get_servo_temps"), "temperatures")), self._faults

    def send(self, goal: Array) -> None:
        """Send joint positions, clipped to the client's limits."""
        for _ in range(SENT):
            answer = self.ask("send_angles", wire_angles(goal), SPEED_PERCENT)
            if answer == 1:
                return
        error = self.ask("get_error_information")
        raise RobotError(f"{self.address}: the arm refused a command (answer {answer}, error code {error})")

    def stop(self) -> None:
        """Stop by the vendor's order."""
        self.ask("stop")

    def relay(self, command: int, payload: bytes) -> bytes | None:
        """Send a client's command by number; None: no answer."""
        try:
            answer = self.ask("_mesg", command, *payload)
        except NoReplyError:
            self.resynchronise(self.clock.now() + QUIET_RELAY)
            return None
        values: Any = answer if isinstance(answer, list) else [answer]
        with contextlib.suppress(TypeError, ValueError):  # they are no bytes
            return bytes(values)
        return None

    def resynchronise(self, deadline: float) -> None:
        """Wait until no late answer is pending; ConnectionLostError.

        An immediate answer to another question, and silence after it, show that.
        """
        if self.address.device:
            return
        found = "no time was left"
        while self.clock.now() < deadline:
            self._drain(QUIET)
            try:
                if self.ask("get_fresh_mode") in (0, 1) and not self._drain(QUIET):
                    return
                found = "unexpected answers arrive"
            except UNANSWERED as error:
                found = str(error).removeprefix(f"{self.address}: ")
        raise ConnectionLostError(
            f"{self.address}: answers stay away, or come late, in pieces or in disorder ({found})"
        )

    def close(self) -> None:
        """Drop the client."""
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def _faults(self) -> Vitals:
        reply = self.ask("get_servo_status")
        if not isinstance(reply, list) or len(reply) != _JOINTS:
            raise ImpossibleReplyError(f"expected the status of {_JOINTS} servos, got {reply!r}")
        words = [", ".join(FAULTS.get(bit, "a fault") for bit in bits or ()) for bits in reply]
        return Vitals(fault=np.array(words, bool), trouble=tuple(words))

    def ask(self, method: str, *arguments: object) -> object:
        """Return what a method of the vendor's client answers; RobotError."""
        if self._drain(0.0):
            raise StaleReplyError(f"{self.address}: unexpected answers arrive")
        began = self.clock.now()

        def call() -> object:
            try:
                return getattr(self._client, method)(*arguments)
            except (KeyError, TypeError) as error:  # of the client, by a frame that is cut
                raise ValueError(f"{method}: {error!r}") from error

        answer = asked(call, self.address)
        took = self.clock.now() - began
        if answer is None or (isinstance(answer, int) and answer == -1):
            raise NoReplyError(f"{self.address}: no usable answer to {method} within {took:.1f} s")
        if self.address.host and took > LATE:
            raise StaleReplyError(
                f"{self.address}: the answer to {method} took {took:.2f} s, more than {LATE} s; "
                "later answers would be those of earlier questions"
            )
        return answer

    def _drain(self, quiet: float) -> bool:
        """Drop TCP bytes until none came for ``quiet`` [s]; whether any did."""
        found = False
        while self.address.host and select.select([self._client.sock], [], [], quiet)[0]:
            found = True
            if not self._client.sock.recv(4096):
                raise OSError("the other side closed it")
            if quiet == 0.0:
                break
        return found

    def _confirm(self, method: str, until: float | None = None) -> object:
        def recover(_: RobotError, deadline: float) -> None:
            self.resynchronise(deadline if until is None else min(deadline, self.clock.now() + SILENCE))

        return persist(lambda: self.ask(method), recover, self.clock, self.address, until)


def read_angles(reply: object) -> Array:
    """Joint positions (n,) [rad] of an answer in degrees, NaN: unreadable."""
    degrees = _numbers(reply, "joint angles")
    degrees[np.abs(np.abs(degrees) - UNREADABLE_DEG) < 0.005] = np.nan
    return np.radians(degrees)


def wire_angles(position: Array) -> list[float]:
    """Degrees (n,) for the truncating client, within limits."""
    hundredths = np.round(np.degrees(position) * 100.0)
    degrees = (hundredths + 0.25 * np.sign(hundredths)) / 100.0
    return np.clip(degrees, LOWEST_DEG, HIGHEST_DEG).tolist()


def _numbers(reply: object, what: str) -> Array:
    numbers = reply if isinstance(reply, list) else []
    if len(numbers) != _JOINTS or not all(type(value) in (int, float) for value in numbers):
        raise ImpossibleReplyError(f"expected {_JOINTS} {what}, got {reply!r}")
    return np.array(numbers, dtype=float)
