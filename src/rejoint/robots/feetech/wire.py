"""The client `ftservo-python-sdk` on any port of pyserial, and counts in radians.

A joint is at zero in mid-range, as in LeRobot's degrees, or at the address's ``zero``.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from select import select
from typing import NamedTuple

import numpy as np
import serial
from numpy.typing import NDArray
from scservo_sdk import (
    COMM_PORT_BUSY,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    COMM_TX_FAIL,
    INST_READ,
    PKT_ERROR,
    PKT_ID,
    PKT_PARAMETER0,
    GroupSyncRead,
    PortHandler,
    sms_sts,
)

from rejoint.arms import Arm, Array
from rejoint.logs.joints import COUNTS_PER_TURN, match_joints, read_homing
from rejoint.robots.bus import Reading
from rejoint.robots.family import SerialAddress, TcpAddress
from rejoint.robots.feetech.gains import DutyLaw
from rejoint.system.errors import InputError, RobotError

FRAME = 6
"""[bytes] around the data: header, ID, length, errors, checksum"""
MODEL = 3
"""Register address of the model"""
CONNECT = 5.0
"""[s] (chosen, as pyserial does)"""
WAIT = 0.02
"""[s] of one wait for bytes (chosen)"""


class _Port(PortHandler):  # type: ignore[misc]  # the maker's package has no types
    is_using = property(lambda _: False, lambda *_: None)  # one thread at a time uses it

    def setupPort(self, _rate: int) -> bool:  # noqa: N802 - the maker's name
        """Open; OSError."""
        place = self.port_name
        try:
            if isinstance(place, TcpAddress):
                self.ser = socket.create_connection((place.host, place.port), CONNECT)
                self.ser.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # small packets do not wait
            else:
                self.ser = serial.Serial(place.device, baudrate=self.baudrate, exclusive=True)
        except serial.SerialException as error:
            if error.errno != errno.EWOULDBLOCK:
                raise
            raise OSError("another program drives the arm there; end it first") from error
        self._descriptor: int = self.ser.fileno()
        self.is_open = True
        self.tx_time_per_byte = (1000.0 / self.baudrate) * 10.0
        return True

    def readPort(self, length: int, wait: float = WAIT) -> bytes:  # noqa: N802 - the maker's name
        """Return what comes within ``wait`` [s]; OSError."""
        if length <= 0:  # as the client asks behind a packet that says it is shorter than any
            return b""
        if not select([self._descriptor], [], [], wait)[0]:
            return b""
        data = os.read(self._descriptor, length)
        if not data:
            raise OSError("the port is gone")
        return data

    def clearPort(self) -> None:  # noqa: N802 - the maker's name
        """Drop the buffer."""
        while self.readPort(4096, 0.0):
            pass

    def writePort(self, packet: Sequence[int]) -> int:  # noqa: N802 - the maker's name
        """Write; returns the number of bytes."""
        return os.write(self._descriptor, bytes(packet))


class Wire:
    """An open bus; TimeoutError, ValueError, IndexError (garbled), OSError (broken)."""

    def __init__(self, address: TcpAddress | SerialAddress) -> None:
        self._port = _Port(address)
        baud = address.baud if isinstance(address, SerialAddress) else self._port.baudrate
        if not self._port.setBaudRate(baud):
            raise ValueError(f"the maker's client knows no baud rate {baud}")
        self._client = sms_sts(self._port)
        self._finder = GroupSyncRead(self._client, 0, 0)  # finds an answer wherever it is; keeps nothing

    def model(self, servo: int) -> int:
        """Model number of a servo; ignores late answers."""
        return int.from_bytes(self.read(servo, MODEL, 2), "little")

    def answers(self, servo: int) -> bool:
        """Whether a servo answers."""
        try:
            self.model(servo)
        except (TimeoutError, ValueError, IndexError):
            return False
        return True

    def read(self, servo: int, address: int, size: int) -> bytes:
        """Read ``size`` registers."""
        packet: list[int] = []
        result = self._client.readTx(servo, address, size)
        while result == COMM_SUCCESS and (not packet or packet[PKT_ID] != servo):
            packet, result = self._client.rxPacket()
        _judge(result, servo)
        data = bytes(packet[PKT_PARAMETER0:-1])
        if packet[PKT_ERROR] == INST_READ and data == bytes((address, size)):  # the client takes it for an answer
            raise ValueError("the question itself came back; use an adapter that does not echo")
        if len(data) != size:  # the client would cut a late answer to an earlier question to this size
            raise ValueError(f"servo {servo} answered {len(data)} bytes instead of {size}")
        return data

    def write(self, servo: int, address: int, data: Sequence[int]) -> None:
        """Write registers; the servo confirms."""
        result, _ = self._client.writeTxRx(servo, address, len(data), list(data))
        _judge(result, servo)

    def read_all(self, servos: Sequence[int], address: int, size: int) -> dict[int, bytes]:
        """Read ``size`` registers of all ``servos``; without silent ones."""
        if self._client.syncReadTx(address, size, list(servos), len(servos)) != COMM_SUCCESS:
            raise OSError("the port did not take the request")
        _, data = self._client.syncReadRx(size, len(servos))
        found = {}
        for place, servo in enumerate(servos):
            own = data[place * (size + FRAME) : (place + 1) * (size + FRAME)]
            answer, result = self._finder.readRx(own, servo, size)
            if result != COMM_SUCCESS:  # not where it should be: the client looks for it everywhere
                answer, result = self._finder.readRx(data, servo, size)
            if result == COMM_SUCCESS:
                found[servo] = bytes(answer[1:])
        return found

    def write_all(self, servos: Sequence[int], address: int, data: Sequence[bytes]) -> None:
        """Write registers of all ``servos``, without answers."""
        words = [byte for servo, part in zip(servos, data, strict=True) for byte in (servo, *part)]
        if self._client.syncWriteTxOnly(address, len(data[0]), words, len(words)) != COMM_SUCCESS:
            raise OSError("the port did not take the request")

    def quieten(self, pause: float) -> bool:
        """Drop what comes within ``pause`` [s]; whether anything did."""
        end, found = time.monotonic() + pause, False
        while (left := end - time.monotonic()) > 0.0:
            found = bool(self._port.readPort(4096, left)) or found
        return found

    def close(self) -> None:
        """Release the port; the servos hold."""
        self._port.closePort()


def _judge(result: int, servo: int) -> None:
    if result == COMM_SUCCESS:
        return
    if result == COMM_RX_TIMEOUT:
        raise TimeoutError(f"servo {servo} does not answer")
    if result in (COMM_PORT_BUSY, COMM_TX_FAIL):
        raise OSError("the port did not take the request")
    raise ValueError(f"the answer of servo {servo} is garbled")


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
        return [
            min(max(round((angle - zero) / _STEP + middle), low), high)
            for angle, middle, zero, low, high in zip(
                position.tolist(), self.middle, self.zero, self.low, self.high, strict=True
            )
        ]


def read_calibration(path: Path, arm: Arm) -> MotorRanges:
    """Read LeRobot's calibration of ``arm``; FileError, InputError for its numbers."""
    motors = read_homing(path)
    columns = match_joints(list(motors), arm, path, "calibration").columns
    joints = [list(motors.values())[column] for column in columns]
    try:
        numbers = {
            name: [int(joint[name]) for joint in joints] for name in ("id", "homing_offset", "range_min", "range_max")
        }
    except (KeyError, TypeError, ValueError) as error:
        wanted = "id, homing_offset, range_min and range_max of every motor"
        raise InputError(f"{path}: expected {wanted} ({error!r})") from error
    low, high = np.array(numbers["range_min"]), np.array(numbers["range_max"])
    if not ((low >= 0) & (low < high) & (high < COUNTS_PER_TURN)).all():
        raise InputError(f"{path}: ranges must rise within 0 and {COUNTS_PER_TURN - 1}; run lerobot-calibrate again")
    return MotorRanges(ids=tuple(numbers["id"]), homing=np.array(numbers["homing_offset"]), low=low, high=high)


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
    ranges = (low, high) if file is None else (file.low, file.high)
    if not degrees:
        _require_swept(arm, *ranges)
    turned = np.radians(degrees) if degrees else np.zeros(arm.joints)
    return Zeros(
        middle=tuple(((ranges[0] + ranges[1]) / 2).tolist()),
        zero=tuple(turned.tolist()),
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
    )


