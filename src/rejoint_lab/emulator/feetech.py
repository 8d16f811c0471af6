"""An SO-101 behind the bus of its servos: packets, registers and timing.

Sources: Feetech's protocol manual and memory table of the STS/SMS series (``sts3215.csv``: factory defaults, LeRobot's
names), and recorded LeRobot packets.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from dataclasses import replace
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from rejoint.arms import Arm
from rejoint.robots.wireserver import ByteStream, Finder
from rejoint_lab.emulator.faults import NONE, SUPPLY_VOLTAGE, EmulatedArm, Faults, in_force
from rejoint_lab.emulator.servers import EmulatedConversation
from rejoint_lab.plant.plant import StsPlant, Truth
from rejoint_lab.plant.servo import STEP

SIZE = 88
"""[bytes] (chosen: the last known register is 86)"""


class MemoryField(NamedTuple):
    """A value in the registers."""

    address: int
    size: int
    name: str
    access: str
    """``read``: measured or fixed; ``ram``: lost with the power; ``saved``: kept if written unlocked"""
    default: int
    unit: str
    sign: int | None
    """sign bit, or None"""

    @property
    def cells(self) -> slice:
        """Its place."""
        return slice(self.address, self.address + self.size)


with (files(__package__) / "sts3215.csv").open(encoding="utf-8") as _file:
    TABLE = tuple(
        MemoryField(int(address), int(size), name, access, int(default), unit, int(sign) if sign else None)
        for address, size, name, access, default, unit, sign in list(csv.reader(_file))[1:]
    )
BY_NAME: dict[str, MemoryField] = {register.name: register for register in TABLE}


def factory_settings(servo: int) -> bytearray:
    """Return registers of a servo with this ID as sold."""
    cells = bytearray(SIZE)
    for register in TABLE:
        cells[register.cells] = register.default.to_bytes(register.size, "little")
    cells[BY_NAME["ID"].address] = servo
    return cells


HEADER = b"\xff\xff"
BROADCAST = 0xFE
"""ID of all servos"""
MOST_PARAMETERS = 248
"""per packet: clients cap packets at 250 bytes"""

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83


class Packet(NamedTuple):
    """An instruction or a status."""

    id: int
    code: int
    """instruction or error bits"""
    parameters: bytes = b""


def checksum(body: bytes) -> int:
    """Last byte of a packet of ID, length, code and parameters."""
    return ~sum(body) & 0xFF


def encode(packet: Packet) -> bytes:
    """Bytes of a packet."""
    body = bytes((packet.id, len(packet.parameters) + 2, packet.code)) + packet.parameters
    return HEADER + body + bytes((checksum(body),))


def size_of(data: bytes) -> int | None:
    """Size of the packet at the beginning; 0: none, None: incomplete."""
    if data[2:3] == b"\xff":
        return 0
    if len(data) < 4:
        return None
    size = data[3] + 4
    if not 2 <= data[3] <= MOST_PARAMETERS + 2:
        return 0
    return None if len(data) < size else size * (checksum(data[2 : size - 1]) == data[size - 1])


class PacketFinder(Finder[Packet]):
    """Finds packets in a stream of bytes."""

    def __init__(self) -> None:
        super().__init__(HEADER, size_of, lambda data: Packet(data[2], data[4], data[5:-1]))


def magnitude(value: int, bit: int) -> int:
    """``value`` as size and sign ``bit``."""
    if abs(value) >= 1 << bit:
        raise ValueError(f"{value} does not fit into {bit} bits and a sign")
    return -value | 1 << bit if value < 0 else value


def signed(word: int, bit: int) -> int:
    """Inverse of `magnitude`."""
    size = word & ~(1 << bit)
    return -size if word & 1 << bit else size


COUNTS = 4096
"""per turn"""
MIDDLE = 2048
"""[counts] at joint zero"""

_AT = {cell: register for register in TABLE for cell in range(register.address, register.address + register.size)}


class Servo:
    """Registers of one servo; its arm updates measured ones."""

    def __init__(self, number: int) -> None:
        self.cells = factory_settings(number)
        self._kept = bytearray(self.cells)
        self.writes: list[tuple[int, bytes]] = []
        """executed: address and data"""

    def __getitem__(self, name: str) -> int:
        """Value of a register."""
        register = BY_NAME[name]
        word = int.from_bytes(self.cells[register.cells], "little")
        return word if register.sign is None else signed(word, register.sign)

    def __setitem__(self, name: str, value: int) -> None:
        """Set a register."""
        register = BY_NAME[name]
        word = value if register.sign is None else magnitude(value, register.sign)
        self.cells[register.cells] = word.to_bytes(register.size, "little")

    @property
    def number(self) -> int:
        """ID."""
        return self["ID"]

    def read(self, address: int, size: int) -> bytes:
        """Read ``size`` registers; zeros beyond the last."""
        return bytes(self.cells[address : address + size]).ljust(size, b"\0")

    def write(self, address: int, data: bytes) -> set[str]:
        """Write registers, permanently if unlocked; return their names."""
        self.writes.append((address, data))
        end = min(address + len(data), SIZE)
        cells = [cell for cell in range(address, end) if cell in _AT and _AT[cell].access != "read"]
        for cell in cells:
            self.cells[cell] = data[cell - address]
        if self["Lock"] == 0:
            self.save(cells)
        touched = {_AT[cell].name for cell in cells}
        if "Goal_Position" in touched and self["Torque_Enable"] == 0:
            self["Torque_Enable"] = 1
            touched.add("Torque_Enable")
        if "Acceleration" in touched and self["Maximum_Acceleration"]:
            self["Acceleration"] = min(self["Acceleration"], self["Maximum_Acceleration"])
        return touched

    def save(self, cells: Iterable[int] = range(SIZE)) -> None:
        """Save these ``cells``, as far as the servo does."""
        for cell in cells:
            if cell in _AT and _AT[cell].access == "saved":
                self._kept[cell] = self.cells[cell]

    def cycle_power(self) -> None:
        """Power off and on: torque off, locked, saved registers kept."""
        self.cells = bytearray(self._kept)
        self["Torque_Limit"] = self["Max_Torque_Limit"]


NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
"""Motors of an SO-101 by ID, 1 to 6 (LeRobot)"""
HOMING = (-1470, 63, 911, -388, 85, -1021)
"""[counts] (chosen: like real arms)"""
PROMPT = 254
"""[100 counts/s^2] as LeRobot sets it"""
CURRENT_UNIT = 0.0065
"""[A] per count"""
_GRIPPER = (-0.17, 1.75)  # [rad] range of the jaw: so101_new_calib.xml
# Fields of `sts3215.SETTING`: the register of each, and its unit.
_SETTINGS = {
    "p": ("P_Coefficient", 1),
    "d": ("D_Coefficient", 1),
    "i": ("I_Coefficient", 1),
    "startup": ("Minimum_Startup_Force", 1),
    "integral_limit": ("Integral_Limit", 1),
    "dead_cw": ("CW_Dead_Zone", 1),
    "dead_ccw": ("CCW_Dead_Zone", 1),
    "torque_limit": ("Torque_Limit", 1),
    "threshold": ("Moving_Velocity_Threshold", 1),
    "unloading": ("Unloading_Condition", 1),
    "heat_limit": ("Max_Temperature_Limit", 1),
    "torque_on": ("Torque_Enable", 1),
    "protective": ("Protective_Torque", 10),
    "overload": ("Overload_Torque", 10),
    "protection_ticks": ("Protection_Time", 10),
    "current_ticks": ("Over_Current_Protection_Time", 10),
    "current_limit": ("Protection_Current", CURRENT_UNIT),
    "low_voltage": ("Min_Voltage_Limit", 0.1),
    "high_voltage": ("Max_Voltage_Limit", 0.1),
}


class ServoArm(EmulatedArm):
    """Six servos of one arm, powered and holding."""

    plant: StsPlant

    def __init__(self, plant: StsPlant, gripper: StsPlant, arm: Arm, *, resistance: float = 0.0) -> None:
        """``gripper``: its servo alone; ``resistance`` [ohm] of the supply."""
        super().__init__(plant, arm)
        self.resistance = resistance
        self.gripper = gripper
        self.servos = [Servo(number) for number in range(1, arm.joints + 2)]
        self._settings = [*plant.settings[0], *gripper.settings[0]]
        self._status = [*plant.status[0], *gripper.status[0]]
        self._owed = 0.0
        for servo, homing, limits in zip(self.servos, HOMING, self._ranges(), strict=True):
            servo["Homing_Offset"], servo["Torque_Enable"] = homing, 1
            servo["Acceleration"] = servo["Maximum_Acceleration"] = PROMPT
            servo["Min_Position_Limit"], servo["Max_Position_Limit"] = limits
            servo.save()
        for index in range(len(self.servos)):
            self.settle(index)

    def advance(self, duration: float) -> None:
        """Advance by [s], in whole milliseconds."""
        self._owed += duration
        steps = int(self._owed / STEP)
        self._owed -= steps * STEP
        drop = self.resistance * sum(abs(float(status["current"])) for status in self._status)
        settings = self.plant.settings
        settings["voltage"][0] = np.maximum(self.voltage - drop, 0.0)
        settings["warmth"][0] = self.temperature - self.plant.temperature[0]
        self.gripper.settings["voltage"] = max(SUPPLY_VOLTAGE - drop, 0.0)
        self.plant.advance(steps * STEP)
        self.gripper.advance(steps * STEP)

    def settle(self, index: int) -> None:
        """Apply the registers of a servo, index from 0."""
        servo, setting = self.servos[index], self._settings[index]
        for field, (name, unit) in _SETTINGS.items():
            setting[field] = servo[name] * unit
        low, high = servo["Min_Position_Limit"], servo["Max_Position_Limit"]
        shift = self._shift(index) if low != high else 0
        setting["least"], setting["most"] = low + shift, high + shift
        acceleration = servo["Acceleration"] or servo["Maximum_Acceleration"] * servo["Acceleration_Multiplier"]
        setting["acceleration"] = 100.0 * max(acceleration, 1)
        setting["speed"] = float(abs(servo["Goal_Velocity"]) or 50 * servo["Maximum_Velocity_Limit"])

    def go(self, index: int) -> None:
        """Apply a servo's goal, and its torque."""
        self._settings[index]["torque_on"] = self.servos[index]["Torque_Enable"]
        goal = self.servos[index]["Goal_Position"] + self._shift(index)
        self._status[index]["goal"] = goal
        if index < self.arm.joints:
            self.plant.servos["goal"][0, index] = goal * self.arm.encoder_step

    def measure(self, index: int) -> None:
        """Write a servo's measurements to its registers."""
        status, setting = self._status[index], self._settings[index]
        joint, shift = index < self.arm.joints, self._shift(index)
        heat = self.temperature[index] if joint else self.gripper.temperature[0, 0]
        least = self.least_current[index] if joint else 0.0
        current = round(max(abs(float(status["current"])), least) / CURRENT_UNIT)
        measured = {
            "Present_Position": (self._count(index) - shift) % COUNTS,
            "Present_Velocity": np.clip(status["speed"], -32767, 32767),
            "Present_Load": np.clip(status["output"], -1023, 1023),
            "Present_Voltage": round(float(setting["voltage"]) * 10),
            "Present_Temperature": min(heat, 255.0),
            "Status": self.status(index),
            "Moving": status["moving"],
            "Goal_In_Force": status["goal"] - shift,
            "Present_Current": -current if status["current"] < 0 else current,
            "Torque_Enable": setting["torque_on"],  # over-current switches it off
        }
        for name, value in measured.items():
            self.servos[index][name] = int(value)

    def status(self, index: int) -> int:
        """Error bits of a servo."""
        own = int(self._status[index]["alarms"])
        return own | int(self.alarms[index]) if index < self.arm.joints else own

    def _count(self, index: int) -> int:
        if index < self.arm.joints:
            return round(float(self.angles[index]) / self.arm.encoder_step)
        return int(self.gripper.status["position"][0, 0])

    def _shift(self, index: int) -> int:
        return self.servos[index]["Homing_Offset"] - HOMING[index] - MIDDLE

    def _ranges(self) -> list[tuple[int, int]]:
        """Limits [counts] of LeRobot's calibration: a full turn for the wrist."""
        pairs = [*zip(self.arm.lower, self.arm.upper, strict=True), _GRIPPER]
        ends = [
            (MIDDLE + round(a / self.arm.encoder_step), MIDDLE + round(b / self.arm.encoder_step)) for a, b in pairs
        ]
        ends[-2] = (0, COUNTS - 1)
        return ends


