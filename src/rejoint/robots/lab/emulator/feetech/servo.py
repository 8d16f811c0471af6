"""One STS3215 as the bus sees it: a register file, and what a write to it does."""

from __future__ import annotations

from collections.abc import Iterable

from rejoint.robots.lab.emulator.feetech.packets import magnitude, signed
from rejoint.robots.lab.emulator.feetech.registers import BY_NAME, SIZE, TABLE, Access, factory_settings

COUNTS = 4096
"""of the encoder a turn"""
MIDDLE = 2048
"""[counts] what CALIBRATE, or 128 written to Torque_Enable, makes of the present position"""

_WRITABLE = bytearray(SIZE)
_SAVED = bytearray(SIZE)
_NAME = [""] * SIZE
for _register in TABLE:
    for _cell in range(_register.address, _register.address + _register.size):
        _WRITABLE[_cell] = _register.access is not Access.READ
        _SAVED[_cell] = _register.access is Access.SAVED
        _NAME[_cell] = _register.name


class Servo:
    """The registers of one servo; whoever moves it keeps the measured ones up to date."""

    def __init__(self, number: int) -> None:
        self.cells = factory_settings(number)
        self._kept = bytes(self.cells)
        self._waiting: tuple[int, bytes] | None = None
        self.writes: list[tuple[int, bytes]] = []
        """every write that it obeyed: address and data, for whoever judges a driver"""

    def __getitem__(self, name: str) -> int:
        """Value of the register that is called so."""
        register = BY_NAME[name]
        word = int.from_bytes(self.cells[register.address : register.address + register.size], "little")
        return word if register.sign is None else signed(word, register.sign)

    def __setitem__(self, name: str, value: int) -> None:
        """Set a register, whoever may write it."""
        register = BY_NAME[name]
        word = value if register.sign is None else magnitude(value, register.sign)
        self.cells[register.address : register.address + register.size] = word.to_bytes(register.size, "little")

    @property
    def number(self) -> int:
        """Its ID."""
        return self["ID"]

    def read(self, address: int, size: int) -> bytes:
        """Return ``size`` registers from ``address`` on, zeros beyond the last one."""
        return bytes(self.cells[address : address + size]).ljust(size, b"\0")

    def write(self, address: int, data: bytes) -> set[str]:
        """Write registers that may be written, and return the names of those that were touched.

        They are kept over a loss of power where the lock is open. A goal turns the torque on by itself.
        """
        self.writes.append((address, data))
        end = min(address + len(data), SIZE)
        cells = [cell for cell in range(address, end) if _WRITABLE[cell]]
        for cell in cells:
            self.cells[cell] = data[cell - address]
        if self["Lock"] == 0:
            self.save(cells)
        touched = {_NAME[cell] for cell in cells}
        if "Goal_Position" in touched and self["Torque_Enable"] == 0:
            self["Torque_Enable"] = 1
            touched.add("Torque_Enable")
        if "Acceleration" in touched and self["Maximum_Acceleration"]:
            self["Acceleration"] = min(self["Acceleration"], self["Maximum_Acceleration"])
        return touched

    def save(self, cells: Iterable[int] = range(SIZE)) -> None:
        """Keep over a loss of power what stands in these ``cells``, as far as the servo keeps them at all."""
        kept = bytearray(self._kept)
        for cell in cells:
            if _SAVED[cell]:
                kept[cell] = self.cells[cell]
        self._kept = bytes(kept)

    def put_off(self, address: int, data: bytes) -> None:
        """Keep a write for the next `act`."""
        self._waiting = address, data
        self["Async_Write_Flag"] = 1

    def act(self) -> set[str]:
        """Carry out the write that was put off, if there is one."""
        waiting, self._waiting = self._waiting, None
        self["Async_Write_Flag"] = 0
        return self.write(*waiting) if waiting else set()

    def reset(self) -> None:
        """Restore the settings of the factory but for the ID."""
        self.cells = factory_settings(self.number)

    def cycle_power(self) -> None:
        """Lose the power and get it back: what was saved stays, the torque is off and the lock shut."""
        self.cells = bytearray(self._kept)
        self["Torque_Limit"] = self["Max_Torque_Limit"]
