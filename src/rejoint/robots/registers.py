"""Values in the memory of servos: all that drivers and emulators share."""

from typing import NamedTuple

COMPLEMENT = -1
"""`Register.sign` of two's complement"""


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
        if self.sign in (None, COMPLEMENT) or not word & 1 << self.sign:
            return word
        return -(word & ~(1 << self.sign))

    def encode(self, value: int) -> bytes:
        """Write a value, without a sign bit as two's complement; ValueError if it does not fit beside one."""
        if self.sign not in (None, COMPLEMENT):
            if abs(value) >= 1 << self.sign:
                raise ValueError(f"{value} does not fit into {self.sign} bits and a sign")
            value = -value | 1 << self.sign if value < 0 else value
        return value.to_bytes(self.size, "little", signed=value < 0)
