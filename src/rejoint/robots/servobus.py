"""Arms of servos with registers on one bus.

A family brings a table of registers, the maker's client as a `ServoWire`, and what is its own: `ServoBus.set_up` and
`ServoBus.read`. A joint is at zero in mid-range, as in LeRobot's degrees, or at the address's ``zero``. Torque is never
switched off.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.control.servogains import HEAVIEST, HOTTEST, ServoGains
from rejoint.logs.joints import COUNTS_PER_TURN, match_joints, read_homing
from rejoint.robots.bus import Bus, persist
from rejoint.system.errors import (
    ConnectionLostError,
    ImpossibleReplyError,
    InputError,
    NoReplyError,
    PowerLostError,
    RobotError,
    first_line,
)
from rejoint.system.stopping import ending

T = TypeVar("T")

LAST_ID = 12
"""of searched IDs (chosen)"""
QUIET = 0.03
"""[s] without a late answer (chosen)"""
RETRY = 0.05
"""[s] between questions to a silent servo (chosen)"""
READ, WRITE = 2, 3
"""Instructions of `ServoBus.relay`: servo ID, address, and size or data"""


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


class ServoWire(Protocol):
    """The maker's client on an open port; TimeoutError, ValueError, IndexError (garbled), OSError (broken)."""

    def model(self, servo: int) -> int:
        """Model number of a servo; ignores late answers."""

    def read(self, servo: int, address: int, size: int) -> bytes:
        """Read ``size`` bytes of registers."""

    def write(self, servo: int, address: int, data: Sequence[int]) -> None:
        """Write registers; the servo confirms."""

    def read_all(self, servos: Sequence[int], address: int, size: int) -> dict[int, bytes]:
        """Read registers of all ``servos``; without silent ones."""

    def write_all(self, servos: Sequence[int], address: int, data: Sequence[bytes]) -> None:
        """Write registers of all ``servos``, without answers."""

    def quieten(self, pause: float) -> bool:
        """Drop what comes within ``pause`` [s]; whether anything did."""

    def close(self) -> None:
        """Release the port; the servos hold."""


