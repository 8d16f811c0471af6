"""Values in the memory of servos: all that drivers and emulators share."""

from __future__ import annotations

from typing import NamedTuple


class Register(NamedTuple):
    """A value in the memory of a servo, lowest byte first."""

    address: int
    size: int = 1
    sign: int | None = None
    """sign bit, `COMPLEMENT`, or None"""

    @property
    def cells(self) -> slice:
        """Place of its bytes."""
        return slice(self.address, self.address + self.size)

    def decode(self, data: bytes) -> int:
        """Read the value."""
        word = int.from_bytes(data, "little", signed=self.sign == COMPLEMENT)
        return word if self.sign in (None, COMPLEMENT) else signed(word, self.sign)

    def encode(self, value: int) -> bytes:
        """Write a value, without a sign bit as two's complement."""
        if self.sign not in (None, COMPLEMENT):
            value = magnitude(value, self.sign)
        return value.to_bytes(self.size, "little", signed=value < 0)


COMPLEMENT = -1
"""`Register.sign` of two's complement"""


def magnitude(value: int, bit: int) -> int:
    """Return the size and sign ``bit`` of a value; ValueError if it does not fit."""
    if abs(value) >= 1 << bit:
        raise ValueError(f"{value} does not fit into {bit} bits and a sign")
    return -value | 1 << bit if value < 0 else value


def signed(word: int, bit: int) -> int:
    """Inverse of `magnitude`."""
    return -(word & ~(1 << bit)) if word & 1 << bit else word
