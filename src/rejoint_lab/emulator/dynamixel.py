"""Arms on ROBOTIS' X series behind their bus: Protocol 2.0, registers, errors and timing.

Sources: ROBOTIS' e-manual (protocol 2, control tables); LeRobot, Interbotix and ROBOTIS' open_manipulator (what their
software leaves in the servos). Where the manual is silent, a comment says what was chosen.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np

from rejoint.arms import Arm
from rejoint.robots.wireserver import Finder
from rejoint_lab.emulator.faults import BITS
from rejoint_lab.emulator.servobus import (
    TWO,
    Answer,
    BusSession,
    EmulatedBus,
    MemoryField,
    Packet,
    Registers,
    ServoArm,
    alone,
)
from rejoint_lab.plant import xseries
from rejoint_lab.plant.plant import XPlant
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.plant.xseries import COUNTS, CURRENT, EXTENDED, NEW, POSITION, PWM, ROWS, SHOCK

HEADER = b"\xff\xff\xfd"
BROADCAST = 0xFE
"""ID of all servos"""
PING, READ, WRITE, REG_WRITE, ACTION, FACTORY_RESET, REBOOT, CLEAR = 1, 2, 3, 4, 5, 6, 8, 0x10
STATUS, SYNC_READ, SYNC_WRITE, FAST_SYNC_READ = 0x55, 0x82, 0x83, 0x8A
BULK_READ, BULK_WRITE, FAST_BULK_READ = 0x92, 0x93, 0x9A
FAILED, UNKNOWN, RANGE, LENGTH, LIMIT, ACCESS = 1, 2, 4, 5, 6, 7
"""Numbers of errors"""
ALERT = 0x80
_MOST = 1024  # [bytes] of a packet, as ROBOTIS' client takes them
_CLEAR = b"\x01DXL\x22"


def _table() -> Iterator[int]:
    for word in range(0, 0x10000, 0x100):
        for _ in range(8):
            word = word << 1 ^ (0x8005 if word & 0x8000 else 0)
        yield word & 0xFFFF


_CRC = tuple(_table())


def crc(data: bytes) -> bytes:
    """CRC-16 of a packet: polynomial 0x8005."""
    found = 0
    for byte in data:
        found = (found << 8 & 0xFFFF) ^ _CRC[found >> 8 ^ byte]
    return found.to_bytes(2, "little")


def encode(packet: Packet) -> bytes:
    """Bytes of a packet, stuffed."""
    body = (bytes([packet.code]) + packet.parameters).replace(HEADER, HEADER + b"\xfd")
    data = HEADER + bytes([0, packet.id]) + (len(body) + 2).to_bytes(2, "little") + body
    return data + crc(data)


def size_of(data: bytes) -> int | None:
    """Size of the packet at the beginning; 0: none, None: incomplete."""
    if len(data) < 7:
        return None
    size = 7 + int.from_bytes(data[5:7], "little")
    if data[3] or not 10 <= size <= _MOST:
        return 0
    return None if len(data) < size else size * (crc(data[: size - 2]) == data[size - 2 : size])


def read_packet(data: bytes) -> Packet:
    """Packet of its bytes."""
    body = data[7:-2].replace(HEADER + b"\xfd", HEADER)
    return Packet(data[4], body[0], body[1:])


def finder() -> Finder[Packet]:
    """Find packets in a stream of bytes."""
    return Finder(HEADER, size_of, read_packet)


SIZE = 662
"""[bytes] of registers"""
RAM = 64
"""First register that the power's end resets"""
BOOT = 0.2
"""[s] of silence after a reboot (chosen)"""
WATCHDOG_UNIT, EXPIRED = 0.02, 255
"""[s] of the bus watchdog's register, and its value when it has run out"""
_HOMED = 1024  # [counts] a larger homing offset counts for nothing in mode 3
_RESET_BY_MODE = (
    "Position_P_Gain", "Position_I_Gain", "Position_D_Gain", "Feedforward_1st_Gain", "Feedforward_2nd_Gain",
    "Profile_Acceleration", "Profile_Velocity",
)  # fmt: skip


