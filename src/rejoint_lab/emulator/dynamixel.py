"""Arms on ROBOTIS' X series behind their bus: Protocol 2.0, registers, errors and timing.

Sources: ROBOTIS' e-manual (protocol 2, control tables); LeRobot, Interbotix and ROBOTIS' open_manipulator (what their
software leaves in the servos). Where the manual is silent, a comment says what was chosen.
"""

import struct
from collections.abc import Iterable
from itertools import takewhile
from typing import Any

import msgspec

from rejoint.robots.wireserver import Format
from rejoint.system.files import read_shipped
from rejoint_lab.emulator.faults import BITS
from rejoint_lab.emulator.servobus import (
    BROADCAST,
    PING,
    READ,
    SYNC_READ,
    SYNC_WRITE,
    TURN,
    WRITE,
    Answer,
    Packet,
    Part,
    Registers,
    ServoArm,
    registers_of,
)
from rejoint_lab.plant import xseries
from rejoint_lab.plant.plant import XPlant
from rejoint_lab.plant.xseries import COUNTS, CURRENT, EXTENDED, NEW, POSITION, PWM, SHOCK

HEADER = b"\xff\xff\xfd"
REG_WRITE, ACTION, REBOOT, STATUS = 4, 5, 8, 0x55
FAST_SYNC_READ, BULK_READ, BULK_WRITE, FAST_BULK_READ = 0x8A, 0x92, 0x93, 0x9A
UNKNOWN, RANGE, LENGTH, LIMIT, ACCESS = 2, 4, 5, 6, 7
"""Numbers of errors"""
ALERT = 0x80
_MOST = 1024  # [bytes] of a packet, as ROBOTIS' client takes them


def crc(data: bytes) -> bytes:
    """CRC-16 of a packet: polynomial 0x8005."""
    found = 0
    for byte in data:
        found ^= byte << 8
        for _ in range(8):
            found = found << 1 ^ (0x18005 if found & 0x8000 else 0)
    return found.to_bytes(2, "little")


def encode(packet: Packet) -> bytes:
    """Bytes of a packet, stuffed."""
    body = (bytes([packet.code]) + packet.parameters).replace(HEADER, HEADER + b"\xfd")
    data = HEADER + bytes([0, packet.id]) + (len(body) + 2).to_bytes(2, "little") + body
    return data + crc(data)


def _size(head: bytes) -> int:
    size = 7 + int.from_bytes(head[5:7], "little")
    return size if head[3] == 0 and 10 <= size <= _MOST else 0


def _read(data: bytes) -> Packet | None:
    if crc(data[:-2]) != data[-2:]:
        return None
    body = data[7:-2].replace(HEADER + b"\xfd", HEADER)
    return Packet(data[4], body[0], body[1:])


FORMAT = Format(HEADER, 7, _size, _read, encode)

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


class XServo(Registers):
    """Registers of one servo, mounted ``mirrored`` with the count ``mount`` at the joint's zero."""

    def __init__(self, model: str, number: int, *, mirrored: bool, mount: int) -> None:
        super().__init__(registers_of(xseries.TABLE, model), SIZE, number)
        self.model, self.mount, self._turn = model, mount, -1 if mirrored else 1
        self.base = 0
        """[counts] of whole turns since the power came"""
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
        return self.sign * (count + self._turn * self.mount) + self.base + self._homing

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

    def _reset(self, names: Iterable[str]) -> None:
        self.update({name: self.fields[name].default for name in names})
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


