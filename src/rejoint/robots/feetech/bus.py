"""An SO-100 or SO-101 on its servo bus: one synchronous read and write per cycle.

A joint is at zero in mid-range, as in LeRobot's degrees, or at the address's ``zero``. Torque is never switched off.
Only `FeetechBus.keep` unlocks the servos' memory.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.control.servogains import Rung, ServoGains
from rejoint.logs.joints import COUNTS_PER_TURN, match_joints, read_homing
from rejoint.robots.bus import Bus, Reading, connected, persist
from rejoint.robots.feetech.gains import (
    FULL,
    REGISTERS,
    RUNGS,
    DutyLaw,
    FeetechAddress,
    Tuning,
    Values,
    duty_laws,
    for_all,
)
from rejoint.robots.feetech.wire import Wire
from rejoint.system.errors import (
    ConnectionLostError,
    InputError,
    NoReplyError,
    PowerLostError,
    RobotError,
)
from rejoint.system.stopping import shielded

T = TypeVar("T")

LAST_ID = 12
"""of searched IDs (chosen)"""
QUIET = 0.03
"""[s] without a late answer (chosen)"""
RETRY = 0.05
"""[s] between questions to a silent servo (chosen)"""
READ, WRITE = 2, 3
"""Instructions of `FeetechBus.relay`: servo ID, address, and size or data"""


class Register(NamedTuple):
    """A value in the memory of a servo, lowest byte first."""

    address: int
    size: int = 1
    sign: int | None = None
    """sign bit, or None"""

    def decode(self, data: bytes) -> int:
        """Read the value."""
        word = int.from_bytes(data, "little")
        return word if self.sign is None else signed(word, self.sign)

    def encode(self, value: int) -> bytes:
        """Write a value without a sign."""
        return value.to_bytes(self.size, "little")


def signed(word: int, bit: int) -> int:
    """Return number with a sign ``bit``."""
    return -(word & ~(1 << bit)) if word & 1 << bit else word


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
PROTECTED = frozenset(TABLE[name].address for name in ("id", "lock"))
"""Registers that no client may write"""
MODELS = {777: "STS3215", 2825: "STS3250"}
"""Servos with these registers, by number; both have 4096 counts per turn"""
POSITION_MODE = 0
BLOCK = 15
"""Measured registers from ``position`` on"""
PROMPT = 254
"""[100 counts/s^2] as LeRobot sets it"""


class FeetechBus(Bus):
    """The servos of an SO-100 or SO-101, by ID, without the gripper."""

    name = "SO-101"
    advice = f"{Bus.advice} `rejoint emulate --arm so101` starts an arm to try"

    def __init__(self, address: FeetechAddress, arm: Arm) -> None:
        self._file = None if address.calibration is None else read_calibration(address.calibration, arm)
        self.ids = tuple(range(1, arm.joints + 1)) if self._file is None else self._file.ids
        self.address, self.place, self._arm = address, address.wire, arm
        self.names = [self.call(servo) for servo in self.ids]
        self._tuning = Tuning(self, for_all(address.gains, len(self.ids)))
        self.supply: tuple[float, ...] = ()
        """(n,) [V] at the start"""
        self.zeros = Zeros(middle=(), zero=(), low=(), high=())
        """of the prepared arm"""
        self._wire: Wire | None = None
        self._until: float | None = None  # [s] deadline of `prepare`
        self._goal: list[int] | None = None
        self._limp: set[int] = set()
        self._was_ready = False

    def open(self) -> None:
        """Open the port."""
        self._wire = Wire(self.place)

    def prepare(self, until: float | None = None) -> None:
        """Check all servos, read their zeros, and hold."""
        with self._by(until):
            self._find_servos()
            homing, low, high = map(self._counts, ("homing", "low", "high"))
            self.zeros = zeros_of(self._arm, self._file, homing, low, high, self.address.zero)
            if self._was_ready:
                self._require_torque()
            for servo in self.ids:
                if self.get(servo, "torque") != 1:
                    self.set(servo, "goal", self.get(servo, "position"))
                    self.set(servo, "torque", 1)
            self._set_up()
            self._was_ready = True

    def _set_up(self) -> None:
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

    def read(self) -> Reading:
        """Ask all servos."""
        rows = self.ask_all(TABLE["position"].address, BLOCK)
        return decode(rows, self.zeros, duty_laws(self._tuning.values), self.supply)

    def send(self, goal: Array) -> None:
        """Send goals, clipped to the servos' limits; no answers."""
        self._goal = self.zeros.counts(goal)
        self._send(self._goal)

    def stop(self) -> None:
        """Send the last goals again: at the measured position the arm would sink."""
        if self._goal is not None:
            self._send(self._goal)

    def relay(self, command: int, payload: bytes) -> bytes | None:
        """Read or write registers of another servo, such as the gripper's."""
        servo, address, *rest = payload
        if servo in self.ids or address in PROTECTED:
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
        while silent := [servo for servo in silent if not self._answers(servo)]:
            if self.clock.now() + RETRY > deadline:
                raise ConnectionLostError(f"{self.place}: {_listed(map(self.call, silent))} stays silent")
            self.clock.wait(RETRY)
        with self._by(deadline):
            self._require_torque()

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

    # --- registers --------------------------------------------------------------------------

    def get(self, servo: int, name: str) -> int:
        """Read a register, again where the answer is lost."""
        register = TABLE[name]
        return register.decode(self.read_block(servo, register.address, register.size))

    def set(self, servo: int, name: str, value: int) -> None:
        """Write a register, again where the answer is lost."""
        register = TABLE[name]
        try:
            self._sure(partial(self.wire.write, servo, register.address, register.encode(value)))
        except NoReplyError as error:
            if self.get(servo, "confirms") != 0:
                raise
            raise RobotError(
                f"{self.call(servo)} obeys, but does not confirm it; set its register {TABLE['confirms'].address} to 1"
            ) from error

    def read_block(self, servo: int, address: int, size: int) -> bytes:
        """Read neighbouring registers, again where the answer is lost."""
        return self._sure(partial(self.wire.read, servo, address, size))

    def ask_all(self, address: int, size: int) -> list[bytes]:
        """Read registers of all servos at once; TimeoutError names those that are missing."""
        answers = self.wire.read_all(self.ids, address, size)
        if len(answers) < len(self.ids):
            self._require([servo for servo in self.ids if servo not in answers])
        return [answers[servo] for servo in self.ids]

    def call(self, servo: int) -> str:
        """Name of a servo in messages."""
        return f"{self._arm.joint_names[self.ids.index(servo)]} (servo {servo})"

    @contextmanager
    def _by(self, until: float | None) -> Iterator[None]:
        self._until = until
        try:
            yield
        finally:
            self._until = None

    def _sure(self, question: Callable[[], T]) -> T:
        def recover(error: RobotError, _: float) -> None:
            connected(error)
            self.wire.quieten(QUIET)

        return persist(question, recover, self.clock, self.place, self._until)

    def _send(self, goal: Sequence[int]) -> None:
        register = TABLE["goal"]
        goals = {servo: count for servo, count in zip(self.ids, goal, strict=True) if servo not in self._limp}
        if goals:
            self.wire.write_all(list(goals), register.address, [register.encode(count) for count in goals.values()])

    def _find_servos(self) -> None:
        missing = []
        for servo in self.ids:
            try:
                model = self._sure(partial(self.wire.model, servo))
            except NoReplyError:
                missing.append(servo)
                continue
            if model not in MODELS:
                raise RobotError(f"{self.call(servo)} is of model {model}, expected {_listed(MODELS)}")
        known = {*self.ids, max(self.ids) + 1}
        search = () if self._was_ready or not missing else set(range(LAST_ID + 1)) - known
        self._require(missing, [servo for servo in search if self._answers(servo)], RobotError)  # the others do answer
        for servo in self.ids:
            if self.get(servo, "mode") != POSITION_MODE:
                raise RobotError(
                    f"{self.call(servo)} is not in position mode; set its register {TABLE['mode'].address} to "
                    f"{POSITION_MODE}"
                )

    def _answers(self, servo: int) -> bool:
        try:
            self.wire.model(servo)
        except (TimeoutError, ValueError, IndexError):
            return False
        return True

    def _require_torque(self) -> None:
        self._limp = {servo for servo in self.ids if self.get(servo, "torque") != 1}
        if self._limp:
            raise PowerLostError(
                f"{self.place}: {_listed(map(self.call, sorted(self._limp)))} has lost its torque, by a loss of "
                "power or its own protection; support the arm, then start again"
            )

    def _require(
        self, missing: Sequence[int], strangers: Sequence[int] = (), kind: type[Exception] = TimeoutError
    ) -> None:
        others = f"; others that answer: {_listed(strangers)}" if strangers else ""
        if len(missing) == len(self.ids):
            baud = getattr(self.place, "baud", None)
            rate = f" at {baud} baud" if baud else ""
            raise NoReplyError(
                f"{self.place}: no servo answers{rate}; is the arm's supply on, and its bus cable in?{others}"
            )
        if missing:
            names = _listed(map(self.call, missing))
            raise kind(f"{names} is missing on the bus; check its cable, its ID and its baud rate{others}")

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