def build_arm(arm: Arm, wear_name: str, *, seed: int = 0, resistance: float = 0.0) -> ServoArm:
    """Arm with the wear profile ``wear_name`` behind its servos, at rest; the gripper's is worn as the last joint's."""
    from rejoint_lab.plant.wear import PARAMETERS, load_wear

    wear, ends = load_wear(wear_name, arm), np.array(_GRIPPER)
    own = ("joint_names", "offset", "axis", "max_speed", "mass", "com", "inertia", "servos")
    hinge = replace(
        arm, **{name: getattr(arm, name)[-1:] for name in own}, lower=ends[:1], upper=ends[1:], rest=np.zeros(1)
    )
    worn = replace(wear, offset=0.0, **{name: getattr(wear, name)[-1:] for name in PARAMETERS})
    gripper = StsPlant(hinge, [worn], seed=seed, truth=Truth(gravity=np.zeros(3)))
    built = ServoArm(StsPlant(arm, [wear], seed=seed), gripper, arm, resistance=resistance)
    built.advance(0.01)  # compiles the plant now instead of during the first request
    return built


BYTE = 10e-6
"""[s] at 1 Mbaud, 8N1"""
TURN = 20e-6
"""[s] least pause before an answer (chosen: least seen)"""
DELAY_UNIT = 2e-6
"""[s] of the return delay register"""
MOST_DATA = 128
"""[bytes] buffer of a servo"""
# [bytes] between the slots of a synchronous read, beside the answer (the firmware's own sum)
_BETWEEN = 3
_WORD = 2