class ServoBus(Bus):
    """The servos of one arm, by ID, without the gripper."""

    registers: Mapping[str, Register]
    """by name; ``id``, ``mode``, ``torque``, ``goal`` and ``position`` are used here"""
    protected: tuple[str, ...] = ("id",)
    """registers that no client may write"""
    models: Mapping[int, str]
    """servos with these registers, by number"""
    position_mode = 0

    def __init__(self, address: object, arm: Arm, ids: Sequence[int]) -> None:
        self.place, self.ids, self._arm = address, tuple(ids), arm
        self.zeros = Zeros(middle=(), zero=(), low=(), high=())
        """of the prepared arm"""
        self._wire: ServoWire | None = None
        self._until: float | None = None  # [s] deadline of `prepare`
        self._goal: list[int] | None = None
        self._limp: set[int] = set()
        self._was_ready = False

    # --- what a family brings ---------------------------------------------------------------

    @abstractmethod
    def connect(self) -> ServoWire:
        """Open the port."""

    @abstractmethod
    def find_zeros(self) -> Zeros:
        """Read what counts mean; RobotError. Nothing is written yet."""

    @abstractmethod
    def set_up(self) -> None:
        """Set what the servos, which hold, need to be driven."""

    # --- the bus ----------------------------------------------------------------------------

    def open(self) -> None:
        """Open the port."""
        self._wire = self.connect()

    def prepare(self, until: float | None = None) -> None:
        """Check all servos, read their zeros, and hold."""
        with self._by(until):
            self._find_servos()
            self.zeros = self.find_zeros()
            if self._was_ready:
                self._require_torque()
            for servo in self.ids:
                if self.get(servo, "torque") != 1:
                    self.set(servo, "goal", self.get(servo, "position"))
                    self.set(servo, "torque", 1)
            self.set_up()
            self._was_ready = True

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
        if servo in self.ids or address in {self.registers[name].address for name in self.protected}:
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
    def wire(self) -> ServoWire:
        """The open port; OSError."""
        if self._wire is None:
            raise OSError("the port is not open")
        return self._wire

    # --- registers --------------------------------------------------------------------------

    def get(self, servo: int, name: str) -> int:
        """Read a register, again where the answer is lost."""
        register = self.registers[name]
        return register.decode(self.read_block(servo, register.address, register.size))

    def set(self, servo: int, name: str, value: int) -> None:
        """Write a register, again where the answer is lost."""
        register = self.registers[name]
        self._sure(partial(self.wire.write, servo, register.address, register.encode(value)))

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
        def once() -> T:
            try:
                return question()
            except TimeoutError as error:
                raise NoReplyError(f"{self.place}: {first_line(error)}") from error
            except (ValueError, IndexError) as error:
                raise ImpossibleReplyError(f"{self.place}: {first_line(error)}") from error

        return persist(once, lambda *_: self.wire.quieten(QUIET), self.clock, self._until)

    def _send(self, goal: Sequence[int]) -> None:
        register = self.registers["goal"]
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
            if model not in self.models:
                raise RobotError(f"{self.call(servo)} is of model {model}, expected {_listed(self.models)}")
        known = {*self.ids, max(self.ids) + 1}
        search = () if self._was_ready or not missing else set(range(LAST_ID + 1)) - known
        self._require(missing, [servo for servo in search if self._answers(servo)], RobotError)  # the others do answer
        for servo in self.ids:
            if self.get(servo, "mode") != self.position_mode:
                register = self.registers["mode"].address
                raise RobotError(
                    f"{self.call(servo)} is not in position mode; set its register {register} to {self.position_mode}"
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


Values = dict[str, tuple[int, ...]]
"""One per joint, by name"""
PAUSE = 0.05
"""[s] between steps (chosen: longer than a servo rings)"""


class GainTable(NamedTuple):
    """How the gains of a family of servos change."""

    strides: Mapping[str, int]
    """largest change at once: limits the arm's jump"""
    falling: frozenset[str] = frozenset()
    """gains with which a servo pushes harder, the smaller they are"""
    limit: str = ""
    """limit of the I part, raised first and lowered last; empty: there is none"""

    def steps(self, before: ServoGains, wanted: ServoGains) -> Iterator[dict[str, list[int]]]:
        """Yield values to write in small steps, by name, one per joint."""
        ways = [(name, before[name], wanted[name]) for name in before if name in wanted and name != self.limit]
        if self.limit in wanted:
            most = tuple(map(max, before[self.limit], wanted[self.limit]))
            ways = [(self.limit, before[self.limit], most), *ways, (self.limit, most, wanted[self.limit])]
        for name, here, there in ways:
            now, stride = list(here), self.strides[name]
            while now != list(there):
                now = [min(max(end, value - stride), value + stride) for value, end in zip(now, there, strict=True)]
                yield {name: now}


class GainMemory(Protocol):
    """Where the gains of n servos are."""

    @property
    def names(self) -> Sequence[str]:
        """(n,) names of the servos, in messages."""

    def read_gains(self) -> Values:
        """Gains in force."""

    def write_gain(self, name: str, values: Sequence[int]) -> None:
        """Set one gain of all servos."""

    def strain(self, joint: int) -> tuple[float, float]:
        """Share of the largest torque, and temperature [deg C]."""

    def wait(self, duration: float) -> None:
        """Wait [s]."""


class Tuning:
    """Gains of servos; ``wanted`` ones hold on every connection."""

    def __init__(self, memory: GainMemory, table: GainTable, wanted: ServoGains) -> None:
        self.values: Values = {}
        """in force"""
        self._memory, self._table, self._wanted = memory, table, wanted

    def prepare(self) -> None:
        """Read the gains, and set the wanted ones."""
        self.look_up()
        self._walk(self._wanted, hottest=HOTTEST)

    def tune(self, gains: ServoGains) -> None:
        """Set gains, also on later connections; RobotError where a servo does not bear them."""
        self._walk(gains)
        self._wanted = {name: tuple(values) for name, values in gains.items()}

    def look_up(self) -> None:
        """Read the gains."""
        self.values = self._memory.read_gains()

    def _walk(self, wanted: ServoGains, *, hottest: float = np.inf) -> None:
        before, joints = self.values, len(self._memory.names)
        strange = [name for name in wanted if name not in before or len(wanted[name]) != joints]
        if strange:
            known = f"{', '.join(before)} of {joints} joints"
            raise RobotError(f"expected gains {known}, got {', '.join(strange)}")
        there = self._memory.read_gains()
        for step in self._table.steps(there, wanted):  # a walk that a lost connection cut short goes on
            self._take(step)
            problem = "" if ending() else self._problem(step, there, hottest)
            if problem:
                for back in self._table.steps(self._memory.read_gains(), before):
                    self._take(back)
                raise RobotError(f"{problem}; the gains are as before")
        self.look_up()

    def _take(self, step: Mapping[str, Sequence[int]]) -> None:
        for name, values in step.items():
            self._memory.write_gain(name, values)
        self._memory.wait(PAUSE)

    def _problem(self, step: Mapping[str, Sequence[int]], there: Values, hottest: float) -> str:
        ((name, values),) = step.items()
        for joint, (old, value) in enumerate(zip(there[name], values, strict=True)):
            if not (value < old if name in self._table.falling else value > old):
                continue  # else one that labours could not be relieved
            load, heat = self._memory.strain(joint)
            if load > HEAVIEST or heat > hottest:
                servo = self._memory.names[joint]
                return f"{servo} does not bear {name}={value}: load {100 * load:.0f} %, {heat:.0f} deg C"
        return ""
