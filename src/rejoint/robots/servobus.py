"""One arm on the bus of its servos, by a client of their maker.

Torque is never switched off. A joint may have several servos; the first of them says where it is.
"""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import compress, count, islice
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.logs.joints import COUNTS_PER_TURN, read_homing
from rejoint.robots.bus import Bus, persist
from rejoint.robots.knobs import Model, ServoAddress, TunedServos, Values
from rejoint.robots.servowire import ServoWire
from rejoint.system.errors import ConnectionLostError, InputError, NoReplyError, PowerLostError, RobotError

T = TypeVar("T")

QUIET = 0.03
"""[s] without a late answer (chosen)"""
RETRY = 0.05
"""[s] between questions to a silent servo (chosen)"""


class ServoBus(TunedServos, Bus):
    """The servos of an arm by ID, without the gripper."""

    confirms: ClassVar[int] = 1
    """least value of the register, from which a servo confirms what it is told"""
    last: ClassVar[int] = 12
    """ID in a search (chosen)"""
    turned: ClassVar[bool] = False
    """whether motors of a calibration may be reversed"""
    wire_type: ClassVar[Any]
    """`ServoWire` of an address"""
    supply: tuple[float, ...] = ()
    """(m,) [V] at the start"""

    def __init__(self, address: ServoAddress, arm: Arm) -> None:
        """Read the calibration, and find the servos' IDs; InputError."""
        self.address, self.place, self.arm, kind, path = address, address.wire, arm, address.kind, address.calibration
        self.file = None if path is None else read_calibration(path, arm, turned=self.turned)
        ids = address.ids or (counted(arm) if self.file is None else self.file.ids)
        if len(ids) != arm.joints:
            raise InputError(f"ids= of the address: expected the servos of {arm.joints} joints, got {len(ids)}")
        self.ids = tuple(servo for one in ids for servo in one)
        self.joint = np.repeat(np.arange(arm.joints), [len(one) for one in ids])
        """(m,) of each servo"""
        self.leads = np.searchsorted(self.joint, np.arange(arm.joints)).tolist()
        """(n,) places of the joints' first servos"""
        self.firsts = [self.ids[lead] for lead in self.leads]
        """(n,) their IDs"""
        self.table, self.memory = kind.registers, kind.memory
        """all registers, and those of gains"""
        self.found: dict[int, Model] = {}
        """models of the servos"""
        wanted = kind.for_all({**address.driven, **address.gains}, arm.joints)
        super().__init__(kind, list(map(self.call, self.firsts)), wanted)
        self.zeros: Zeros
        """of the prepared arm's servos"""
        self._wire: ServoWire | None = None
        self._until: float | None = None  # [s] deadline of `prepare`
        self._goal: list[int] = []
        self._limp: list[int] = []
        self._was_ready = False

    def open(self) -> None:
        """Open the port."""
        self._wire = self.wire_type(self.place)

    @abstractmethod
    def check(self, servo: int) -> None:
        """Raise RobotError for a servo that is not to be driven as it is."""

    @abstractmethod
    def find_zeros(self) -> Zeros:
        """Read where the joints are at zero; RobotError."""

    @abstractmethod
    def set_up(self) -> None:
        """Let the servos be prompt."""

    def strain(self, joint: int) -> tuple[float, float]:
        """Share of the largest torque, and temperature [deg C]."""
        servo = self.firsts[joint]
        return abs(self.found[servo].share(self.get(servo, "load"))), self.get(servo, "heat")

    def relieve(self, joint: int) -> None:
        """Let a joint's servos hold where they stand."""
        for servo in compress(self.ids, self.joint == joint):
            self.set(servo, "goal", self.get(servo, "position"))

    def prepare(self, until: float | None = None) -> None:
        """Check all servos, read their zeros, and hold."""
        with self.by(until):
            self._find_servos()
            self.zeros = self.find_zeros()
            if self._was_ready:
                self._require_torque()
            limp = self._find_limp()
            for servo in limp:
                self.set(servo, "goal", self.get(servo, "position"))
            for servo in limp:
                self.set(servo, "torque", 1)
            self.set_up()
            self.prepare_gains()
            self._was_ready = True

    def send(self, goal: Array) -> None:
        """Send goals, clipped to the servos' limits; no answers."""
        self._goal = self.zeros.counts(goal[self.joint])
        self._send()

    def stop(self) -> None:
        """Send the last goals again: at the measured position the arm would sink."""
        if self._goal:
            self._send()

    def _send(self) -> None:
        register, sent = self.table["goal"], zip(self.ids, self._goal, strict=True)
        goals = {servo: register.encode(count) for servo, count in sent if servo not in self._limp}
        if goals:
            self.wire.write_all(list(goals), register.address, list(goals.values()))

    def resynchronise(self, deadline: float) -> None:
        """Drop late answers and wait for silent servos.

        ConnectionLostError, PowerLostError.
        """
        while self.wire.quieten(QUIET) and self.clock.now() < deadline:
            pass
        silent = list(self.ids)
        while silent := [servo for servo in silent if not self.answers(servo)]:
            if self.clock.now() + RETRY > deadline:
                raise ConnectionLostError(f"{self.place}: {listed(map(self.call, silent))} stays silent")
            self.clock.wait(RETRY)
        with self.by(deadline):
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
        register = self.table[name]
        return register.decode(self.sure(partial(self.wire.read, servo, register.address, register.size)))

    def get_all(self, name: str) -> Counts:
        """Read a register of every servo, (m,)."""
        return np.array([self.get(servo, name) for servo in self.ids], dtype=np.int64)

    def set(self, servo: int, name: str, value: int) -> None:
        """Write a register, again where the answer is lost."""
        register = self.table[name]
        try:
            self.sure(partial(self.wire.write, servo, register.address, register.encode(value)))
        except NoReplyError as error:
            if self.get(servo, "confirms") >= self.confirms:
                raise
            raise RobotError(
                f"{self.call(servo)} obeys, but does not confirm it; set its register "
                f"{self.table['confirms'].address} to {self.confirms}"
            ) from error

    def span(self, names: Sequence[str]) -> tuple[int, int]:
        """First address and size of neighbouring registers."""
        first = min(self.table[name].address for name in names)
        return first, max(self.table[name].address + self.table[name].size for name in names) - first

    def ask_all(self, *names: str) -> Counts:
        """Read neighbouring registers of all servos at once, a row (m,) each; TimeoutError names those missing."""
        answers = self.wire.read_all(self.ids, *self.span(names))
        self._require([servo for servo in self.ids if servo not in answers])
        return self._decoded(names, [answers[servo] for servo in self.ids])

    def _decoded(self, names: Sequence[str], blocks: Sequence[bytes]) -> Counts:
        """Values (k, b) of k registers in blocks that hold all of them."""
        first, _ = self.span(names)
        registers = [self.table[name] for name in names]
        return np.array(
            [[one.decode(block[one.address - first :][: one.size]) for block in blocks] for one in registers]
        )

    def call(self, servo: int) -> str:
        """Name of a servo in messages."""
        name = self.arm.joint_names[self.joint[self.ids.index(servo)]] if servo in self.ids else "the gripper"
        return f"{name} (servo {servo})"

    @contextmanager
    def by(self, until: float | None) -> Iterator[None]:
        """Give up questions at ``until`` [s]."""
        self._until = until
        try:
            yield
        finally:
            self._until = None

    def sure(self, question: Callable[[], T]) -> T:
        """Ask again where an answer is lost."""
        return persist(question, lambda *_: self.wire.quieten(QUIET), self.clock, self.place, self._until)

    def answers(self, servo: int) -> bool:
        """Whether a servo answers now."""
        try:
            self.wire.model(servo)
        except (TimeoutError, ValueError, IndexError):
            return False
        return True

    def _find_servos(self) -> None:
        missing = []
        for servo in self.ids:
            try:
                model = self.sure(partial(self.wire.model, servo))
            except NoReplyError:
                missing.append(servo)
                continue
            if model not in self.kind.models:
                raise RobotError(f"{self.call(servo)} is of model {model}, expected {listed(self.kind.models)}")
            self.found[servo] = self.kind.models[model]
        known = {*self.ids, max(self.ids) + 1}
        search = () if self._was_ready or not missing else set(range(self.last + 1)) - known
        self._require(missing, [servo for servo in search if self.answers(servo)], RobotError)  # the others do answer
        for servo in self.ids:
            self.check(servo)

    def _find_limp(self) -> list[int]:
        return [servo for servo in self.ids if self.get(servo, "torque") != 1]

    def _require_torque(self) -> None:
        self._limp = self._find_limp()
        if self._limp:
            raise PowerLostError(
                f"{self.place}: {listed(map(self.call, self._limp))} has lost its torque, by a loss of "
                "power or its own protection; support the arm, then start again"
            )

    def _require(
        self, missing: Sequence[int], strangers: Sequence[int] = (), kind: type[Exception] = TimeoutError
    ) -> None:
        others = f"; others that answer: {listed(strangers)}" if strangers else ""
        if len(missing) == len(self.ids):
            rate = f" at {self.place.baud} baud" if self.place.baud else ""
            raise NoReplyError(
                f"{self.place}: no servo answers{rate}; is the arm's supply on, and its bus cable in?{others}"
            )
        if missing:
            raise kind(
                f"{listed(map(self.call, missing))} is missing on the bus; check its cable, its ID and its baud rate"
                f"{others}"
            )

    # --- the memory of gains ----------------------------------------------------------------

    def read_gains(self) -> Values:
        """Ask each joint's first servo for all its gains at once."""
        span = self.span(self.memory)
        blocks = [self.sure(partial(self.wire.read, first, *span)) for first in self.firsts]
        values = self._decoded(self.memory, blocks).tolist()
        return {name: tuple(row) for name, row in zip(self.memory, values, strict=True)}

    def write_gain(self, name: str, values: Sequence[int]) -> None:
        """Set one gain of all joints."""
        for servo, joint in zip(self.ids, self.joint.tolist(), strict=True):
            self.set(servo, name, values[joint])

    def wait(self, duration: float) -> None:
        """Wait [s]."""
        self.clock.wait(duration)


