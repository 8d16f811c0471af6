"""An SO-100 or SO-101 on its servo bus: one synchronous read and write per cycle.

Only `FeetechBus.keep` unlocks the servos' memory.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np

from rejoint.arms import Arm
from rejoint.control.servogains import Rung, ServoGains
from rejoint.robots.bus import Reading
from rejoint.robots.feetech.gains import FULL, GAINS, REGISTERS, RUNGS, DutyLaw, FeetechAddress, duty_laws, for_all
from rejoint.robots.feetech.wire import Wire
from rejoint.robots.servobus import (
    READ,
    WRITE,
    Counts,
    Register,
    ServoBus,
    Tuning,
    Values,
    Zeros,
    read_calibration,
    signed,
    zeros_of,
)
from rejoint.system.errors import NoReplyError, RobotError
from rejoint.system.stopping import shielded

TABLE = {
    "id": Register(5),
    "confirms": Register(8),
    "low": Register(9, 2),
    "high": Register(11, 2),
    "homing": Register(31, 2, 11),
    "mode": Register(33),
    "torque": Register(40),
    "acceleration": Register(41),
    "goal": Register(42, 2),
    "speed": Register(46, 2),
    "torque limit": Register(48, 2),
    "lock": Register(55),
    "position": Register(56, 2),
    "load": Register(60, 2, 10),
    "voltage": Register(62),
    "heat": Register(63),
    "fastest": Register(85),
    "times": Register(86),
} | {name: Register(address) for name, address in REGISTERS.items()}
"""Feetech's memory table of the STS/SMS series"""
BLOCK = 15
"""Measured registers from ``position`` on"""
PROMPT = 254
"""[100 counts/s^2] as LeRobot sets it"""


class FeetechBus(ServoBus):
    """The servos of an SO-100 or SO-101."""

    name = "SO-101"
    advice = f"{ServoBus.advice} `rejoint emulate --arm so101` starts an arm to try"
    registers = TABLE
    protected = ("id", "lock")
    models = {777: "STS3215", 2825: "STS3250"}  # noqa: RUF012 - never written; both have 4096 counts per turn

    def __init__(self, address: FeetechAddress, arm: Arm) -> None:
        self._file = None if address.calibration is None else read_calibration(address.calibration, arm)
        super().__init__(address.wire, arm, range(1, arm.joints + 1) if self._file is None else self._file.ids)
        self.address, self.names = address, [self.call(servo) for servo in self.ids]
        self._tuning = Tuning(self, GAINS, for_all(address.gains, len(self.ids)))
        self.supply: tuple[float, ...] = ()
        """(n,) [V] at the start"""

    def connect(self) -> Wire:
        """Open the port."""
        return Wire(self.address.wire)

    def find_zeros(self) -> Zeros:
        """Read homing offsets and limits."""
        homing, low, high = map(self._counts, ("homing", "low", "high"))
        return zeros_of(self._arm, self._file, homing, low, high, self.address.zero)

    def set_up(self) -> None:
        """Lock the memory, let the servos be prompt, and set the gains of the address."""
        for servo in self.ids:
            if self.get(servo, "lock") == 0:
                self.set(servo, "lock", 1)
            if self.get(servo, "fastest") * self.get(servo, "times") < PROMPT:
                self.set(servo, "fastest", PROMPT)
            if 0 < self.get(servo, "acceleration") < PROMPT:
                self.set(servo, "acceleration", PROMPT)
            if self.get(servo, "speed") != 0:  # 0 is the largest
                self.set(servo, "speed", 0)
        self._tuning.prepare()
        self.supply = self.supply or tuple(VOLT * self.get(servo, "voltage") for servo in self.ids)

    def set(self, servo: int, name: str, value: int) -> None:
        """Write a register, again where the answer is lost."""
        try:
            super().set(servo, name, value)
        except NoReplyError as error:
            if self.get(servo, "confirms") != 0:
                raise
            register = TABLE["confirms"].address
            raise RobotError(
                f"{self.call(servo)} obeys, but does not confirm it; set its register {register} to 1"
            ) from error

    def read(self) -> Reading:
        """Ask all servos."""
        rows = self.ask_all(TABLE["position"].address, BLOCK)
        return decode(rows, self.zeros, duty_laws(self._tuning.values), self.supply)

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
        """Save gains; each lock is open meanwhile."""
        self._tuning.tune(gains)
        for joint, servo in enumerate(self.ids):
            try:
                self.set(servo, "lock", 0)
                for name, values in gains.items():
                    self.set(servo, name, values[joint])
            finally:
                with shielded():
                    self.set(servo, "lock", 1)
            if self.get(servo, "lock") != 1:
                raise RobotError(f"the lock of {self.call(servo)} stays open; switch the arm's power off and on")
        self._tuning.look_up()
        if any(self._tuning.values[name] != tuple(values) for name, values in gains.items()):
            raise RobotError(f"the servos have not taken the gains; they are {self._tuning.values}")

    # --- the memory of gains ----------------------------------------------------------------

    def read_gains(self) -> Values:
        """Ask each servo for all its gains at once."""
        first = min(REGISTERS.values())
        blocks = [self.read_block(servo, first, len(REGISTERS)) for servo in self.ids]
        return {name: tuple(block[address - first] for block in blocks) for name, address in REGISTERS.items()}

    def write_gain(self, name: str, values: Sequence[int]) -> None:
        """Set one gain of all servos."""
        for servo, value in zip(self.ids, values, strict=True):
            self.set(servo, name, value)

    def strain(self, joint: int) -> tuple[float, float]:
        """Share of the largest torque, and temperature [deg C]."""
        return abs(self.get(self.ids[joint], "load")) / FULL, self.get(self.ids[joint], "heat")

    def wait(self, duration: float) -> None:
        """Wait [s]."""
        self.clock.wait(duration)

    def _counts(self, name: str) -> Counts:
        return np.array([self.get(servo, name) for servo in self.ids], dtype=np.int64)


