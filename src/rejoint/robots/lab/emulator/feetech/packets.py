"""Packets of the Feetech STS bus as bytes: ``FF FF ID LEN CODE PARAMETERS CHECKSUM``, LEN = parameters + 2.

The code is an instruction on the way to a servo and the servo's error bits on the way back. Source: Feetech's protocol
manual of the STS/SMS series, and what LeRobot was seen to send (the golden bytes of the tests).
"""

from __future__ import annotations

from typing import NamedTuple

HEADER = b"\xff\xff"
BROADCAST = 0xFE
"""ID that means every servo"""
MOST_PARAMETERS = 248
"""that a packet may carry: the vendor's clients cap packets at 250 bytes behind the length"""

PING, READ, WRITE, REG_WRITE, ACTION, RESET = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
CALIBRATE, SYNC_READ, SYNC_WRITE = 0x0B, 0x82, 0x83


class Packet(NamedTuple):
    """An instruction, or the status that a servo answers with."""

    id: int
    code: int
    """instruction, or error bits"""
    parameters: bytes = b""


def checksum(body: bytes) -> int:
    """Return the last byte of a packet whose ID, length, code and parameters are ``body``."""
    return ~sum(body) & 0xFF


def encode(packet: Packet) -> bytes:
    """Return the bytes of a packet."""
    body = bytes((packet.id, len(packet.parameters) + 2, packet.code)) + packet.parameters
    return HEADER + body + bytes((checksum(body),))


class PacketFinder:
    """Finds packets in a stream of bytes that may hold anything else as well."""

    def __init__(self) -> None:
        self._held = b""

    @property
    def pending(self) -> bool:
        """Whether the beginning of a packet is there, so that its rest is awaited."""
        return bool(self._held)

    def feed(self, data: bytes) -> list[Packet]:
        """Take bytes and return the packets that are whole now. What cannot begin a packet is dropped."""
        self._held += data
        found: list[Packet] = []
        while True:
            start = self._held.find(HEADER)
            if start < 0:
                self._held = self._held[-1:] if self._held.endswith(b"\xff") else b""
                return found
            self._held = self._held[start:]
            packet, size = _first(self._held)
            if size == 0:
                return found
            self._held = self._held[size:]
            if packet is not None:
                found.append(packet)

    def expire(self) -> list[Packet]:
        """Give up the packet whose rest did not come; return those that stood inside it."""
        held, self._held = self._held, b""
        return self.feed(held[1:])


def _first(data: bytes) -> tuple[Packet | None, int]:
    """Packet at the beginning of ``data``, if it is one, and how many bytes are done with: 0 where some are missing."""
    if len(data) < 4:
        return (None, 1) if data[2:] == b"\xff" else (None, 0)
    length = data[3]
    if data[2] == 0xFF or not 2 <= length <= MOST_PARAMETERS + 2:
        return None, 1
    size = length + 4
    if len(data) < size:
        return None, 0
    if checksum(data[2 : size - 1]) != data[size - 1]:
        return None, 1
    return Packet(data[2], data[4], data[5 : size - 1]), size


def magnitude(value: int, bit: int) -> int:
    """Return ``value`` as these servos write numbers with a sign: its size, and ``bit`` set where it is negative."""
    if abs(value) >= 1 << bit:
        raise ValueError(f"{value} does not fit into {bit} bits and a sign")
    return -value | 1 << bit if value < 0 else value


def signed(word: int, bit: int) -> int:
    """Return what `magnitude` was made from."""
    size = word & ~(1 << bit)
    return -size if word & 1 << bit else size
