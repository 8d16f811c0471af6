"""The gripper of an SO-101: a sixth servo that is none of the arm's joints, opened and closed in per cent."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Self

from rejoint.robots.feetech.law import FULL
from rejoint.system.errors import RobotError

READ, WRITE = 2, 3
"""Codes of instructions that `FeetechBus.relay` passes on: a servo's ID, an address, and a size or data"""
_LIMITS, _GOAL, _TORQUE_LIMIT, _PRESENT = 9, 42, 48, 56
SOFT = 0.5
"""share of the torque that the gripper gets, in RAM (as LeRobot limits it, so that a closed one does not burn)"""

MOST_SILENT = 3
"""Questions in a row without an answer after which the gripper is left alone (chosen: each holds up the arm)"""

Ask = Callable[[int, bytes], bytes | None]
"""Passes on an instruction with its parameters; None where nobody answers"""


class Gripper:
    """One servo, from ``low`` (0 %) to ``high`` (100 %) [counts]; it is left as it is until there is a ``goal``.

    Its answers come from `serve`, which the control loop calls once in a cycle; whoever sets a goal waits for nothing.
    """

    def __init__(self, ask: Ask, number: int, low: int, high: int) -> None:
        self.goal: float | None = None
        """[%] open"""
        self.opened: float | None = None
        """[%] as it was read last"""
        self._ask, self._number, self._low, self._high = ask, number, low, high
        self._sent: float | None = None
        self._silent = 0

    @classmethod
    def find(cls, ask: Ask, number: int) -> Self | None:
        """Return the gripper with the ID ``number``, read once; None where no such servo answers, or has no range."""
        try:
            data = ask(READ, bytes([number, _LIMITS, 4]))
        except RobotError:
            return None
        if data is None:
            return None
        low, high = struct.unpack("<HH", data)
        found = cls(ask, number, low, high) if low < high else None
        if found is not None:
            found._read()
        return found

    def serve(self) -> None:
        """Send a new goal, or read how far it is open: one question to the bus."""
        if self._silent >= MOST_SILENT:
            return
        try:
            if self.goal is not None and self.goal != self._sent:
                self._send(self.goal)
            else:
                self._read()
            self._silent = 0
        except RobotError:
            self._silent += 1

    def _read(self) -> None:
        data = self._ask(READ, bytes([self._number, _PRESENT, 2]))
        if data is not None:
            (place,) = struct.unpack("<H", data)
            self.opened = min(max(100.0 * (place - self._low) / (self._high - self._low), 0.0), 100.0)

    def _send(self, goal: float) -> None:
        """Its torque comes on with the first goal, softened before."""
        if self._sent is None:
            limit = struct.pack("<H", int(SOFT * FULL))
            self._ask(WRITE, bytes([self._number, _TORQUE_LIMIT]) + limit)
        place = self._low + min(max(goal, 0.0), 100.0) / 100.0 * (self._high - self._low)
        self._ask(WRITE, bytes([self._number, _GOAL]) + struct.pack("<H", round(place)))
        self._sent = goal