class Answer(NamedTuple):
    """A returning status packet."""

    servo: int
    """from 0"""
    after: float
    """[s] from request to end of the answer"""
    data: bytes


class EmulatedBus:
    """Servos of ``arm`` on their wire; ``muted`` ones, from 0, are silent."""

    def __init__(self, arm: ServoArm) -> None:
        self.arm = arm
        self.muted: Callable[[], Iterable[int]] = lambda: ()

    def execute(self, request: Packet) -> list[Answer]:
        """Execute a packet; returns the answers in order of time."""
        hearing = [(i, servo.number) for i, servo in enumerate(self.arm.servos) if i not in set(self.muted())]
        parts = request.parameters
        if request.code == SYNC_READ and len(parts) > _WORD:
            return [
                self._status(index, number, self._read(index, *parts[:_WORD]), place * (parts[1] + 6 + _BETWEEN) * BYTE)
                for place, asked in enumerate(parts[_WORD:])
                for index, number in hearing
                if number == asked
            ]
        if request.code == SYNC_WRITE:
            self._sync_write(parts, {number: index for index, number in hearing})
            return []
        answers = []
        for index, number in hearing:
            if request.id not in (BROADCAST, number):
                continue
            data = self._obey(index, request)
            if data is not None and (request.id != BROADCAST or request.code == PING):
                slot = number * (_BETWEEN + 6) * BYTE if request.id == BROADCAST else 0.0
                answers.append(self._status(index, number, data, slot))
        return answers

    def _read(self, index: int, address: int, size: int) -> bytes:
        self.arm.measure(index)
        return self.arm.servos[index].read(address, min(size, MOST_DATA))

    def _obey(self, index: int, request: Packet) -> bytes | None:
        servo, data = self.arm.servos[index], request.parameters
        if request.code == PING:
            return b""
        if request.code == READ and len(data) == _WORD:
            return self._read(index, *data)
        if request.code != WRITE or len(data) < _WORD:
            return None
        answers = servo["Response_Status_Level"] != 0
        self._write(index, data[0], data[1:])
        return b"" if answers else None

    def _write(self, index: int, address: int, data: bytes) -> None:
        touched = self.arm.servos[index].write(address, data)
        if touched - {"Goal_Position"}:
            self.arm.settle(index)
        if "Goal_Position" in touched:
            self.arm.go(index)

    def _sync_write(self, parts: bytes, hearing: dict[int, int]) -> None:
        if len(parts) < _WORD or not parts[1]:
            return
        address, size, *rest = parts
        for start in range(0, len(rest) - size, size + 1):
            if rest[start] in hearing:
                self._write(hearing[rest[start]], address, bytes(rest[start + 1 : start + 1 + size]))

    def _status(self, index: int, number: int, data: bytes, slot: float) -> Answer:
        frame = encode(Packet(number, self.arm.status(index), data))
        delay = max(TURN, self.arm.servos[index]["Return_Delay_Time"] * DELAY_UNIT)
        return Answer(index, slot + delay + len(frame) * BYTE, frame)