class Fitting(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How an arm's servos are built in, and left by its usual software."""

    gripper: str
    first: int = 1
    reverse: tuple[int, ...] = ()
    homing: tuple[int, ...] = ()
    mode: int = POSITION


FITTINGS = read_shipped(__file__, "fittings.toml", dict[str, Fitting])
_MIDDLE = COUNTS // 2  # [counts] at joint zero, of all of them


class XArm(ServoArm[XServo]):
    """Servos of one arm on their wire, powered and holding."""

    kind, table, jaw = XPlant, xseries.TABLE, (-1.6, 0.03)  # the Koch's: MuJoCo Menagerie
    gripper_model = staticmethod(lambda arm: FITTINGS[arm.name].gripper)
    scheme, wire_format, words, ping_bytes, ping_pause = "dynamixel", FORMAT, struct.Struct("<HH"), 14, TURN
    rates = (9600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
    reads = frozenset({SYNC_READ, FAST_SYNC_READ, BULK_READ, FAST_BULK_READ})
    writes = frozenset({SYNC_WRITE, BULK_WRITE})
    bulk = frozenset({BULK_READ, BULK_WRITE, FAST_BULK_READ})

    def _fit(self, records: list[tuple[Any, Any]]) -> None:
        fitting = FITTINGS[self.arm.name]
        for joint, described in enumerate((*self.arm.servos, fitting.gripper)):
            model, count, gains = xseries.drive_of(described)
            for k in range(count):
                number = fitting.first + len(self.servos)
                homing = fitting.homing[len(self.servos)] if fitting.homing else 0
                servo = XServo(model, number, mirrored=number in fitting.reverse, mount=_MIDDLE - homing)
                servo.update({"Baud_Rate": 3, "Return_Delay_Time": 0, "Drive_Mode": number in fitting.reverse})
                servo.update({"Operating_Mode": fitting.mode, "Homing_Offset": homing})
                if k:
                    servo["Secondary_ID"] = number - k
                servo.joint, (servo.setting, servo.status) = joint, (record[k] for record in records[joint])
                self.servos.append(servo)
                servo.wrap(0)
                if joint < self.arm.joints and fitting.mode == POSITION:
                    span = self.arm.lower[joint], self.arm.upper[joint]
                    low, high = sorted(servo.position(round(end / self.arm.encoder_step)) for end in span)
                    servo["Min_Position_Limit"], servo["Max_Position_Limit"] = max(low, 0), min(high, COUNTS - 1)
                servo.save()
                servo["Torque_Enable"] = 1
                servo.update({f"Position_{name.upper()}_Gain": value for name, value in gains.items()})
                servo.wrap(self.count(servo))
                servo["Goal_Position"] = servo.position(int(servo.status["goal"]))
                self.settle(servo)

    def advance(self, duration: float) -> None:
        """Advance by [s], in whole milliseconds."""
        super().advance(duration)
        for servo in self.servos:
            watch = servo["Bus_Watchdog"]
            if 0 < watch < EXPIRED and self.clock - self.heard > watch * WATCHDOG_UNIT:
                servo["Bus_Watchdog"] = EXPIRED
                servo["Goal_Position"] = servo.position(int(servo.status["position"]))
                servo["Goal_Velocity"] = 0
                self.settle(servo)
            servo.status["alarms"] |= self.alarms_of(servo)
            if servo.status["alarms"] & servo["Shutdown"]:  # it stays without torque
                servo.setting["torque_on"] = 0
            if not servo.setting["torque_on"]:
                servo["Torque_Enable"] = 0

    def restart(self, servo: XServo) -> None:
        """Cycle the power of a servo, or reboot it."""
        for name in ("alarms", "blocked", "hot", "strained"):
            servo.status[name] = 0
        servo.cycle_power()
        servo.wrap(self.count(servo))
        servo["Goal_Position"] = servo.position(self.count(servo))
        servo.awake = self.clock + BOOT
        self.settle(servo)

    def settle(self, servo: XServo) -> None:
        """Apply the registers of a servo."""
        super().settle(servo)
        mode, sign, timed = servo["Operating_Mode"], servo.sign, servo["Drive_Mode"] >> 2 & 1
        unit = NEW[servo.model].get("current_unit")
        current = servo["Goal_Current"] * unit if unit else 0.0
        speed, acceleration = float(servo["Profile_Velocity"]), servo["Profile_Acceleration"]
        if not timed:
            speed = min(speed, servo["Velocity_Limit"]) * xseries.VELOCITY_UNIT
        applied = {
            "timed": timed,
            "limit": servo["PWM_Limit"] if mode == PWM else abs(servo["Goal_PWM"]),
            "pwm_goal": sign * servo["Goal_PWM"],
            "current_goal": sign * current if mode == CURRENT else abs(current),
            "velocity_goal": sign * servo["Goal_Velocity"] * xseries.VELOCITY_UNIT,
            "speed": speed,
            "acceleration": acceleration if timed else acceleration * xseries.ACCELERATION_UNIT,
        }
        for name, value in applied.items():
            servo.setting[name] = value
        self._aim(servo, servo.count(servo["Goal_Position"]))

    def alarms_of(self, servo: XServo) -> int:
        """Hardware errors of a servo."""
        own, told = int(servo.status["alarms"]), int(self._of_joint(servo, self.alarms, 0))
        return own | told & ~BITS["current"] | SHOCK * bool(told & BITS["current"])

    def measure(self, servo: XServo) -> None:
        """Write a servo's measurements to its registers."""
        status, sign, threshold = servo.status, servo.sign, servo["Moving_Threshold"]
        moving = bool(status["moving"])
        speed, unit = round(sign * status["speed"] / xseries.VELOCITY_UNIT), NEW[servo.model].get("current_unit")
        load = self._current(servo) / unit if unit else 1000.0 * status["output"] / xseries.FULL  # or [0.1 %]
        arrived = bool(abs(status["goal"] - status["position"]) <= threshold)
        servo.update(
            {
                "Present_Position": servo.position(self.count(servo)),
                "Present_Velocity": speed,
                "Present_PWM": round(sign * status["output"]),
                "Present_Current": round(sign * load),
                "Present_Input_Voltage": round(servo.setting["voltage"] * 10),
                "Present_Temperature": self._heat(servo),
                "Position_Trajectory": servo.position(round(status["reference"])),
                "Velocity_Trajectory": round(sign * status["rate"] / xseries.VELOCITY_UNIT),
                "Realtime_Tick": int(self.clock * 1e3) % 32768,
                "Hardware_Error_Status": self.alarms_of(servo),
                "Torque_Enable": servo.setting["torque_on"],
                "Registered_Instruction": servo.registered is not None,
                "Moving": moving or abs(speed) > threshold,
                "Moving_Status": arrived | moving << 1,
            }
        )

    # --- the wire ---------------------------------------------------------------------------

    def _numbers(self, servo: XServo) -> tuple[int, ...]:
        return servo.number, servo["Secondary_ID"]

    def _obey(self, servo: XServo, request: Packet) -> tuple[int, bytes] | None:
        code, data = request.code, request.parameters
        shadow = request.id != BROADCAST and request.id != servo.number
        if code == PING:
            return 0, servo.read(0, 2) + servo.read(6, 1)
        if code == READ:
            if request.id == BROADCAST or servo["Status_Return_Level"] < 1 or shadow:
                return None
            if len(data) != 4:
                return LENGTH, b""
            return self._read(servo, *self.words.unpack(data))
        error = self._do(servo, request, shadow)
        answers = servo["Status_Return_Level"] == 2 and request.id != BROADCAST
        return (error, b"") if answers else None

    def _do(self, servo: XServo, request: Packet, shadow: bool) -> int:
        code, data = request.code, request.parameters
        if code in (WRITE, REG_WRITE):
            if len(data) < 3:
                return LENGTH
            address = int.from_bytes(data[:2], "little")
            if code == REG_WRITE:
                servo.registered = address, data[2:]
                return 0
            return self._write(servo, shadow, address, data[2:])
        if code == ACTION:
            waiting, servo.registered = servo.registered, None
            return self._write(servo, False, *waiting) if waiting else 0
        if code != REBOOT:
            return UNKNOWN
        self.restart(servo)
        return 0

    def _write(self, servo: XServo, shadow: bool, address: int, data: bytes) -> int:
        if shadow and address < RAM:
            return ACCESS  # a shadow's own area is its own
        on = servo["Torque_Enable"]
        error, touched = servo.write(address, data)
        if "Torque_Enable" in touched and self.alarms_of(servo) & servo["Shutdown"]:
            servo["Torque_Enable"] = 0  # until it is rebooted
        rises = servo["Torque_Enable"] > on and servo["Operating_Mode"] == POSITION
        if rises or ("Operating_Mode" in touched and servo["Operating_Mode"] == POSITION):
            goal = servo.count(servo["Goal_Position"])
            servo.wrap(self.count(servo))
            servo["Goal_Position"] = servo.position(goal)
        if touched:
            self.settle(servo)
        return error

    def _read(self, servo: XServo, address: int, size: int) -> tuple[int, bytes]:
        if not size or address + size > SIZE:
            return (ACCESS if size else LENGTH), b""
        self.measure(servo)
        return 0, servo.read(address, size)

    def _error(self, servo: XServo, error: int) -> int:
        return error | ALERT * bool(self.alarms_of(servo))

    def _status(self, servo: XServo, error: int, data: bytes) -> Packet:
        return Packet(servo.number, STATUS, bytes([self._error(servo, error)]) + data)

    def _row(self, code: int, asked: list[tuple[list[XServo], Part]]) -> list[Answer]:
        """Answers one after the other; the slot of a silent servo passes (chosen)."""
        if code in (FAST_SYNC_READ, FAST_BULK_READ):
            return self._chain(asked)
        answers, begun = list[Answer](), 0.0
        for servos, part in asked:
            mine = [self._answer(servo, begun, *self._read(servo, part.address, part.size)) for servo in servos]
            answers += mine
            begun = mine[0].after if mine else begun + (part.size + 11) * self.byte
        return answers

    def _chain(self, asked: list[tuple[list[XServo], Part]]) -> list[Answer]:
        """Return the one answer of a fast read, which breaks off before a silent servo; not stuffed."""
        length = 1 + sum(part.size + 4 for _, part in asked)
        heard = list(takewhile(lambda one: one[0], asked))
        if not heard or length > _MOST:
            return []
        frame = HEADER + bytes([0, BROADCAST]) + length.to_bytes(2, "little") + bytes([STATUS])
        for (servo, *_), part in heard:
            error, data = self._read(servo, part.address, part.size)
            frame += bytes([self._error(servo, error), servo.number]) + data
            frame += crc(frame)
        return [Answer(self._delay(heard[0][0][0]) + len(frame) * self.byte, frame)]