def table_of(model: str) -> dict[str, MemoryField]:
    """Return the registers of a model by name; a low limit below 0 means two's complement."""
    return {
        row["name"]: MemoryField(
            int(row["address"]),
            int(row["size"]),
            row["name"],
            row["access"],
            int(row[model]),
            TWO if row["low"].startswith("-") else None,
            row["low"],
            row["high"],
        )
        for row in ROWS
        if row["address"] and row[model]
    }


class XServo(Registers):
    """Registers of one servo, mounted ``mirrored`` with the count ``mount`` at the joint's zero."""

    def __init__(self, model: str, number: int, *, mirrored: bool = False, mount: int = COUNTS // 2) -> None:
        super().__init__(table_of(model), SIZE, number)
        self.model, self.mount, self._turn = model, mount, -1 if mirrored else 1
        self.base = 0
        """[counts] of whole turns since the power came"""
        self.awake = 0.0
        """[s] of the arm's clock from which it hears"""
        self.registered: tuple[int, bytes] | None = None
        """write that waits for an Action"""
        blocks = ((168, 208, 20),) if model.startswith("XL330") else ((168, 224, 28), (578, 634, 28))
        self._behind = {data + k: address + 2 * k for address, data, count in blocks for k in range(count)}
        """indirect addresses of indirect data"""
        for cell, place in self._behind.items():
            self._kept[place : place + 2] = cell.to_bytes(2, "little")
        self._free = {*self._behind, *(place + k for place in self._behind.values() for k in (0, 1))}
        self.cells = bytearray(self._kept)

    # --- positions --------------------------------------------------------------------------

    @property
    def sign(self) -> int:
        """Direction of the joint in its own numbers."""
        return -self._turn if self["Drive_Mode"] & 1 else self._turn

    def position(self, count: int) -> int:
        """Present position at a joint's ``count`` from its zero."""
        reverse = -1 if self["Drive_Mode"] & 1 else 1
        return self.sign * count + reverse * self.mount + self.base + self._homing

    def count(self, position: int) -> int:
        """Inverse of `position`."""
        return self.sign * (position - self.position(0))

    def wrap(self, count: int) -> None:
        """Count turns from zero again at a joint's ``count``."""
        self.base -= (self.position(count) - self._homing) // COUNTS * COUNTS

    @property
    def _homing(self) -> int:
        offset = self["Homing_Offset"]
        return 0 if self["Operating_Mode"] == POSITION and abs(offset) > _HOMED else offset

    # --- reading and writing ----------------------------------------------------------------

    def read(self, address: int, size: int) -> bytes:
        """Read ``size`` registers; zeros where none are."""
        return bytes(self.cells[self._target(cell)] for cell in range(address, address + size))

    def write(self, address: int, data: bytes) -> tuple[int, set[str]]:
        """Write registers; returns the error, and the names of what was written."""
        error, new = 0, bytearray(self.cells)
        cells = [self._target(cell) for cell in range(address, address + len(data))]
        touched = {self.at[cell].name for cell in cells if cell in self.at}
        for cell, byte in zip(cells, data, strict=True):
            new[cell] = byte
            known = self.at[cell].access != "read" if cell in self.at else cell in self._free
            if not known or (cell < RAM and self["Torque_Enable"]):
                error = ACCESS
        before, self.cells = self.cells, new
        error = error or max((self._refusal(name) for name in touched), default=0)
        if error:
            self.cells = before
            return error, set()
        self.writes.append((address, data))
        self.save(cells)
        if "Operating_Mode" in touched and new[11] != before[11]:
            self._reset(_RESET_BY_MODE)
        return 0, touched

    def cycle_power(self) -> None:
        """Power off and on, or reboot: torque off, saved registers kept, turns lost."""
        super().cycle_power()
        self._reset(())
        self["Torque_Enable"], self.registered, self.base = self["Startup_Configuration"] & 1, None, 0

    def restore(self, keep: Iterable[str]) -> None:
        """Restore what it was sold with, but for the registers ``keep``."""
        kept = {name: self[name] for name in keep}
        self._reset(self.fields)
        for name, value in kept.items():
            self[name] = value
        self.save()

    def _reset(self, names: Iterable[str]) -> None:
        for name in names:
            self[name] = self.fields[name].default
        self["Goal_PWM"] = self["PWM_Limit"]
        if "Current_Limit" in self.fields:
            self["Goal_Current"] = self["Current_Limit"]

    def _refusal(self, name: str) -> int:
        field, value = self.fields[name], self[name]
        low, high = field.low, field.high
        if name == "Operating_Mode":
            modes = {POSITION, EXTENDED, PWM, 1} | ({CURRENT, 5} if "Goal_Current" in self.fields else set())
            return 0 if value in modes else RANGE
        if name.startswith("Goal") and self["Bus_Watchdog"] == EXPIRED:
            return RANGE
        if name == "Goal_Position" and self["Operating_Mode"] == POSITION:
            low, high = "Min_Position_Limit", "Max_Position_Limit"
        if self._limit(low) <= value <= self._limit(high):
            return 0
        return LIMIT if high in self.fields else RANGE

    def _limit(self, text: str) -> int:
        if text.lstrip("-") in self.fields:
            return self[text.lstrip("-")] * (-1 if text.startswith("-") else 1)
        return int(text)

    def _target(self, cell: int) -> int:
        """Register behind an indirect one."""
        place = self._behind.get(cell)
        if place is not None:
            cell = int.from_bytes(self.cells[place : place + 2], "little")
        return min(cell, SIZE - 1)


class Fitting(NamedTuple):
    """How the servos of an arm are built in, and what its usual software leaves in them."""

    gripper: str
    first: int = 1
    """lowest ID; the others follow along the arm, the gripper's last"""
    reverse: tuple[int, ...] = ()
    """IDs with reverse drive mode"""
    homing: tuple[int, ...] = ()
    """[counts] by servo; none: 0"""
    mode: int = POSITION


FITTINGS = {
    "koch": Fitting("XL330-M288", homing=(-170, 236, -91, 340, -52, 128), mode=EXTENDED),  # LeRobot; offsets chosen
    "omx": Fitting("XM430-W350", first=11),
    "wx250s": Fitting("XC430-W150", reverse=(3, 5, 7)),
    "vx300s": Fitting("XM430-W350", reverse=(2, 4, 7)),
}
# Fields of `xseries.SETTING`: the register of each.
_SETTINGS = {
    "mode": "Operating_Mode",
    "torque_on": "Torque_Enable",
    "p": "Position_P_Gain",
    "i": "Position_I_Gain",
    "d": "Position_D_Gain",
    "feed_1": "Feedforward_1st_Gain",
    "feed_2": "Feedforward_2nd_Gain",
    "velocity_p": "Velocity_P_Gain",
    "velocity_i": "Velocity_I_Gain",
    "shutdown": "Shutdown",
    "heat_limit": "Temperature_Limit",
}
_GRIPPER = (-1.6, 0.03)  # [rad] of the Koch's jaw: MuJoCo Menagerie
_MIDDLE = COUNTS // 2  # [counts] at joint zero, of all of them


class XArm(ServoArm):
    """Servos of one arm, powered and holding."""

    plant: XPlant

    def __init__(self, plant: XPlant, gripper: XPlant, arm: Arm, *, resistance: float = 0.0) -> None:
        """``gripper``: its servo alone; ``resistance`` [ohm] of the supply."""
        super().__init__(plant, gripper, arm, resistance)
        fitting = FITTINGS[arm.name]
        self.heard = 0.0
        """[s] of the clock at the last packet"""
        self.servos: list[XServo] = []
        self.joint: list[int] = []
        """of each servo; the gripper's is behind the last"""
        self._parts = [xseries.drive_of(servo) for servo in arm.servos] + [(fitting.gripper, 1, {})]
        for joint, (model, count, gains) in enumerate(self._parts):
            own, at = (plant, joint) if joint < arm.joints else (gripper, 0)
            for k in range(count):
                self._settings.append(own.settings[0][at, k])
                self._status.append(own.status[0][at, k])
                self._add(model, fitting, joint, k, gains)
        for index in range(len(self.servos)):
            self.settle(index)

    def _add(self, model: str, fitting: Fitting, joint: int, k: int, gains: dict[str, int]) -> None:
        number = fitting.first + len(self.servos)
        homing = fitting.homing[len(self.servos)] if fitting.homing else 0
        servo = XServo(model, number, mirrored=number in fitting.reverse, mount=_MIDDLE - homing)
        known = {"Baud_Rate": 3, "Return_Delay_Time": 0, "Drive_Mode": int(number in fitting.reverse)}
        known |= {"Operating_Mode": fitting.mode, "Homing_Offset": homing}
        if k:
            known["Secondary_ID"] = number - k
        for name, value in known.items():
            servo[name] = value
        self.servos.append(servo)
        self.joint.append(joint)
        servo.wrap(0)
        index = len(self.servos) - 1
        if joint < self.arm.joints and fitting.mode == POSITION:
            span = self.arm.lower[joint], self.arm.upper[joint]
            ends = (servo.position(round(float(end) / self.arm.encoder_step)) for end in span)
            low, high = sorted(ends)
            servo["Min_Position_Limit"], servo["Max_Position_Limit"] = max(low, 0), min(high, COUNTS - 1)
        servo.save()
        servo["Torque_Enable"] = 1
        for name, value in gains.items():
            servo[f"Position_{name.upper()}_Gain"] = value
        servo.wrap(self.count(index))
        servo["Goal_Position"] = servo.position(int(self._status[index]["goal"]))

    def advance(self, duration: float) -> None:
        """Advance by [s], in whole milliseconds."""
        super().advance(duration)
        for index, servo in enumerate(self.servos):
            watch = servo["Bus_Watchdog"]
            if 0 < watch < EXPIRED and self.clock - self.heard > watch * WATCHDOG_UNIT:
                servo["Bus_Watchdog"] = EXPIRED
                servo["Goal_Position"] = servo.position(int(self._status[index]["position"]))
                servo["Goal_Velocity"] = 0
                self.settle(index)
            self._alarm(index)

    def restart(self, index: int) -> None:
        """Cycle the power of a servo, from 0, or reboot it."""
        servo, status = self.servos[index], self._status[index]
        servo.cycle_power()
        servo.wrap(self.count(index))
        servo["Goal_Position"] = servo.position(self.count(index))
        servo.awake = self.clock + BOOT
        for name in ("alarms", "blocked", "hot", "strained"):
            status[name] = 0
        self.settle(index)

    def settle(self, index: int) -> None:
        """Apply the registers of a servo, index from 0."""
        servo, setting = self.servos[index], self._settings[index]
        mode, unit, sign = servo["Operating_Mode"], NEW[servo.model].get("current_unit", 0.0), servo.sign
        current = servo["Goal_Current"] * unit if unit else 0.0
        timed = servo["Drive_Mode"] >> 2 & 1
        speed, acceleration = float(servo["Profile_Velocity"]), servo["Profile_Acceleration"]
        if not timed:
            speed = min(speed, servo["Velocity_Limit"]) * xseries.VELOCITY_UNIT
        applied = {field: servo[name] for field, name in _SETTINGS.items()} | {
            "timed": timed,
            "pwm_limit": servo["PWM_Limit"] if mode == PWM else abs(servo["Goal_PWM"]),
            "pwm_goal": sign * servo["Goal_PWM"],
            "current_goal": sign * current if mode == CURRENT else abs(current),
            "velocity_goal": sign * servo["Goal_Velocity"] * xseries.VELOCITY_UNIT,
            "speed": speed,
            "acceleration": acceleration if timed else acceleration * xseries.ACCELERATION_UNIT,
            "low_voltage": servo["Min_Voltage_Limit"] / 10,
            "high_voltage": servo["Max_Voltage_Limit"] / 10,
        }
        for name, value in applied.items():
            setting[name] = value
        goal = servo.count(servo["Goal_Position"])
        self._status[index]["goal"] = goal
        if self.joint[index] < self.arm.joints:
            self.plant.servos["goal"][0, self.joint[index]] = goal * self.arm.encoder_step

    def apply(self, index: int, address: int, data: bytes) -> int:
        """Write registers of a servo; returns the error."""
        servo = self.servos[index]
        on = servo["Torque_Enable"]
        error, touched = servo.write(address, data)
        if "Torque_Enable" in touched and self.alarms_of(index) & servo["Shutdown"]:
            servo["Torque_Enable"] = 0  # until it is rebooted
        rises = servo["Torque_Enable"] > on and servo["Operating_Mode"] == POSITION
        if rises or ("Operating_Mode" in touched and servo["Operating_Mode"] == POSITION):
            goal = servo.count(servo["Goal_Position"])
            servo.wrap(self.count(index))
            servo["Goal_Position"] = servo.position(goal)
        if touched:
            self.settle(index)
        return error

    def measure(self, index: int) -> None:
        """Write a servo's measurements to its registers."""
        servo, status, setting = self.servos[index], self._status[index], self._settings[index]
        joint, sign = self.joint[index], servo.sign
        on_arm = joint < self.arm.joints
        heat = self.temperature[joint] if on_arm else self.gripper.temperature[0, 0]
        measured: dict[str, Any] = {
            "Present_Position": servo.position(self.count(index)),
            "Present_Velocity": round(sign * status["speed"] / xseries.VELOCITY_UNIT),
            "Present_PWM": round(sign * status["output"]),
            "Present_Current": round(sign * self._current(index)),
            "Present_Input_Voltage": round(float(setting["voltage"]) * 10),
            "Present_Temperature": min(heat, 255.0),
            "Position_Trajectory": servo.position(round(float(status["reference"]))),
            "Velocity_Trajectory": round(sign * status["rate"] / xseries.VELOCITY_UNIT),
            "Realtime_Tick": int(self.clock * 1e3) % 32768,
            "Hardware_Error_Status": self.alarms_of(index),
            "Torque_Enable": setting["torque_on"],
            "Registered_Instruction": servo.registered is not None,
        }
        arrived = abs(status["goal"] - status["position"]) <= servo["Moving_Threshold"]
        fast = abs(measured["Present_Velocity"]) > servo["Moving_Threshold"]
        measured["Moving"] = bool(status["moving"]) or fast
        measured["Moving_Status"] = int(arrived) | bool(status["moving"]) << 1
        for name, value in measured.items():
            servo[name] = int(value)

    def alarms_of(self, index: int) -> int:
        """Hardware errors of a servo."""
        own, joint = int(self._status[index]["alarms"]), self.joint[index]
        told = int(self.alarms[joint]) if joint < self.arm.joints else 0
        return own | told & ~BITS["current"] | SHOCK * bool(told & BITS["current"])

    def count(self, index: int) -> int:
        """Count of a servo from its joint's zero, as its encoder tells it."""
        joint = self.joint[index]
        if joint < self.arm.joints:
            return round(float(self.angles[joint]) / self.arm.encoder_step)
        return int(self.gripper.status["position"][0, 0, 0])

    def _alarm(self, index: int) -> None:
        """Let an error trip the servo, which stays without torque."""
        servo, setting, status = self.servos[index], self._settings[index], self._status[index]
        status["alarms"] |= self.alarms_of(index)
        if setting["torque_on"] and status["alarms"] & servo["Shutdown"]:
            setting["torque_on"] = 0
        if not setting["torque_on"]:
            servo["Torque_Enable"] = 0

    def _current(self, index: int) -> float:
        """Present current in the unit of its register, or the load [0.1 %]."""
        servo, status, joint = self.servos[index], self._status[index], self.joint[index]
        unit = NEW[servo.model].get("current_unit")
        if unit is None:
            return 1000.0 * float(status["output"]) / xseries.FULL
        least = self.least_current[joint] if joint < self.arm.joints else 0.0
        current = float(status["current"])
        return float(np.copysign(max(abs(current), least), current)) / unit


def build_arm(arm: Arm, wear_name: str, *, seed: int = 0, resistance: float = 0.0) -> XArm:
    """Arm with the wear profile ``wear_name`` behind its servos, at rest; the gripper's is worn as the last joint's."""
    wear, servo = load_wear(wear_name, arm), FITTINGS[arm.name].gripper
    gripper = alone(arm, wear, np.array(_GRIPPER), XPlant, servo, seed)
    built = XArm(XPlant(arm, [wear], seed=seed), gripper, arm, resistance=resistance)
    built.advance(0.01)  # compiles the plant now instead of during the first request
    return built


DELAY_UNIT, TURN = 2e-6, 20e-6
"""[s] of the return delay register; least pause before an answer (chosen)"""


_READS = frozenset({SYNC_READ, FAST_SYNC_READ, BULK_READ, FAST_BULK_READ})


class XBus(EmulatedBus):
    """Servos of X arms on their wire."""

    rates = (9600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
    arm: XArm

    def execute(self, request: Packet) -> list[Answer]:
        """Execute a packet; returns the answers in order of time."""
        self.arm.heard = self.arm.clock
        hearing = [(index, servo) for index, servo in self.hearing() if servo.awake <= self.arm.clock]
        code, data = request.code, request.parameters
        if code in (SYNC_WRITE, BULK_WRITE):
            for part in _parts(code, data):
                for index, servo in hearing:
                    if part.number in (servo.number, servo["Secondary_ID"]):
                        self._write(index, part.number, part.address, part.data)
            return []
        if code in _READS:
            asked = [
                ([index for index, servo in hearing if servo.number == part.number], part)
                for part in _parts(code, data)
            ]
            return (self._chain if code in (FAST_SYNC_READ, FAST_BULK_READ) else self._row)(asked)
        answers = []
        for index, servo in sorted(hearing, key=lambda pair: pair[1].number):
            if request.id in (BROADCAST, servo.number, servo["Secondary_ID"]):
                found = self._obey(index, request)
                if found is not None and request.id in (BROADCAST, servo.number):
                    slot = servo.number * (14 * self.byte + TURN) if request.id == BROADCAST else 0.0
                    answers.append(self._status(index, slot, *found))
        return answers

    def _obey(self, index: int, request: Packet) -> tuple[int, bytes] | None:
        """Error and data of the answer; None: none."""
        servo, code, data = self.arm.servos[index], request.code, request.parameters
        shadow = request.id != BROADCAST and request.id != servo.number
        if code == PING:
            return 0, servo.read(0, 2) + servo.read(6, 1)
        if code == READ:
            if request.id == BROADCAST or servo["Status_Return_Level"] < 1 or shadow:
                return None
            if len(data) != 4:
                return LENGTH, b""
            return self._read(index, *_words(data))
        error = self._do(index, request, shadow)
        answers = servo["Status_Return_Level"] == 2 and request.id != BROADCAST
        return (error, b"") if answers else None

    def _do(self, index: int, request: Packet, shadow: bool) -> int:
        servo, code, data = self.arm.servos[index], request.code, request.parameters
        if code in (WRITE, REG_WRITE):
            if len(data) < 3:
                return LENGTH
            address = int.from_bytes(data[:2], "little")
            if code == REG_WRITE:
                servo.registered = address, data[2:]
                return 0
            return self._write(index, servo["Secondary_ID"] if shadow else servo.number, address, data[2:])
        if code == ACTION:
            waiting, servo.registered = servo.registered, None
            return self.arm.apply(index, *waiting) if waiting else 0
        if code == REBOOT:
            self.arm.restart(index)
        elif code == FACTORY_RESET and data in (b"\xff", b"\x01", b"\x02"):
            servo.restore(() if data == b"\xff" else ("ID",) if data == b"\x01" else ("ID", "Baud_Rate"))
            self.arm.restart(index)
        elif code == CLEAR and data == _CLEAR:
            if self.arm._status[index]["moving"]:
                return FAILED
            servo.wrap(self.arm.count(index))
            self.arm.settle(index)
        else:
            return UNKNOWN
        return 0

    def _write(self, index: int, number: int, address: int, data: bytes) -> int:
        if number != self.arm.servos[index].number and address < RAM:
            return ACCESS  # a shadow's own area is its own
        return self.arm.apply(index, address, data)

    def _read(self, index: int, address: int, size: int) -> tuple[int, bytes]:
        if not size or address + size > SIZE:
            return (ACCESS if size else LENGTH), b""
        self.arm.measure(index)
        return 0, self.arm.servos[index].read(address, size)

    def _error(self, index: int, error: int) -> int:
        return error | ALERT * bool(self.arm.alarms_of(index))

    def _delay(self, index: int) -> float:
        return max(TURN, self.arm.servos[index]["Return_Delay_Time"] * DELAY_UNIT)

    def _status(self, index: int, slot: float, error: int, data: bytes) -> Answer:
        frame = encode(Packet(self.arm.servos[index].number, STATUS, bytes([self._error(index, error)]) + data))
        return Answer(index, slot + self._delay(index) + len(frame) * self.byte, frame)

    def _row(self, asked: list[tuple[list[int], Part]]) -> list[Answer]:
        """Answers one after the other; the slot of a silent servo passes (chosen)."""
        answers, begun = list[Answer](), 0.0
        for servos, part in asked:
            mine = [self._status(index, begun, *self._read(index, part.address, part.size)) for index in servos]
            answers += mine
            begun = mine[0].after if mine else begun + (part.size + 11) * self.byte
        return answers

    def _chain(self, asked: list[tuple[list[int], Part]]) -> list[Answer]:
        """Return the one answer of a fast read, which breaks off before a silent servo; not stuffed."""
        length = 1 + sum(part.size + 4 for _, part in asked)
        heard = list(takewhile(lambda one: one[0], asked))
        if not heard or length > _MOST:
            return []
        frame = HEADER + bytes([0, BROADCAST]) + length.to_bytes(2, "little") + bytes([STATUS])
        for (index, *_), part in heard:
            error, data = self._read(index, part.address, part.size)
            frame += bytes([self._error(index, error), self.arm.servos[index].number]) + data
            frame += crc(frame)
        return [Answer(heard[-1][0][0], self._delay(heard[0][0][0]) + len(frame) * self.byte, frame)]


class Part(NamedTuple):
    """What a packet to several servos asks of one."""

    number: int
    """ID"""
    address: int
    size: int
    data: bytes
    """to write"""


def _parts(code: int, data: bytes) -> list[Part]:
    """Parts of a sync or bulk packet; one of bulk packets has an address and a size of its own."""
    head = b"" if code in (BULK_READ, BULK_WRITE, FAST_BULK_READ) else data[:4]
    found, place = list[Part](), len(head)
    while place + 5 - len(head) <= len(data):
        start = place + 5 - len(head)
        address, size = _words(head or data[place + 1 : start])
        end = start + size * (code in (SYNC_WRITE, BULK_WRITE))
        if end <= len(data):
            found.append(Part(data[place], address, size, data[start:end]))
        place = end
    return found


def _words(data: bytes) -> tuple[int, ...]:
    return tuple(int.from_bytes(data[k : k + 2], "little") for k in range(0, len(data), 2))


class XSession(BusSession):
    """Servos of ``arm`` for one client at a time, with timing."""

    scheme = "dynamixel"
    reading = _READS | {READ}

    def __init__(self, arm: XArm, **options: Any) -> None:  # noqa: ANN401
        super().__init__(XBus(arm), **options)

    def _finder(self) -> Finder[Packet]:
        return finder()

    def _bytes_of(self, request: Packet) -> bytes:
        return encode(request)
