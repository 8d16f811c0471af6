"""The gains of the servos of one arm, read and changed in small steps, each of which every servo has to bear."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rejoint.control.servogains import HEAVIEST, HOTTEST, ServoGains
from rejoint.robots.feetech.gains import FIRST, PAUSE, REGISTERS, SIZE, Values, read_block, steps, stiffer
from rejoint.robots.feetech.law import FULL, DutyLaw
from rejoint.system.errors import RobotError
from rejoint.system.stopping import ending, shielded

LOCK, LOAD, HEAT = 55, 60, 63
"""Addresses of registers."""
_NEGATIVE = 1 << 10  # sign of a load

Read = Callable[[int, int, int, float | None], bytes]
"""Registers of a servo: its ID, address and size, and [s] until when it is asked again"""
Write = Callable[[int, int, Sequence[int], float | None], object]


class Tuning:
    """What stands in the registers of the servos ``ids``; ``wanted`` is what is to be in force on every connection."""

    def __init__(
        self, ids: Sequence[int], wanted: Values, *, read: Read, write: Write, call: Callable[[int], str],
        wait: Callable[[float], object],
    ) -> None:  # fmt: skip
        """Take how registers are read and written, what a servo is called, and how time passes."""
        self.values: Values = {}
        """in force, by the names of `REGISTERS`"""
        self.laws: list[DutyLaw] = []
        """what a duty says of each servo's error, under these"""
        self._ids, self._wanted = ids, wanted
        self._read, self._write, self._call, self._wait = read, write, call, wait

    def prepare(self, until: float | None) -> None:
        """Read the gains, and bring them to those that are to be in force."""
        self._look_up(until)
        self._walk(self._wanted, until, hottest=HOTTEST)

    def tune(self, gains: ServoGains) -> None:
        """Bring the gains to these, also on later connections. How warm servos are is for who drives them to judge."""
        self._walk(gains, None)
        self._wanted = {name: tuple(values) for name, values in gains.items()}

    def keep(self, gains: ServoGains) -> None:
        """Bring the gains to these, and open each servo's lock for as long as it takes to save them."""
        self.tune(gains)
        for index, servo in enumerate(self._ids):
            try:
                self._write(servo, LOCK, [0], None)
                for name, values in gains.items():
                    self._write(servo, REGISTERS[name], [values[index]], None)
            finally:
                with shielded():
                    self._write(servo, LOCK, [1], None)
            if self._read(servo, LOCK, 1, None) != b"\1":
                raise RobotError(f"the lock of {self._call(servo)} stays open; switch the arm's power off and on")
        self._look_up(None)
        if any(self.values[name] != tuple(values) for name, values in gains.items()):
            raise RobotError(f"the servos have not taken the gains; they are {self.values}")

    def _there(self, until: float | None) -> Values:
        return read_block([self._read(servo, FIRST, SIZE, until) for servo in self._ids])

    def _look_up(self, until: float | None) -> None:
        blocks = [self._read(servo, FIRST, SIZE, until) for servo in self._ids]
        self.values = read_block(blocks)
        self.laws = [DutyLaw(p=data[0], startup=data[3], above=data[5], below=data[6]) for data in blocks]

    def _walk(self, wanted: ServoGains, until: float | None, *, hottest: float = np.inf) -> None:
        """Go there in small steps; RobotError, and all of them back, where a servo does not bear one."""
        before = self.values
        strange = [name for name in wanted if name not in before or len(wanted[name]) != len(self._ids)]
        if strange:
            known = f"{', '.join(before)} of {len(self._ids)} joints"
            raise RobotError(f"expected gains {known}, got {', '.join(strange)}")
        there = self._there(until)
        for step in steps(there, wanted):  # a walk that a lost connection cut short goes on
            self._take(step, until)
            problem = "" if ending() else self._problem(step, there, until, hottest)
            if problem:
                for back in steps(self._there(until), before):
                    self._take(back, until)
                raise RobotError(f"{problem}; the gains are as before")
        self._look_up(until)

    def _take(self, step: Mapping[str, Sequence[int]], until: float | None) -> None:
        for name, values in step.items():
            for servo, value in zip(self._ids, values, strict=True):
                self._write(servo, REGISTERS[name], [value], until)
        self._wait(PAUSE)

    def _problem(self, step: Mapping[str, Sequence[int]], there: Values, until: float | None, hottest: float) -> str:
        """Say which servo does not bear to be made stiffer than ``there``; empty where all do."""
        ((name, values),) = step.items()
        for servo, old, value in zip(self._ids, there[name], values, strict=True):
            if not stiffer(name, old, value):  # else one that labours could not be relieved
                continue
            low, high, _, heat = self._read(servo, LOAD, 4, until)
            load = ((low | high << 8) & ~_NEGATIVE) / FULL
            if load > HEAVIEST or heat > hottest:
                return f"{self._call(servo)} does not bear {name}={value}: load {100 * load:.0f} %, {heat} deg C"
        return ""