FAULTS = {1: "voltage", 2: "encoder", 4: "heat", 8: "over-current", 32: "overload"}
"""Bits of the status register"""
SAGGING = 0.75
"""share of the first voltage (chosen: servos go silent at half of it)"""
VOLT = 0.1
"""[V] per count"""
# of the measured registers position, load, voltage, temperature, status and goal
_ROW = struct.Struct("<HxxHBBxBxHxx")


def decode(rows: Sequence[bytes], zeros: Zeros, laws: Sequence[DutyLaw], supply: Sequence[float]) -> Reading:
    """Read the ``rows`` of n servos; ``supply`` [V] at the start."""
    table, words = [], []
    for row, law, before in zip(rows, laws, supply, strict=True):
        position, duty, volt, heat, status, goal = _ROW.unpack(row)
        place, voltage = signed(position, 15), volt * VOLT
        table.append((place, law.share(signed(duty, 10), signed(goal, 15) - place), voltage, heat))
        trouble = [name for bit, name in FAULTS.items() if status & bit]
        if voltage < SAGGING * before:
            trouble.append(f"the supply sags to {voltage:.1f} V from {before:.1f} V")
        words.append(", ".join(trouble))
    places, loads, voltages, heats = zip(*table, strict=True)
    return Reading(
        position=np.array(zeros.radians(places)),
        load=np.array(loads),
        voltage=np.array(voltages),
        temperature=np.array(heats),
        fault=np.array([bool(word) for word in words]),
        trouble=tuple(words) if any(words) else None,
    )


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
            data = ask(READ, bytes([number, TABLE["low"].address, 4]))
        except RobotError:
            return None
        low, high = (0, 0) if data is None else struct.unpack("<HH", data)
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
        data = self._ask(READ, bytes([self._number, TABLE["position"].address, 2]))
        if data is not None:
            share = (int.from_bytes(data, "little") - self._low) / (self._high - self._low)
            self.opened = min(max(100.0 * share, 0.0), 100.0)

    def _send(self, goal: float) -> None:
        if self._sent is None:
            self._write("torque limit", int(SOFT * FULL))
        self._write("goal", round(self._low + min(max(goal, 0.0), 100.0) / 100.0 * (self._high - self._low)))
        self._sent = goal

    def _write(self, name: str, value: int) -> None:
        register = TABLE[name]
        self._ask(WRITE, bytes([self._number, register.address]) + register.encode(value))