FIRST = {"omx": 11}
"""ID of an arm's first servo; others count from 1"""


def counted(arm: Arm) -> list[tuple[int, ...]]:
    """IDs of each joint's servos, without gaps; a description calls two of them ``2 XM430-W350``."""
    servos = count(FIRST.get(arm.name, 1))
    return [tuple(islice(servos, 2 if kind.startswith("2 ") else 1)) for kind in arm.servos or ("",) * arm.joints]


def listed(names: Iterable[object]) -> str:
    """Names with commas."""
    return ", ".join(map(str, names))


Counts = NDArray[np.int64]

STEP = 2 * np.pi / COUNTS_PER_TURN
"""[rad] per count"""


class Zeros(NamedTuple):
    """Counts and radians of m servos."""

    middle: Array
    """(m,) [counts] at ``zero``"""
    zero: Array
    """(m,) [rad]"""
    low: Counts
    """(m,) [counts] goals"""
    high: Counts
    """(m,) [counts]"""
    step: Array
    """(m,) [rad] per count"""

    def radians(self, counts: Sequence[int]) -> Array:
        """Joint positions (m,) [rad]."""
        return (np.array(counts) - self.middle) * self.step + self.zero

    def counts(self, position: Array) -> list[int]:
        """Goals (m,) of positions [rad], within the servos' limits."""
        goal = np.rint((position - self.zero) / self.step + self.middle)
        return list(map(int, np.clip(goal, self.low, self.high)))