def _listed(names: Iterable[object]) -> str:
    return ", ".join(map(str, names))


Counts = NDArray[np.int64]

_STEP = 2 * np.pi / COUNTS_PER_TURN
TURNING = np.radians(300.0)
"""[rad] range of a joint that may turn fully (chosen: LeRobot does so with a wrist)"""


class MotorRanges(NamedTuple):
    """LeRobot's calibration of the motors (n,)."""

    ids: tuple[int, ...]
    homing: Counts
    low: Counts
    high: Counts


class Zeros(NamedTuple):
    """Counts and radians of n joints, as plain numbers for speed."""

    middle: tuple[float, ...]
    """(n,) [counts] at ``zero``"""
    zero: tuple[float, ...]
    """(n,) [rad]"""
    low: tuple[int, ...]
    """(n,) [counts] goals"""
    high: tuple[int, ...]
    """(n,) [counts]"""

    def radians(self, counts: Sequence[int]) -> list[float]:
        """Joint positions (n,) [rad]."""
        return [
            (count - middle) * _STEP + zero for count, middle, zero in zip(counts, self.middle, self.zero, strict=True)
        ]

    def counts(self, position: Array) -> list[int]:
        """Goals (n,) of positions [rad], within the servos' limits."""
        rows = zip(position.tolist(), *self, strict=True)
        return [min(max(round((angle - zero) / _STEP + middle), low), high) for angle, middle, zero, low, high in rows]


