"""The maker's client, `ftservo-python-sdk`, on any port of pyserial; what it reports becomes an error with a name.

The client reads with a time-out of zero and so keeps a processor busy while it waits; its port is given one here. What
a synchronous read did not bring is left from the read before: it is thrown away here first. It drops its input before
every request, as this driver relies on.
"""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Sequence
from select import select
from typing import Any

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
from serial.urlhandler.protocol_socket import Serial as SocketSerial

FRAME = 6
"""bytes of an answer beside its data: header, ID, length, errors, checksum"""
MODEL = 3
"""Address of the register that tells a servo's kind"""
WAIT = 0.02
"""[s] of one look for bytes (chosen: between looks the client sees whether its 50 ms are over)"""


class _Remote(SocketSerial):  # type: ignore[misc]  # pyserial has no types
    """A port of another machine: small packets do not wait for each other, and a broken one is closed all the same."""

    _socket: Any

    def open(self) -> None:
        """Connect."""
        super().open()
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def close(self) -> None:
        """Disconnect; pyserial's own way leaves the socket open where the other side has gone, and sleeps."""
        line, self._socket, self.is_open = self._socket, None, False
        if line is not None:
            line.close()


class _Port(PortHandler):  # type: ignore[misc]  # the maker's package has no types
    """A port of the client that may lie behind a URL of pyserial, sleeps while it waits, and wakes for what comes.

    pyserial opens and configures it. Bytes go past it: between two cycles it drops out of the processor's caches, and
    its loops then take longer than all else here.
    """

    def setupPort(self, _rate: int) -> bool:  # noqa: N802 - the maker's name
        """Open it; OSError where that fails."""
        try:
            if self.port_name.startswith("socket://"):
                self.ser = _Remote(self.port_name)
            else:
                self.ser = serial.Serial(self.port_name, baudrate=self.baudrate, exclusive=True)
        except serial.SerialException as error:
            if error.errno != errno.EWOULDBLOCK:
                raise
            raise OSError("another program drives the arm there; end it first") from error
        self._descriptor: int = self.ser.fileno()
        self.is_open = True
        self.tx_time_per_byte = (1000.0 / self.baudrate) * 10.0
        return True

    def readPort(self, length: int, wait: float = WAIT) -> bytes:  # noqa: N802 - the maker's name
        """Return what comes within ``wait`` [s], as soon as anything does; OSError where the port is gone."""
        if length <= 0:  # as the client asks behind a packet that says it is shorter than any
            return b""
        if not select([self._descriptor], [], [], wait)[0]:
            return b""
        data = os.read(self._descriptor, length)
        if not data:
            raise OSError("the port is gone")
        return data

    def writePort(self, packet: Sequence[int]) -> int:  # noqa: N802 - the maker's name
        """Return how many bytes were taken."""
        return os.write(self._descriptor, bytes(packet))


class Wire:
    """An open bus. Methods raise TimeoutError, ValueError or IndexError (garbled), or OSError (broken)."""

    def __init__(self, port: str, baud: int) -> None:
        self._port = _Port(port)
        if not self._port.setBaudRate(baud):
            raise ValueError(f"the maker's client knows no baud rate {baud}")
        self._client = sms_sts(self._port)
        self._finder = GroupSyncRead(self._client, 0, 0)  # finds an answer wherever it is; keeps nothing

    def model(self, servo: int) -> int:
        """Return the model number of a servo; the client's ping asks for it as well, but takes no late answer."""
        return int.from_bytes(self.read(servo, MODEL, 2), "little")

    def answers(self, servo: int) -> bool:
        """Tell whether a servo answers."""
        try:
            self.model(servo)
        except (TimeoutError, ValueError, IndexError):
            return False
        return True

    def read(self, servo: int, address: int, size: int) -> bytes:
        """Read ``size`` registers of a servo."""
        self._free()
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
        """Write registers of a servo, which confirms it."""
        self._free()
        result, _ = self._client.writeTxRx(servo, address, len(data), list(data))
        _judge(result, servo)

    def read_all(self, servos: Sequence[int], address: int, size: int) -> dict[int, bytes]:
        """Read the same ``size`` registers of all ``servos`` at once; those that did not answer are left out."""
        self._free()
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
        """Write registers of all ``servos`` at once; none of them answers."""
        self._free()
        words = [byte for servo, part in zip(servos, data, strict=True) for byte in (servo, *part)]
        if self._client.syncWriteTxOnly(address, len(data[0]), words, len(words)) != COMM_SUCCESS:
            raise OSError("the port did not take the request")

    def quieten(self, pause: float) -> bool:
        """Throw away what lies there or comes within ``pause`` [s]; tell whether there was anything."""
        end, found = time.monotonic() + pause, False
        while (left := end - time.monotonic()) > 0.0:
            found = bool(self._port.readPort(4096, left)) or found
        return found

    def close(self) -> None:
        """Release the port; the servos hold."""
        self._port.closePort()

    def _free(self) -> None:
        """Forget a request that an error cut short; the client would take the port for busy for good."""
        self._port.is_using = False


def _judge(result: int, servo: int) -> None:
    if result == COMM_SUCCESS:
        return
    if result == COMM_RX_TIMEOUT:
        raise TimeoutError(f"servo {servo} does not answer")
    if result in (COMM_PORT_BUSY, COMM_TX_FAIL):
        raise OSError("the port did not take the request")
    raise ValueError(f"the answer of servo {servo} is garbled")
