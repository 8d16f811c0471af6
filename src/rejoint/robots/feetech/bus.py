"""An SO-100 or SO-101 on its servo bus: one synchronous read and write per cycle.

Torque is never switched off. Only `Tuning.keep` unlocks the servos' memory.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Self, TypeVar

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.servogains import Rung, ServoGains
from rejoint.robots.bus import Bus, Reading, persist
from rejoint.robots.family import SerialAddress
from rejoint.robots.feetech.gains import FULL, RUNGS, FeetechAddress, Tuning, for_all
from rejoint.robots.feetech.wire import (
    BLOCK,
    PRESENT,
    VOLT,
    Counts,
    Wire,
    Zeros,
    decode,
    read_calibration,
    signed,
    zeros_of,
)
from rejoint.system.errors import (
    ConnectionLostError,
    ImpossibleReplyError,
    NoReplyError,
    PowerLostError,
    RobotError,
    first_line,
)

READ, WRITE = 2, 3
"""Instructions of `FeetechBus.relay`: servo ID, address, and size or data"""
_LIMITS, _GOAL, _TORQUE_LIMIT, _PRESENT = 9, 42, 48, 56
SOFT = 0.5
"""torque share of the gripper, in RAM (as in LeRobot)"""

MOST_SILENT = 3
"""Unanswered questions before it is given up (chosen)"""

Ask = Callable[[int, bytes], bytes | None]
"""Passes on an instruction; None: no answer"""


class Gripper:
    """A servo from ``low`` (0 %) to ``high`` (100 %) [counts]; call `serve` each cycle."""

    def __init__(self, ask: Ask, number: int, low: int, high: int) -> None:
        self.goal: float | None = None
        """[%]"""
        self.opened: float | None = None
        """[%] last reading"""
        self._ask, self._number, self._low, self._high = ask, number, low, high
        self._sent: float | None = None
        self._silent = 0

    @classmethod
    def find(cls, ask: Ask, number: int) -> Self | None:
        """Gripper with the ID ``number``; None: no answer, or no range."""
        try:
            data = ask(READ, bytes([number, _LIMITS, 4]))
        except RobotError:
            return None
        if data is None:
            return None
        low, high = struct.unpack("<HH", data)
        found = cls(ask, number, low, high) if low < high else None
        if found is not None:
            found._read()
        return found

    def serve(self) -> None:
        """Send a new goal, or read the opening."""
        if self._silent >= MOST_SILENT:
            return
        try:
            if self.goal is not None and self.goal != self._sent:
                self._send(self.goal)
            else:
                self._read()
            self._silent = 0
        except RobotError:
            self._silent += 1

    def _read(self) -> None:
        data = self._ask(READ, bytes([self._number, _PRESENT, 2]))
        if data is not None:
            (place,) = struct.unpack("<H", data)
            self.opened = min(max(100.0 * (place - self._low) / (self._high - self._low), 0.0), 100.0)

    def _send(self, goal: float) -> None:
        if self._sent is None:
            limit = struct.pack("<H", int(SOFT * FULL))
            self._ask(WRITE, bytes([self._number, _TORQUE_LIMIT]) + limit)
        place = self._low + min(max(goal, 0.0), 100.0) / 100.0 * (self._high - self._low)
        self._ask(WRITE, bytes([self._number, _GOAL]) + struct.pack("<H", round(place)))
        self._sent = goal


T = TypeVar("T")

MODELS = {777: "STS3215", 2825: "STS3250"}
"""Servos with these registers and 4096 counts per turn"""
ID, CONFIRMS, LIMITS, HOMING, MODE, TORQUE, GOAL, LOCK, VOLTAGE = 5, 8, 9, 31, 33, 40, 42, 55, 62
"""Register addresses (Feetech's memory table of the STS/SMS series)"""
ACCELERATION, SPEED, FASTEST = 41, 46, 85
"""Register addresses: acceleration and speed (0: largest), and largest acceleration"""
PROMPT = 254
"""[100 counts/s^2] as LeRobot sets it"""
LAST_ID = 12
"""of searched IDs (chosen)"""
QUIET = 0.03
"""[s] without a late answer (chosen)"""
RETRY = 0.05
"""[s] between questions to a silent servo (chosen)"""


class FeetechBus(Bus):
    """The servos of one arm, without the gripper."""

    name = "SO-101"
    advice = f"{Bus.advice} `rejoint emulate --arm so101` starts an arm to try"

    def __init__(self, address: FeetechAddress, arm: Arm) -> None:
        self.address, self._arm = address, arm
        self._file = None if address.calibration is None else read_calibration(address.calibration, arm)
        self.ids = self._file.ids if self._file is not None else tuple(range(1, arm.joints + 1))
        self._wire: Wire | None = None
        self.zeros = Zeros(middle=(), zero=(), low=(), high=())
        """of the prepared arm"""
        self.supply: tuple[float, ...] = ()
        """(n,) [V] at the start"""
        self._tuning = Tuning(
            self.ids,
            for_all(address.gains, len(self.ids)),
            read=self._read,
            write=self._write,
            call=self._call,
            wait=self.clock.wait,
        )
        self._goal: list[int] | None = None
        self._limp: set[int] = set()
        self._was_ready = False

    def open(self) -> None:
        """Open the port."""
        self._wire = Wire(self.address.wire)

    def prepare(self, until: float | None = None) -> None:
        """Check all servos, read their zeros, and hold."""
        missing = []
        for servo in self.ids:
            try:
                model = self._sure(partial(self.wire.model, servo), until)
            except NoReplyError:
                missing.append(servo)
                continue
            if model not in MODELS:
                raise RobotError(f"{self._call(servo)} is of model {model}, expected {_listed(MODELS)}")
        strangers = () if self._was_ready or not missing else self._strangers()
        self._require(missing, strangers, RobotError)  # the others do answer
        for servo in self.ids:
            if self._register(servo, MODE, 1, until) != 0:
                raise RobotError(f"{self._call(servo)} is not in position mode; set its register {MODE} to 0")
        self.zeros = zeros_of(
            self._arm,
            self._file,
            self._registers(HOMING, until, sign=11),
            self._registers(LIMITS, until),
            self._registers(LIMITS + 2, until),
            self.address.zero,
        )
        self._hold(until)
        self._hasten(until)
        self._tuning.prepare(until)
        if not self.supply:
            self.supply = tuple(VOLT * self._register(servo, VOLTAGE, 1, until) for servo in self.ids)
        self._was_ready = True

    def read(self) -> Reading:
        """Ask all servos."""
        answers = self.wire.read_all(self.ids, PRESENT, BLOCK)
        if len(answers) < len(self.ids):
            self._require([servo for servo in self.ids if servo not in answers])
        return decode([answers[servo] for servo in self.ids], self.zeros, self._tuning.laws, self.supply)

    def send(self, goal: Array) -> None:
        """Send goals, clipped to the servos' limits; no answers."""
        self._goal = self.zeros.counts(goal)
        self._send(self._goal)

    def stop(self) -> None:
        """Send the last goals again: at the measured position the arm would sink."""
        if self._goal is not None:
            self._send(self._goal)

    def servo_gains(self) -> ServoGains:
        """Return the servo gains by name."""
        return dict(self._tuning.values)

    def rungs(self) -> tuple[Rung, ...]:
        """Return the search order of gains."""
        return RUNGS

    def tune(self, gains: ServoGains) -> None:
        """Set gains in small steps until power-off."""
        self._tuning.tune(gains)

    def keep(self, gains: ServoGains) -> None:
        """Set gains permanently."""
        self._tuning.keep(gains)

    def relay(self, command: int, payload: bytes) -> bytes | None:
        """Read or write registers of another servo, such as the gripper's."""
        servo, address, *rest = payload
        if servo in self.ids or address in (ID, LOCK):
            raise RobotError(f"register {address} of servo {servo} is not passed on")
        if command == READ and len(rest) == 1:
            return self.wire.read(servo, address, rest[0])
        if command == WRITE:
            self.wire.write(servo, address, rest)
            return b""
        return None

    def resynchronise(self, deadline: float) -> None:
        """Drop late answers and wait for silent servos.

        ConnectionLostError, PowerLostError.
        """
        while self.wire.quieten(QUIET) and self.clock.now() < deadline:
            pass
        silent = list(self.ids)
        while silent := [servo for servo in silent if not self.wire.answers(servo)]:
            if self.clock.now() + RETRY > deadline:
                raise ConnectionLostError(f"{self.address}: {_listed(map(self._call, silent))} stays silent")
            self.clock.wait(RETRY)
        self._require_torque(deadline)

    def close(self) -> None:
        """Release the port; the servos hold."""
        wire, self._wire = self._wire, None
        if wire is not None:
            wire.close()

    @property
    def wire(self) -> Wire:
        """The open port; OSError."""
        if self._wire is None:
            raise OSError("the port is not open")
        return self._wire

    def _hold(self, until: float | None) -> None:
        if self._was_ready:
            self._require_torque(until)
        for servo in self.ids:
            if self._register(servo, LOCK, 1, until) == 0:
                self._write(servo, LOCK, [1], until)
            if self._register(servo, TORQUE, 1, until) == 1:
                continue
            self._write(servo, GOAL, self._read(servo, PRESENT, 2, until), until)
            self._write(servo, TORQUE, [1], until)

    def _require_torque(self, until: float | None) -> None:
        self._limp = {servo for servo in self.ids if self._register(servo, TORQUE, 1, until) != 1}
        if self._limp:
            raise PowerLostError(
                f"{self.address}: {_listed(map(self._call, sorted(self._limp)))} has lost its torque, by a loss of "
                "power or its own protection; support the arm, then start again"
            )

    def _hasten(self, until: float | None) -> None:
        for servo in self.ids:
            (most, times), (wanted,) = self._read(servo, FASTEST, 2, until), self._read(servo, ACCELERATION, 1, until)
            if most * times < PROMPT:
                self._write(servo, FASTEST, [PROMPT], until)
            if 0 < wanted < PROMPT:
                self._write(servo, ACCELERATION, [PROMPT], until)
            if self._register(servo, SPEED, 2, until) != 0:
                self._write(servo, SPEED, [0, 0], until)

    def _registers(self, address: int, until: float | None, *, sign: int = 16) -> Counts:
        words = [self._register(servo, address, 2, until) for servo in self.ids]
        return np.array([signed(word, sign) for word in words], dtype=np.int64)

    def _register(self, servo: int, address: int, size: int, until: float | None) -> int:
        return int.from_bytes(self._read(servo, address, size, until), "little")

    def _read(self, servo: int, address: int, size: int, until: float | None) -> bytes:
        return self._sure(lambda: self.wire.read(servo, address, size), until)

    def _write(self, servo: int, address: int, data: Sequence[int], until: float | None) -> None:
        try:
            self._sure(lambda: self.wire.write(servo, address, data), until)
        except NoReplyError as error:
            if self._register(servo, CONFIRMS, 1, until) != 0:
                raise
            raise RobotError(
                f"{self._call(servo)} obeys, but does not confirm it; set its register {CONFIRMS} to 1"
            ) from error

    def _sure(self, question: Callable[[], T], until: float | None) -> T:
        def once() -> T:
            try:
                return question()
            except TimeoutError as error:
                raise NoReplyError(f"{self.address}: {first_line(error)}") from error
            except (ValueError, IndexError) as error:
                raise ImpossibleReplyError(f"{self.address}: {first_line(error)}") from error

        return persist(once, lambda *_: self.wire.quieten(QUIET), self.clock, until)

    def _send(self, goal: Sequence[int]) -> None:
        goals = {servo: count for servo, count in zip(self.ids, goal, strict=True) if servo not in self._limp}
        if goals:
            self.wire.write_all(list(goals), GOAL, [count.to_bytes(2, "little") for count in goals.values()])

    def _require(
        self, missing: Sequence[int], strangers: Sequence[int] = (), kind: type[Exception] = TimeoutError
    ) -> None:
        others = f"; others that answer: {_listed(strangers)}" if strangers else ""
        if len(missing) == len(self.ids):
            wire = self.address.wire
            rate = f" at {wire.baud} baud" if isinstance(wire, SerialAddress) else ""
            raise NoReplyError(
                f"{self.address}: no servo answers{rate}; is the arm's supply on, and its bus cable in?{others}"
            )
        if missing:
            names = _listed(map(self._call, missing))
            raise kind(f"{names} is missing on the bus; check its cable, its ID and its baud rate{others}")

    def _strangers(self) -> list[int]:
        known = {*self.ids, max(self.ids) + 1}
        return [servo for servo in range(LAST_ID + 1) if servo not in known and self.wire.answers(servo)]

    def _call(self, servo: int) -> str:
        return f"{self._arm.joint_names[self.ids.index(servo)]} (servo {servo})"


def _listed(names: Iterable[object]) -> str:
    return ", ".join(map(str, names))
