"""What the emulated buses of servos share: registers, an arm behind them, and a conversation with its timing."""

import struct
import termios
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from rejoint.arms import Arm
from rejoint.robots.registers import Register
from rejoint.robots.wireserver import ByteStream, Format, await_data
from rejoint_lab.emulator.faults import SUPPLY_VOLTAGE, EmulatedArm, in_force, size_of
from rejoint_lab.emulator.servers import EmulatedConversation
from rejoint_lab.plant.servo import STEP, ServoTable
from rejoint_lab.plant.wear import PARAMETERS, Wear


class Packet(NamedTuple):
    """An instruction or a status."""

    id: int
    code: int
    """instruction or error bits"""
    parameters: bytes = b""


class MemoryField(NamedTuple):
    """A value in the registers."""

    name: str
    register: Register
    access: str
    """``read``: measured or fixed; ``ram``: lost with the power; ``saved``: kept"""
    default: int
    low: str
    high: str
    """limits: numbers or names of registers; empty: none"""


def registers_of(table: ServoTable, model: str) -> dict[str, MemoryField]:
    """Return the registers of a model by name."""
    found = {}
    for row in table.rows:
        if row["address"] and row[model]:
            register = Register(int(row["address"]), int(row["size"]), int(row["sign"]) if row["sign"] else None)
            found[row["name"]] = MemoryField(
                row["name"], register, row["access"], int(row[model]), row["low"], row["high"]
            )
    return found


class Registers:
    """Registers of one servo."""

    joint: int
    """that it turns; the gripper's is behind the last"""
    setting: Any
    status: Any
    """records of its plant"""
    awake = 0.0
    """[s] of the arm's clock from which it hears"""

    def __init__(self, fields: Mapping[str, MemoryField], size: int, number: int) -> None:
        self.fields, self.cells = fields, bytearray(size)
        self.at = {cell: field for field in fields.values() for cell in range(size)[field.register.cells]}
        """by cell"""
        self.update({name: field.default for name, field in fields.items()})
        self["ID"] = number
        self._kept = bytearray(self.cells)
        self.writes: deque[tuple[int, bytes]] = deque(maxlen=100_000)
        """the last executed: address and data"""

    def __getitem__(self, name: str) -> int:
        """Value of a register."""
        register = self.fields[name].register
        return register.decode(bytes(self.cells[register.cells]))

    def __setitem__(self, name: str, value: int) -> None:
        """Set a register."""
        register = self.fields[name].register
        self.cells[register.cells] = register.encode(value)

    def update(self, values: Mapping[str, float]) -> None:
        """Set registers to whole numbers."""
        for name, value in values.items():
            self[name] = int(value)

    @property
    def number(self) -> int:
        """ID."""
        return self["ID"]

    def save(self, cells: Iterable[int] | None = None) -> None:
        """Save these ``cells`` or all, as far as the servo does."""
        for cell in self.at if cells is None else cells:
            if cell in self.at and self.at[cell].access == "saved":
                self._kept[cell] = self.cells[cell]

    def cycle_power(self) -> None:
        """Power off and on: saved registers kept."""
        self.cells = bytearray(self._kept)


S = TypeVar("S", bound=Registers)


BYTE = 10e-6
"""[s] at 1 Mbaud, 8N1"""


class Answer(NamedTuple):
    """A returning status packet."""

    after: float
    """[s] from request to end of the answer"""
    data: bytes


BROADCAST = 0xFE
"""ID of all servos"""
PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
"""Instructions of both makers"""
TURN, DELAY_UNIT = 20e-6, 2e-6
"""[s] least pause before an answer (chosen: least seen), and unit of the return delay register"""


class Part(NamedTuple):
    """What a packet to several servos asks of one."""

    number: int
    """ID"""
    address: int
    size: int
    data: bytes
    """to write"""