def _require_swept(arm: Arm, low: Counts, high: Counts) -> None:
    whole = (high - low >= COUNTS_PER_TURN - 1) & (arm.upper - arm.lower < TURNING)
    if whole.any():
        names = ", ".join(name for name, bare in zip(arm.joint_names, whole, strict=True) if bare)
        raise RobotError(
            f"{names} may turn by a whole turn, as servos do that were never calibrated: zero is unknown; "
            "run lerobot-calibrate, or say by zero=DEG,DEG,... what angle each joint has in the middle of its range"
        )


PRESENT, BLOCK = 56, 15
"""Address and number of measured registers (Feetech's memory table of the STS/SMS series)"""
FAULTS = {1: "voltage", 2: "encoder", 4: "heat", 8: "over-current", 32: "overload"}
"""Bits of the status register"""
SAGGING = 0.75
"""share of the first voltage (chosen: servos go silent at half of it)"""
VOLT = 0.1
"""[V] per count"""
# of these position, load, voltage, temperature, status and goal
_ROW = struct.Struct("<HxxHBBxBxHxx")


def decode(rows: Sequence[bytes], zeros: Zeros, laws: Sequence[DutyLaw], supply: Sequence[float]) -> Reading:
    """Read the ``rows`` of n servos; ``supply`` [V] at the start."""
    places, loads, voltages, heats, words = [], [], [], [], []
    for row, law, before in zip(rows, laws, supply, strict=True):
        position, duty, volt, heat, status, goal = _ROW.unpack(row)
        place, voltage = signed(position, 15), volt * VOLT
        places.append(place)
        loads.append(law.share(signed(duty, 10), signed(goal, 15) - place))
        voltages.append(voltage)
        heats.append(heat)
        words.append(_trouble(status, voltage, before) if status or voltage < SAGGING * before else None)
    table = np.array(zeros.radians(places) + loads + voltages + heats).reshape(4, len(rows))
    return Reading(
        position=table[0],
        load=table[1],
        voltage=table[2],
        temperature=table[3],
        fault=np.array([word is not None for word in words]),
        trouble=tuple(word or "" for word in words) if any(word is not None for word in words) else None,
    )


def signed(word: int, bit: int) -> int:
    """Return number with a sign ``bit``."""
    return -(word & ~(1 << bit)) if word & 1 << bit else word


def _trouble(status: int, voltage: float, before: float) -> str:
    words = [name for bit, name in FAULTS.items() if status & bit]
    if voltage < SAGGING * before:
        words.append(f"the supply sags to {voltage:.1f} V from {before:.1f} V")
    return ", ".join(words)