SAGGING = 0.75
"""share of the first voltage (chosen: servos go silent at half of it)"""
VOLT = 0.1
"""[V] per count"""


def trouble(names: Mapping[int, str], bits: int, voltage: float = 1.0, before: float = 0.0) -> str:
    """Name what a servo suffers from, by its error ``bits`` and supply [V]; or empty."""
    found = [name for bit, name in names.items() if bits & bit]
    if voltage < SAGGING * before:
        found.append(f"the supply sags to {voltage:.1f} V from {before:.1f} V")
    return ", ".join(found)


class MotorRanges(NamedTuple):
    """LeRobot's calibration of the motors (n,)."""

    ids: tuple[tuple[int, ...], ...]
    """of each joint's servos: LeRobot calls a second one ``shoulder_shadow``"""
    homing: Counts
    low: Counts
    high: Counts
    turned: Counts
    """drive modes"""

    def require(self, arm: Arm, homing: Counts) -> None:
        """Raise RobotError unless the servos of ``arm`` have these offsets (n,)."""
        if (self.homing != homing).any():
            j = np.argmax(self.homing != homing)
            raise RobotError(
                f"the calibration file is not that of this arm: {arm.joint_names[j]} has a homing offset of "
                f"{homing[j]} counts in its servo and {self.homing[j]} in the file; give the arm's own file, or run "
                "lerobot-calibrate"
            )