class ServoArm(EmulatedArm, Generic[S]):
    """Servos of one arm on their wire, powered and holding."""

    table: ClassVar[ServoTable]
    jaw: ClassVar[tuple[float, float]]
    """[rad] range of the gripper"""
    gripper_model: ClassVar[Any]
    """of its servo"""
    scheme: ClassVar[str]
    """of its address"""
    wire_format: ClassVar[Format[Packet]]
    rates: ClassVar[tuple[int, ...]]
    """[1/s] by register"""
    reads: ClassVar[frozenset[int]] = frozenset({SYNC_READ})
    """instructions that read several servos"""
    writes: ClassVar[frozenset[int]] = frozenset({SYNC_WRITE})
    bulk: ClassVar[frozenset[int]] = frozenset()
    """those with an address and a size for each servo"""
    words: ClassVar[struct.Struct]
    """an address and a size"""
    ping_bytes: ClassVar[int]
    ping_pause: ClassVar[float] = 0.0
    """for the answer of each ID to a ping of all; [s]"""

    plant: Any
    gripper: Any
    servos: list[S]
    heard = 0.0
    """[s] of the clock at the last packet"""
    rate: int | None = None
    """[1/s] at which the client speaks; None: that of all"""

    def __init__(self, arm: Arm, wear: Wear, *, seed: int = 0, **truth: Any) -> None:  # noqa: ANN401
        """Put the arm at rest; ``truth`` as of `Plant`."""
        super().__init__(arm, wear, seed=seed, **truth)
        own = ("joint_names", "offset", "axis", "max_speed", "mass", "com", "inertia")
        lower, upper = np.array(self.jaw)[:, None]
        hinge = replace(
            arm,
            **{name: getattr(arm, name)[-1:] for name in own},
            lower=lower,
            upper=upper,
            rest=np.zeros(1),
            servos=(self.gripper_model(arm),),
        )
        worn = replace(wear, offset=0.0, **{name: getattr(wear, name)[-1:] for name in PARAMETERS})
        self.gripper = self.kind(hinge, [worn], seed=seed, gravity=np.zeros(3))  # worn as the last joint
        self._owed = 0.0
        self.clock = 0.0
        """[s]"""
        self.servos = []
        plants = self.plant, self.gripper
        self._fit([record for plant in plants for record in zip(plant.settings[0], plant.status[0], strict=True)])
        self._nominal = [servo.setting["voltage"] for servo in self.servos]

    @abstractmethod
    def _fit(self, records: list[tuple[Any, Any]]) -> None:
        """Build the servos in, with the settings and status of each joint and the gripper."""

    def advance(self, duration: float) -> None:
        """Advance by [s], in whole milliseconds."""
        self._owed += duration
        steps = int(self._owed / STEP)
        self._owed -= steps * STEP
        self.clock += steps * STEP
        drop = size_of(self.faults, "sag") * sum(abs(servo.status["current"]) for servo in self.servos)
        supply, warmth = self.voltage, self.temperature - self.plant.temperature[0]
        for servo, nominal in zip(self.servos, self._nominal, strict=True):
            volts = max(self._of_joint(servo, supply, SUPPLY_VOLTAGE) - drop, 0.0)
            servo.setting["voltage"] = nominal * volts / SUPPLY_VOLTAGE
            servo.setting["warmth"] = self._of_joint(servo, warmth, 0.0)
        self.plant.advance(steps * STEP)
        self.gripper.advance(steps * STEP)

    def suffer(self, elapsed: float) -> None:
        """Let faults begin; ``elapsed`` [s] after the first byte."""
        same, without = self._begun("same"), self.unpowered
        super().suffer(elapsed)
        first = {servo.joint: servo for servo in reversed(self.servos)}
        for joint in np.flatnonzero(self._begun("same") & ~same).tolist():
            first[joint]["ID"] = first[joint - 1 if joint else 1].number
        if self.unpowered and not without:
            for servo in self.servos:
                self.restart(servo)

    @property
    def unpowered(self) -> bool:
        """Whether the supply is off."""
        return bool(in_force(self.faults, "power", self._elapsed))

    @abstractmethod
    def restart(self, servo: S) -> None:
        """Cycle the power of a servo."""

    def settle(self, servo: S) -> None:
        """Apply the registers of a servo."""
        for field, (name, factor) in self.table.settings.items():
            if name in servo.fields:
                servo.setting[field] = servo[name] * factor

    def alarms_of(self, servo: S) -> int:
        """Error bits of a servo."""
        return int(servo.status["alarms"]) | int(self._of_joint(servo, self.alarms, 0))

    def count(self, servo: S) -> int:
        """Count of a servo from its joint's zero, as its encoder tells it."""
        if servo.joint < self.arm.joints:
            return round(self.angles[servo.joint] / self.arm.encoder_step)
        return int(self.gripper.status["position"].flat[0])

    def _heat(self, servo: S) -> float:
        return min(self._of_joint(servo, self.temperature, self.gripper.temperature[0, 0]), 255.0)

    def _current(self, servo: S) -> float:
        """Present current [A]."""
        current = servo.status["current"]
        return np.copysign(max(abs(current), self._of_joint(servo, self.least_current, 0.0)), current)

    def _of_joint(self, servo: S, values: Any, gripper: Any) -> Any:  # noqa: ANN401
        """Of values (n,) that of a servo's joint, or the ``gripper``'s."""
        return values[servo.joint] if servo.joint < self.arm.joints else gripper

    def _aim(self, servo: S, goal: int) -> None:
        """Send a servo to a ``goal`` [counts] from its joint's zero."""
        servo.status["goal"] = goal
        if servo.joint < self.arm.joints:
            self.plant.servos["goal"][0, servo.joint] = goal * self.arm.encoder_step

    # --- the wire ---------------------------------------------------------------------------

    @property
    def byte(self) -> float:
        """[s] of a byte, 8N1."""
        return BYTE if self.rate is None else 10.0 / self.rate

    def hearing(self) -> list[S]:
        """Servos that hear the client."""
        if self.unpowered:
            return []
        mute = self._begun("mute")
        return [
            servo
            for servo in self.servos
            if not self._of_joint(servo, mute, False)
            and servo.awake <= self.clock
            and self.rate in (None, dict(enumerate(self.rates)).get(servo["Baud_Rate"]))
        ]

    def execute(self, request: Packet) -> list[Answer]:
        """Execute a packet; returns the answers in order of time."""
        hearing, self.heard = self.hearing(), self.clock
        if request.code in self.writes:
            for part in self._parts(request):
                for servo in hearing:
                    if part.number in self._numbers(servo):
                        self._write(servo, part.number != servo.number, part.address, part.data)
            return []
        if request.code in self.reads:
            asked = [
                ([servo for servo in hearing if servo.number == part.number], part) for part in self._parts(request)
            ]
            return self._row(request.code, asked)
        answers = []
        for servo in sorted(hearing, key=lambda one: one.number):
            if request.id in (BROADCAST, *self._numbers(servo)):
                found = self._obey(servo, request)
                if found is not None and request.id in (BROADCAST, servo.number):
                    turn = servo.number if request.id == BROADCAST else 0
                    slot = turn * (self.ping_bytes * self.byte + self.ping_pause)
                    answers.append(self._answer(servo, slot, *found))
        return answers

    def _parts(self, request: Packet) -> Iterator[Part]:
        """Yield the parts of a packet to several servos."""
        data = request.parameters
        head = b"" if request.code in self.bulk else data[: self.words.size]
        place = len(head)
        while (start := place + 1 + self.words.size - len(head)) <= len(data):
            address, size = self.words.unpack(head or data[place + 1 : start])
            end = start + size * (request.code in self.writes)
            if end <= len(data):
                yield Part(data[place], address, size, data[start:end])
            place = end

    @abstractmethod
    def _obey(self, servo: S, request: Packet) -> tuple[int, bytes] | None:
        """Error and data of the answer; None: none."""

    @abstractmethod
    def _write(self, servo: S, shadow: bool, address: int, data: bytes) -> int:
        """Write registers of a servo, perhaps as a ``shadow`` of another; returns the error."""

    @abstractmethod
    def _row(self, code: int, asked: list[tuple[list[S], Part]]) -> list[Answer]:
        """Answers of several servos, asked at once."""

    @abstractmethod
    def _status(self, servo: S, error: int, data: bytes) -> Packet:
        """Return a servo's status packet."""

    def _numbers(self, servo: S) -> tuple[int, ...]:
        """Return the IDs that a servo obeys."""
        return (servo.number,)

    def _delay(self, servo: S) -> float:
        return max(TURN, servo["Return_Delay_Time"] * DELAY_UNIT)

    def _answer(self, servo: S, slot: float, error: int, data: bytes) -> Answer:
        frame = self.wire_format.write(self._status(servo, error, data))
        return Answer(slot + self._delay(servo) + len(frame) * self.byte, frame)


