"""The wire of servos on a bus, through whatever client of their maker."""

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from select import select
from typing import Any, ClassVar, Self

from rejoint.robots.family import Wire
from rejoint.robots.ports import opened

CONNECT = 5.0
"""[s] (chosen, as pyserial does)"""
WAIT = 0.02
"""[s] of one wait for bytes (chosen)"""
OK, UNSENT, SILENT = 0, (-1, -2, -1000, -1001), (-6, -3001)
"""Results of Feetech's client and ROBOTIS'; all others are garbled answers"""

READ = 2
"""Instruction, which an echo has in the place of the error"""


def judge(result: int, servo: int) -> None:
    """Raise what a client's ``result`` means: TimeoutError, OSError (broken), ValueError (garbled)."""
    if result == OK:
        return
    if result in SILENT:
        raise TimeoutError(f"servo {servo} does not answer")
    if result in UNSENT:
        raise OSError("the port did not take the request")
    raise ValueError(f"the answer of servo {servo} is garbled; have two servos this ID?")


class ServoWire(ABC):
    """An open bus; TimeoutError, ValueError, IndexError (garbled), OSError (broken).

    A base before a maker's ``PortHandler``, which it makes wait in the system.
    """

    places: ClassVar[tuple[int, int]]
    """of ID and error in a status packet"""
    overhead: ClassVar[int]
    """[bytes] of a status packet around the data"""
    is_using = property(lambda _: False, lambda *_: None)  # one thread at a time uses it
    baudrate: int
    _client: Any
    """the maker's, on this port"""
    _first: tuple[Self, ...] = ()
    """what its methods take before all else"""
    _last: tuple[bool, ...] = ()
    """what those take after it that read packets"""

    def __init__(self, address: Wire) -> None:
        """Open at the address's rate; ValueError, OSError."""
        super().__init__(address)  # type: ignore[call-arg]  # the maker's
        self._address = address
        baud = address.baud or self.baudrate
        if not self.setBaudRate(baud):  # type: ignore[attr-defined]  # the maker's
            raise ValueError(f"the maker's client knows no baud rate {baud}")

    def close(self) -> None:
        """Release the port."""
        self.closePort()  # type: ignore[attr-defined]  # the maker's

    def setupPort(self, _rate: int) -> bool:  # noqa: N802 - the maker's name
        """Open; OSError."""
        self.ser = opened(self._address, self.baudrate, CONNECT)
        self._descriptor = self.ser.fileno()
        self.is_open = True
        self.tx_time_per_byte = (1000.0 / self.baudrate) * 10.0
        return True

    def readPort(self, length: int, wait: float = WAIT) -> bytes:  # noqa: N802 - the maker's name
        """Return what comes within ``wait`` [s]; OSError."""
        # a client asks for less than nothing behind a packet that says it is shorter than any
        if length <= 0 or not select([self._descriptor], [], [], wait)[0]:
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

    def quieten(self, pause: float) -> bool:
        """Drop what comes within ``pause`` [s]; whether anything did."""
        end, found = time.monotonic() + pause, False
        while (left := end - time.monotonic()) > 0.0:
            found = bool(self.readPort(4096, left)) or found
        return found

    @abstractmethod
    def model(self, servo: int) -> int:
        """Model number of a servo; ignores late answers."""

    def _receive(self) -> tuple[list[int], int]:
        """Wait for a status packet; it, and the client's result."""
        return self._client.rxPacket(*self._first, *self._last)

    @abstractmethod
    def _data(self, packet: Sequence[int]) -> bytes:
        """Return the data of a status packet."""

    def read(self, servo: int, address: int, size: int) -> bytes:
        """Read ``size`` registers."""
        (number, error), packet = self.places, list[int]()
        result = self._client.readTx(*self._first, servo, address, size)
        while result == OK and (not packet or packet[number] != servo):
            packet, result = self._receive()
        self._take(result, servo, packet[error] if result == OK else 0)
        data = self._data(packet)
        if packet[error] == READ and tuple(data) == (address, size):  # Feetech's client takes it for an answer
            raise ValueError("the question itself came back; use an adapter that does not echo")
        if len(data) != size:  # the client would cut a late answer to an earlier question to this size
            raise ValueError(f"servo {servo} answered {len(data)} bytes instead of {size}")
        return data

    def write(self, servo: int, address: int, data: Sequence[int]) -> int:
        """Write registers, which the servo confirms; its error byte."""
        result, error = self._client.writeTxRx(*self._first, servo, address, len(data), list(data))
        self._take(result, servo, error)
        return error

    def read_all(self, servos: Sequence[int], address: int, size: int) -> dict[int, bytes]:
        """Read ``size`` registers of all ``servos``; without silent ones."""
        asked = address, size, list(servos), len(servos)
        judge(self._client.syncReadTx(*self._first, *asked, *self._last), servos[0])
        self.setPacketTimeout((size + self.overhead) * len(servos))  # type: ignore[attr-defined]  # the maker's
        found = dict[int, bytes]()
        number, error = self.places
        for _ in range(2 * len(servos)):  # among them garbled ones
            if len(found) == len(servos):
                break
            packet, result = self._receive()
            if result in SILENT:
                break
            if result == OK and packet[number] in servos and len(data := self._data(packet)) == size:
                found[packet[number]] = data
                self._take(OK, packet[number], packet[error])
        return found

    def write_all(self, servos: Sequence[int], address: int, data: Sequence[bytes]) -> None:
        """Write registers of all ``servos``, without answers."""
        words = [byte for servo, part in zip(servos, data, strict=True) for byte in (servo, *part)]
        judge(self._client.syncWriteTxOnly(*self._first, address, len(data[0]), words, len(words)), servos[0])

    def _take(self, result: int, servo: int, _error: int) -> None:
        judge(result, servo)