def read_calibration(path: Path, arm: Arm) -> MotorRanges:
    """Read LeRobot's calibration of ``arm``; FileError, InputError for its numbers."""
    motors = read_homing(path)
    columns = match_joints(list(motors), arm, path, "calibration").columns
    joints = [list(motors.values())[column] for column in columns]
    try:
        ids, homing, low, high = (
            np.array([int(joint[name]) for joint in joints])
            for name in ("id", "homing_offset", "range_min", "range_max")
        )
    except (KeyError, TypeError, ValueError) as error:
        wanted = "id, homing_offset, range_min and range_max of every motor"
        raise InputError(f"{path}: expected {wanted} ({error!r})") from error
    if not ((low >= 0) & (low < high) & (high < COUNTS_PER_TURN)).all():
        raise InputError(f"{path}: ranges must rise within 0 and {COUNTS_PER_TURN - 1}; run lerobot-calibrate again")
    return MotorRanges(ids=tuple(ids.tolist()), homing=homing, low=low, high=high)


def zeros_of(
    arm: Arm, file: MotorRanges | None, homing: Counts, low: Counts, high: Counts, degrees: tuple[float, ...]
) -> Zeros:
    """Zeros from servo offsets and limits (n,); RobotError."""
    if degrees and len(degrees) != arm.joints:
        raise InputError(f"zero= of the address needs {arm.joints} angles, one per joint, got {len(degrees)}")
    if file is not None and (file.homing != homing).any():
        j = int(np.argmax(file.homing != homing))
        raise RobotError(
            f"the calibration file is not that of this arm: {arm.joint_names[j]} has a homing offset of {homing[j]} "
            f"counts in its servo and {file.homing[j]} in the file; give the arm's own file, or run lerobot-calibrate"
        )
    limited = low < high
    low, high = np.where(limited, low, 0), np.where(limited, high, COUNTS_PER_TURN - 1)
    least, most = (low, high) if file is None else (file.low, file.high)
    whole = (most - least >= COUNTS_PER_TURN - 1) & (arm.upper - arm.lower < TURNING)
    if whole.any() and not degrees:
        raise RobotError(
            f"{_listed(np.array(arm.joint_names)[whole])} may turn by a whole turn, as servos do that were never "
            "calibrated: zero is unknown; run lerobot-calibrate, or say by zero=DEG,DEG,... what angle each joint has "
            "in the middle of its range"
        )
    turned = np.radians(degrees) if degrees else np.zeros(arm.joints)
    return Zeros(*(tuple(values.tolist()) for values in ((least + most) / 2, turned, low, high)))


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
        self._ask, self._number, self._counts = ask, number, (low, high)
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
            if self.goal is None or self.goal == self._sent:
                self._read()
            else:
                self._send(self.goal)
            self._silent = 0
        except RobotError:
            self._silent += 1

    def _read(self) -> None:
        data = self._ask(READ, bytes([self._number, TABLE["position"].address, 2]))
        if data is not None:
            self.opened = float(np.interp(int.from_bytes(data, "little"), self._counts, (0.0, 100.0)))

    def _send(self, goal: float) -> None:
        if self._sent is None:
            self._write("torque limit", int(SOFT * FULL))
        self._write("goal", round(np.interp(goal, (0.0, 100.0), self._counts)))
        self._sent = goal

    def _write(self, name: str, value: int) -> None:
        register = TABLE[name]
        self._ask(WRITE, bytes([self._number, register.address]) + register.encode(value))
