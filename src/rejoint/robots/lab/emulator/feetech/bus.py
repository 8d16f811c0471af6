"""What the servos of a bus answer to a packet, and when: each in its own slot of time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from rejoint.robots.lab.emulator.feetech import packets
from rejoint.robots.lab.emulator.feetech.arm import ServoArm
from rejoint.robots.lab.emulator.feetech.packets import BROADCAST, Packet, encode

BYTE = 10e-6
"""[s] on the wire at 1 Mbaud, 8N1"""
TURN = 20e-6
"""[s] least pause before a servo answers (chosen: the least that was seen)"""
DELAY_UNIT = 2e-6
"""[s] of the return delay register"""
MOST_DATA = 128
"""bytes that a servo takes or gives at once: its buffer"""
_BETWEEN = 3
"""[bytes] between the slots of a synchronous read, beside the answer (the firmware's own sum)"""
MAKE_MIDDLE = 128
"""What turns a write to Torque_Enable into "here is the middle"."""
_WORD = 2


class Answer(NamedTuple):
    """A status packet on its way back."""

    servo: int
    """index, from 0"""
    after: float
    """[s] from the end of the request to the end of the answer"""
    data: bytes


class ServoBus:
    """The servos of ``arm`` on their wire. ``muted`` names those, from 0, that neither hear nor answer now."""

    def __init__(self, arm: ServoArm) -> None:
        self.arm = arm
        self.muted: Callable[[], Iterable[int]] = lambda: ()

    def execute(self, request: Packet) -> list[Answer]:
        """Obey a packet; returns what the servos answer, in the order of time. What is no order is ignored."""
        hearing = [i for i in range(len(self.arm.servos)) if i not in set(self.muted())]
        if request.code == packets.SYNC_READ:
            return self._sync_read(request, hearing)
        if request.code == packets.SYNC_WRITE:
            self._sync_write(request, hearing)
            return []
        addressed = [i for i in hearing if request.id in (BROADCAST, self.arm.servos[i].number)]
        if request.id == BROADCAST and request.code != packets.PING:
            for index in addressed:
                self._obey(index, request)
            return []
        answers = []
        for index in addressed:
            number = self.arm.servos[index].number
            found = self._obey(index, request)
            if found is not None:
                slot = number * (_BETWEEN + 6) * BYTE if request.id == BROADCAST else 0.0
                answers.append(self._status(index, found, slot, number=number))
        return answers

    def _obey(self, index: int, request: Packet) -> bytes | None:
        """Obey an order to one servo; returns the data of its answer, None where it answers nothing."""
        servo, data = self.arm.servos[index], request.parameters
        if request.code == packets.PING:
            return b""
        if request.code == packets.READ and len(data) == _WORD:
            self.arm.measure(index)
            return servo.read(data[0], min(data[1], MOST_DATA))
        orders: dict[int, Callable[[], object]] = {
            packets.WRITE: lambda: self._write(index, servo.write(data[0], data[1:])),
            packets.REG_WRITE: lambda: servo.put_off(data[0], data[1:]),
            packets.ACTION: lambda: self._write(index, servo.act()),
            packets.RESET: lambda: self.arm.reset(index),
            packets.CALIBRATE: lambda: self.arm.centre(index, *_words(data)),
        }
        if request.code not in orders or (request.code in (packets.WRITE, packets.REG_WRITE) and len(data) < _WORD):
            return None
        answers = servo["Response_Status_Level"] != 0
        orders[request.code]()
        return b"" if answers else None

    def _write(self, index: int, touched: set[str]) -> None:
        """Let a servo act on registers that were written."""
        if self.arm.servos[index]["Torque_Enable"] == MAKE_MIDDLE:
            self.arm.servos[index]["Torque_Enable"] = 1
            self.arm.centre(index)
        if touched - {"Goal_Position"}:
            self.arm.settle(index)
        if "Goal_Position" in touched:
            self.arm.go(index)

    def _sync_read(self, request: Packet, hearing: list[int]) -> list[Answer]:
        """Every servo named answers in its slot, whether or not those before it do."""
        if len(request.parameters) < _WORD + 1:
            return []
        address, size, *numbers = request.parameters
        answers = []
        for place, number in enumerate(numbers):
            for index in hearing:
                if self.arm.servos[index].number == number:
                    self.arm.measure(index)
                    data = self.arm.servos[index].read(address, min(size, MOST_DATA))
                    answers.append(self._status(index, data, place * (size + 6 + _BETWEEN) * BYTE))
        return answers

    def _sync_write(self, request: Packet, hearing: list[int]) -> None:
        if len(request.parameters) < _WORD:
            return
        address, size = request.parameters[:2]
        rest = request.parameters[2:]
        by_number = {self.arm.servos[i].number: i for i in hearing}
        for start in range(0, len(rest) - size, size + 1):
            index = by_number.get(rest[start])
            if index is not None and size:
                self._write(index, self.arm.servos[index].write(address, rest[start + 1 : start + 1 + size]))

    def _status(self, index: int, data: bytes, slot: float, number: int | None = None) -> Answer:
        servo = self.arm.servos[index]
        frame = encode(Packet(servo.number if number is None else number, self.arm.alarms(index), data))
        delay = max(TURN, servo["Return_Delay_Time"] * DELAY_UNIT)
        return Answer(index, slot + delay + len(frame) * BYTE, frame)


def _words(data: bytes) -> tuple[int, ...]:
    return (int.from_bytes(data, "little"),) if len(data) == _WORD else ()