ADAPTER = 0.001
"""[s] of a USB adapter per request and answer (chosen)"""


class BusSession(EmulatedConversation[Packet]):
    """Servos of ``arm`` for one client at a time, with timing."""

    scheme = "feetech"

    def __init__(
        self,
        arm: ServoArm,
        *,
        adapter: float = ADAPTER,
        faults: Faults = NONE,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(arm, faults=faults, **options)
        self.bus = EmulatedBus(arm)
        self.bus.muted = lambda: {
            joint for spell in in_force(faults, "mute", self._elapsed(self._clock())) for joint in spell.joints
        }
        # until when the wire is busy
        self._adapter, self._free = adapter, 0.0

    def _finder(self) -> PacketFinder:
        return PacketFinder()

    def _answer(self, channel: ByteStream, request: Packet) -> None:
        self._catch_up()
        self._free = max(self._came, self._free) + len(encode(request)) * BYTE
        answers = self.bus.execute(request)
        if not answers:
            return
        if request.code in (READ, SYNC_READ):
            self._emulated.was_read()
        pieces = [b""]
        for answer in answers:
            first, *rest = self._wire.pieces(encode(request), answer.data) or [b""]
            pieces[-1] += first
            pieces += rest
        self._free += answers[-1].after
        self.wait(None, self._free + self._adapter + self._wire.delay)
        self._say(channel, pieces)
