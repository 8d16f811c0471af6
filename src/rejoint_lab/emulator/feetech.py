"""An SO-101 behind the bus of its servos: packets, registers and timing.

Sources: Feetech's protocol manual and memory table of the STS/SMS series (``sts3215.csv``: factory defaults, LeRobot's
names), and recorded LeRobot packets.
"""

from __future__ import annotations

import csv
from importlib.resources import files
from typing import Any

import numpy as np

from rejoint.arms import Arm
from rejoint.robots.wireserver import Finder
from rejoint_lab.emulator.servobus import (
    Answer,
    BusSession,
    EmulatedBus,
    MemoryField,
    Packet,
    Registers,
    ServoArm,
    alone,
)
from rejoint_lab.plant.plant import StsPlant
from rejoint_lab.plant.wear import load_wear

SIZE = 88
"""[bytes] (chosen: the last known register is 86)"""


with (files(__package__) / "sts3215.csv").open(encoding="utf-8") as _file:
    TABLE = tuple(
        MemoryField(int(address), int(size), name, access, int(default), int(sign) if sign else None)
        for address, size, name, access, default, _unit, sign in list(csv.reader(_file))[1:]
    )
BY_NAME: dict[str, MemoryField] = {register.name: register for register in TABLE}


HEADER = b"\xff\xff"
BROADCAST = 0xFE
"""ID of all servos"""
MOST_PARAMETERS = 248
"""per packet: clients cap packets at 250 bytes"""

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83


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


COUNTS = 4096
"""per turn"""
MIDDLE = 2048
"""[counts] at joint zero"""


class Servo(Registers):
    """Registers of one servo; its arm updates measured ones."""

    def __init__(self, number: int) -> None:
        super().__init__(BY_NAME, SIZE, number)

    def read(self, address: int, size: int) -> bytes:
        """Read ``size`` registers; zeros beyond the last."""
        return bytes(self.cells[address : address + size]).ljust(size, b"\0")

    def write(self, address: int, data: bytes) -> set[str]:
        """Write registers, permanently if unlocked; return their names."""
        self.writes.append((address, data))
        end = min(address + len(data), SIZE)
        cells = [cell for cell in range(address, end) if cell in self.at and self.at[cell].access != "read"]
        for cell in cells:
            self.cells[cell] = data[cell - address]
        if self["Lock"] == 0:
            self.save(cells)
        touched = {self.at[cell].name for cell in cells}
        if "Goal_Position" in touched and self["Torque_Enable"] == 0:
            self["Torque_Enable"] = 1
            touched.add("Torque_Enable")
        if "Acceleration" in touched and self["Maximum_Acceleration"]:
            self["Acceleration"] = min(self["Acceleration"], self["Maximum_Acceleration"])
        return touched

    def cycle_power(self) -> None:
        """Power off and on: torque off, locked, saved registers kept."""
        super().cycle_power()
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


class StsArm(ServoArm):
    """Six servos of one arm, powered and holding."""

    plant: StsPlant

    def __init__(self, plant: StsPlant, gripper: StsPlant, arm: Arm, *, resistance: float = 0.0) -> None:
        """``gripper``: its servo alone; ``resistance`` [ohm] of the supply."""
        super().__init__(plant, gripper, arm, resistance)
        self.servos = [Servo(number) for number in range(1, arm.joints + 2)]
        self._settings = [*plant.settings[0], *gripper.settings[0]]
        self._status = [*plant.status[0], *gripper.status[0]]
        for servo, homing, limits in zip(self.servos, HOMING, self._ranges(), strict=True):
            servo["Homing_Offset"], servo["Torque_Enable"] = homing, 1
            servo["Acceleration"] = servo["Maximum_Acceleration"] = PROMPT
            servo["Min_Position_Limit"], servo["Max_Position_Limit"] = limits
            servo.save()
        for index in range(len(self.servos)):
            self.settle(index)

    def restart(self, index: int) -> None:
        """Cycle the power of a servo, from 0."""
        self.servos[index].cycle_power()
        self.settle(index)

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


def build_arm(arm: Arm, wear_name: str, *, seed: int = 0, resistance: float = 0.0) -> StsArm:
    """Arm with the wear profile ``wear_name`` behind its servos, at rest; the gripper's is worn as the last joint's."""
    wear = load_wear(wear_name, arm)
    gripper = alone(arm, wear, np.array(_GRIPPER), StsPlant, arm.servos[-1], seed)
    built = StsArm(StsPlant(arm, [wear], seed=seed), gripper, arm, resistance=resistance)
    built.advance(0.01)  # compiles the plant now instead of during the first request
    return built


TURN = 20e-6
"""[s] least pause before an answer (chosen: least seen)"""
DELAY_UNIT = 2e-6
"""[s] of the return delay register"""
MOST_DATA = 128
"""[bytes] buffer of a servo"""
# [bytes] between the slots of a synchronous read, beside the answer (the firmware's own sum)
_BETWEEN = 3
_WORD = 2


class StsBus(EmulatedBus):
    """Servos of an SO-101 on their wire."""

    rates = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)

    def execute(self, request: Packet) -> list[Answer]:
        """Execute a packet; returns the answers in order of time."""
        hearing = [(index, servo.number) for index, servo in self.hearing()]
        parts = request.parameters
        if request.code == SYNC_READ and len(parts) > _WORD:
            return [
                self._status(
                    index, number, self._read(index, *parts[:_WORD]), place * (parts[1] + 6 + _BETWEEN) * self.byte
                )
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
                slot = number * (_BETWEEN + 6) * self.byte if request.id == BROADCAST else 0.0
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
        return Answer(index, slot + delay + len(frame) * self.byte, frame)


class StsSession(BusSession):
    """Servos of ``arm`` for one client at a time, with timing."""

    scheme = "feetech"
    reading = frozenset({READ, SYNC_READ})

    def __init__(self, arm: StsArm, **options: Any) -> None:  # noqa: ANN401
        super().__init__(StsBus(arm), **options)

    def _finder(self) -> PacketFinder:
        return PacketFinder()

    def _bytes_of(self, request: Packet) -> bytes:
        return encode(request)