def read_calibration(path: Path, arm: Arm, *, turned: bool = False) -> MotorRanges:
    """Read LeRobot's calibration of ``arm``, perhaps with ``turned`` motors; FileError, InputError for its numbers."""
    motors, names = read_homing(path, arm, turned=turned)
    joints = [motors[name] for name in names]
    homing, low, high = (
        np.array([joint[name] for joint in joints]) for name in ("homing_offset", "range_min", "range_max")
    )
    if not ((low >= 0) & (low < high) & (high < COUNTS_PER_TURN)).all():
        raise InputError(f"{path}: ranges must rise within 0 and {COUNTS_PER_TURN - 1}; run lerobot-calibrate again")
    pairs = [(joint, motors.get(f"{name}_shadow")) for name, joint in zip(arm.joint_names, joints, strict=True)]
    ids = tuple(tuple(motor["id"] for motor in pair if motor) for pair in pairs)
    return MotorRanges(ids, homing, low, high, np.array([joint.get("drive_mode", 0) for joint in joints]))


SOFT = 500
"""[0.1 %] torque of a gripper whose force can be limited so, in RAM (as in LeRobot)"""
MOST_SILENT = 3
"""Unanswered questions before it is given up (chosen)"""


class Gripper:
    """The servo behind the joints', from ``low`` (0 %) to ``high`` (100 %) [counts]; call `serve` each cycle."""

    def __init__(self, bus: ServoBus) -> None:
        """Read its range."""
        self.goal: float | None = None
        """[%]"""
        self.opened: float | None = None
        """[%] last reading"""
        self._bus, self._servo = bus, max(bus.ids) + 1
        self._sent: float | None = None
        self._silent = 0
        self._counts = bus.get(self._servo, "low"), bus.get(self._servo, "high")

    @classmethod
    def find(cls, bus: ServoBus) -> Self | None:
        """Gripper of an arm; None: no answer, or no range."""
        with contextlib.suppress(RobotError):
            found = cls(bus)
            if found._counts[0] < found._counts[1]:
                found._read()
                return found
        return None

    def serve(self) -> None:
        """Send a new goal, or read the opening."""
        if self._silent >= MOST_SILENT:
            return
        try:
            if self.goal is None or self.goal == self._sent:
                self._read()
            else:
                bus, servo = self._bus, self._servo
                if self._sent is None:
                    if "force" in bus.table:
                        bus.set(servo, "force", SOFT)
                    if not bus.get(servo, "torque"):
                        bus.set(servo, "goal", bus.get(servo, "position"))
                        bus.set(servo, "torque", 1)
                bus.set(servo, "goal", round(np.interp(self.goal, (0.0, 100.0), self._counts)))
                self._sent = self.goal
            self._silent = 0
        except RobotError:
            self._silent += 1

    def _read(self) -> None:
        self.opened = float(np.interp(self._bus.get(self._servo, "position"), self._counts, (0.0, 100.0)))