PROMPT = 0.0005
"""[s] before an answer that are not slept through (chosen: a system wakes up so late)"""
ADAPTER = 0.001
"""[s] of a USB adapter per request and answer (chosen)"""


def rate_of(channel: ByteStream) -> int | None:
    """[1/s] that a client gave its serial line; None: it is none, or not set."""
    try:
        code = termios.tcgetattr(channel.fileno())[5]
    except (termios.error, OSError, ValueError):
        return None
    return _RATES.get(code)


_RATES = {
    getattr(termios, f"B{rate}"): rate
    for rate in (9600, 57_600, 115_200, 500_000, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
    if hasattr(termios, f"B{rate}")
}


def await_promptly(readable: int | None, pause: float) -> bool:
    """As `await_data`, but on time after a short pause."""
    if readable is not None or pause > PROMPT:
        return await_data(readable, pause)
    until = time.monotonic() + pause
    while time.monotonic() < until:
        pass
    return False


class BusSession(EmulatedConversation[Packet]):
    """The servos of an ``arm`` for one client at a time, with timing."""

    await_data = staticmethod(await_promptly)

    def __init__(self, arm: ServoArm[Any], **options: Any) -> None:  # noqa: ANN401
        super().__init__(arm, **options)
        self.arm, self.scheme, self.wire_format = arm, arm.scheme, arm.wire_format
        # until when the wire is busy
        self._free = 0.0

    def _answer(self, channel: ByteStream, request: Packet) -> None:
        self._catch_up()
        self.arm.rate, sent = rate_of(channel), self.wire_format.write(request)
        self._free = max(self._came, self._free) + len(sent) * self.arm.byte
        answers = list[Answer]()
        for answer in self.arm.execute(request):
            if answers and abs(answers[-1].after - answer.after) < 1e-9:  # they spoil one another: a zero wins
                spoilt = answers.pop().data
                answer = answer._replace(data=bytes(a & b for a, b in zip(spoilt, answer.data, strict=False)))
            answers.append(answer)
        if not answers:
            return
        if request.code == READ or request.code in self.arm.reads:
            self.arm.was_read()
        pieces = [b""]
        for answer in answers:
            first, *rest = self._wire.pieces(sent, answer.data) or [b""]
            pieces[-1] += first
            pieces += rest
        self._free += answers[-1].after
        due = self._free + ADAPTER + self._wire.delay
        self.wait(None, due - PROMPT)
        self.await_data(None, max(due - self.clock(), 0.0))
        self._say(channel, pieces)
