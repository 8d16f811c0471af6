"""The client `ftservo-python-sdk` on any port of pyserial."""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Sequence
from select import select

import serial
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

from rejoint.robots.family import SerialAddress, TcpAddress

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
