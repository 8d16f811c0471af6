"""An SO-101 behind the bus of its servos: packets, registers and timing.

Sources: Feetech's protocol manual and memory table of the STS/SMS series (in
``plant/sts3215.csv`` with LeRobot's names), and recorded LeRobot packets.
"""

import struct
from typing import Any

import numpy as np

from rejoint.robots.wireserver import Format
from rejoint_lab.emulator.servobus import (
    BROADCAST,
    PING,
    READ,
    WRITE,
    Answer,
    Packet,
    Part,
    Registers,
    ServoArm,
    registers_of,
)
from rejoint_lab.plant import sts3215
from rejoint_lab.plant.plant import StsPlant
from rejoint_lab.plant.sts3215 import COUNTS

SIZE = 88
"""[bytes] (chosen: the last known register is 86)"""
TABLE = registers_of(sts3215.TABLE, "STS3215")


HEADER = b"\xff\xff"
MOST_PARAMETERS = 248
"""per packet: clients cap packets at 250 bytes"""


def checksum(body: bytes) -> int:
    """Last byte of a packet of ID, length, code and parameters."""
    return ~sum(body) & 0xFF


def encode(packet: Packet) -> bytes:
    """Bytes of a packet."""
    body = bytes((packet.id, len(packet.parameters) + 2, packet.code)) + packet.parameters
    return HEADER + body + bytes((checksum(body),))


def _size(head: bytes) -> int:
    return head[3] + 4 if head[2] != 0xFF and 2 <= head[3] <= MOST_PARAMETERS + 2 else 0


def _read(data: bytes) -> Packet | None:
    return Packet(data[2], data[4], data[5:-1]) if checksum(data[2:-1]) == data[-1] else None


FORMAT = Format(HEADER, 4, _size, _read, encode)


MIDDLE = COUNTS // 2
"""[counts] at joint zero"""


class Servo(Registers):
    """Registers of one servo; its arm updates measured ones."""

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


HOMING = (-1470, 63, 911, -388, 85, -1021)
"""[counts] (chosen: like real arms)"""
PROMPT = 254
"""[100 counts/s^2] as LeRobot sets it"""
CURRENT_UNIT = 0.0065
"""[A] per count"""


MOST_DATA = 128
"""[bytes] buffer of a servo"""
SLOT = 9
"""[bytes] of an answer without data, with those between it and the next (the firmware's own sum)"""


class StsArm(ServoArm[Servo]):
    """Six servos of one arm on their wire, powered and holding."""

    kind, table, jaw = StsPlant, sts3215.TABLE, (-0.17, 1.75)  # so101_new_calib.xml
    gripper_model = staticmethod(lambda arm: arm.servos[-1])
    scheme, wire_format, words, ping_bytes = "feetech", FORMAT, struct.Struct("<BB"), SLOT
    rates = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)

    def _fit(self, records: list[tuple[Any, Any]]) -> None:
        pairs = [*zip(self.arm.lower, self.arm.upper, strict=True), self.jaw]
        ends = (MIDDLE + np.rint(np.array(pairs) / self.arm.encoder_step)).astype(int).tolist()
        ends[-2] = 0, COUNTS - 1  # as LeRobot's calibration says: the wrist may turn fully
        for joint, (record, homing, limits) in enumerate(zip(records, HOMING, ends, strict=True)):
            servo = Servo(TABLE, SIZE, joint + 1)
            self.servos.append(servo)
            servo.joint, (servo.setting, servo.status) = joint, record
            servo["Homing_Offset"], servo["Torque_Enable"] = homing, 1
            servo["Acceleration"] = servo["Maximum_Acceleration"] = PROMPT
            servo["Min_Position_Limit"], servo["Max_Position_Limit"] = limits
            servo.save()
            self.settle(servo)

    def go(self, servo: Servo) -> None:
        """Apply a servo's goal, and its torque."""
        servo.setting["torque_on"] = servo["Torque_Enable"]
        self._aim(servo, servo["Goal_Position"] + _shift(servo))

    def restart(self, servo: Servo) -> None:
        """Cycle the power of a servo."""
        servo.cycle_power()
        self.settle(servo)

    def settle(self, servo: Servo) -> None:
        """Apply the registers of a servo."""
        super().settle(servo)
        setting = servo.setting
        low, high = servo["Min_Position_Limit"], servo["Max_Position_Limit"]
        shift = _shift(servo) if low != high else 0
        acceleration = servo["Acceleration"] or servo["Maximum_Acceleration"] * servo["Acceleration_Multiplier"]
        setting["least"], setting["most"] = low + shift, high + shift
        setting["acceleration"] = 100.0 * max(acceleration, 1)
        setting["speed"] = abs(servo["Goal_Velocity"]) or 50 * servo["Maximum_Velocity_Limit"]

    def measure(self, servo: Servo) -> None:
        """Write a servo's measurements to its registers."""
        status, setting, shift = servo.status, servo.setting, _shift(servo)
        servo.update(
            {
                "Present_Position": (self.count(servo) - shift) % COUNTS,
                "Present_Velocity": np.clip(status["speed"], -32767, 32767),
                "Present_Load": np.clip(status["output"], -1023, 1023),
                "Present_Voltage": round(setting["voltage"] * 10),
                "Present_Temperature": self._heat(servo),
                "Status": self.alarms_of(servo),
                "Moving": status["moving"],
                "Goal_In_Force": np.clip(status["goal"] - shift, -32767, 32767),
                "Present_Current": round(self._current(servo) / CURRENT_UNIT),
                "Torque_Enable": setting["torque_on"],  # over-current switches it off
            }
        )

    # --- the wire ---------------------------------------------------------------------------

    def _row(self, code: int, asked: list[tuple[list[Servo], Part]]) -> list[Answer]:  # noqa: ARG002 - there is one
        return [
            self._answer(servo, place * (part.size + SLOT) * self.byte, *self._read(servo, part.address, part.size))
            for place, (servos, part) in enumerate(asked)
            for servo in servos
        ]

    def _read(self, servo: Servo, address: int, size: int) -> tuple[int, bytes]:
        self.measure(servo)
        return 0, servo.read(address, min(size, MOST_DATA))

    def _obey(self, servo: Servo, request: Packet) -> tuple[int, bytes] | None:
        data = request.parameters
        if request.code == PING:
            return 0, b""
        if request.code == READ and len(data) == self.words.size and request.id != BROADCAST:
            return self._read(servo, *data)
        if request.code != WRITE or len(data) < self.words.size:
            return None
        answers = servo["Response_Status_Level"] != 0 and request.id != BROADCAST
        error = self._write(servo, False, data[0], data[1:])
        return (error, b"") if answers else None

    def _write(self, servo: Servo, shadow: bool, address: int, data: bytes) -> int:  # noqa: ARG002 - there are none
        touched = servo.write(address, data)
        if touched - {"Goal_Position"}:
            self.settle(servo)
        if "Goal_Position" in touched:
            self.go(servo)
        return 0

    def _status(self, servo: Servo, error: int, data: bytes) -> Packet:
        return Packet(servo.number, error | self.alarms_of(servo), data)


def _shift(servo: Servo) -> int:
    return servo["Homing_Offset"] - HOMING[servo.joint] - MIDDLE
