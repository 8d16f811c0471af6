"""Faults of the arm, as time goes on: encoders, readings, heat, and what servos report about themselves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rejoint.arms import Array
from rejoint.robots.lab.emulator.ailments import OVER_CURRENT_BIT, OVERLOAD_BIT, VOLTAGE_BIT
from rejoint.robots.lab.emulator.armlike import ArmLike
from rejoint.robots.lab.emulator.faults import Faults, Onset
from rejoint.robots.lab.emulator.plantlike import Mask

READINGS = frozenset({0x20, 0x23, 0x3B, 0x3D, 0xD5})
"""Questions whose answers are read from the encoders."""

JUMP = np.radians(60.0)
"""[rad] of an impossible jump: a servo takes 0.4 s for it, a reading every 20 to 100 ms shows the jump (chosen)"""
BEYOND_LIMIT = np.radians(3.0)
"""[rad] a joint reads beyond its limit: less than what a driver takes for a broken reading (chosen)"""
RUN_AWAY = np.radians(90.0)
"""[rad/s] at which such a reading runs there: below the highest speed of the joints (chosen)"""
HEATING = 10.0
"""[K/s] of a servo that gets hot (chosen: a real one takes minutes, a test should not)"""
HOT = 85.0
"""[deg C] at which it stays: 15 K above its protection threshold (chosen)"""
CURRENT_SCALE = 3.25
"""[A] top of the scale: 500 steps of 6.5 mA (Feetech STS memory table)"""
LOW_VOLTAGE = 7.0
"""[V] of a supply that broke down (chosen: a 12 V servo hardly moves at it)"""


class ArmFaults:
    """Lets the faults of the arm begin when their time has come. What begins at 0 has been so from the start."""

    def __init__(self, faults: Faults, arm: ArmLike) -> None:
        self._emulated = arm
        ailments, servos = arm.ailments, arm.arm.joints
        onsets: list[tuple[Onset, Callable[[Mask], object]]] = []

        def plan(kind: tuple[Onset, ...], begin: Callable[[Mask], object]) -> None:
            onsets.extend((onset, begin) for onset in kind)

        plan(faults.freeze, arm.freeze)
        plan(faults.blind, arm.blind)
        plan(faults.jump, self._jump)
        plan(faults.limit, self._run_beyond)
        plan(faults.overheat, self._heat)
        plan(faults.current, lambda joints: self._alarm(joints, OVER_CURRENT_BIT, ailments.current, CURRENT_SCALE))
        plan(faults.overload, lambda joints: self._alarm(joints, OVERLOAD_BIT))
        plan(faults.voltage, lambda joints: self._alarm(joints, VOLTAGE_BIT, ailments.voltage, LOW_VOLTAGE))
        self._waiting = sorted(onsets, key=lambda planned: planned[0].after)
        self._heating = np.zeros(servos, dtype=bool)
        self._running = np.zeros(servos)
        """(n,) direction in which a reading runs; 0 for those that stand"""
        self._jumped = np.zeros(servos)
        """(n,) [rad] jumps that nobody has read yet"""
        self._then = 0.0

    def advance(self, elapsed: float) -> None:
        """Begin what is due ``elapsed`` [s] after the first byte, and go on with what has begun."""
        passed, self._then = elapsed - self._then, elapsed
        while self._waiting and self._waiting[0][0].after <= elapsed:
            onset, begin = self._waiting.pop(0)
            joints = np.zeros(self._emulated.arm.joints, dtype=bool)
            joints[list(onset.joints)] = True
            begin(joints)
            if onset.after == 0.0:
                passed = np.inf
        if self._heating.any():
            self._go_on_heating(passed)
        if self._running.any():
            self._go_on_running(passed)

    def was_asked(self, command: int) -> None:
        """Take a jump back once it was read: it is one of a single reading."""
        if command in READINGS and self._jumped.any():
            self._emulated.ailments.misreading -= self._jumped
            self._jumped[:] = 0.0

    def _inwards(self) -> Array:
        """(n,) 1 where the lower limit is the nearer one, -1 elsewhere."""
        arm = self._emulated.arm
        return np.where(self._emulated.angles < 0.5 * (arm.lower + arm.upper), 1.0, -1.0)

    def _jump(self, joints: Mask) -> None:
        jump = JUMP * self._inwards() * joints
        self._jumped += jump
        self._emulated.ailments.misreading += jump

    def _run_beyond(self, joints: Mask) -> None:
        self._running[joints] = -self._inwards()[joints]

    def _go_on_running(self, passed: float) -> None:
        arm, angles = self._emulated.arm, self._emulated.angles
        end = np.where(self._running > 0, arm.upper + BEYOND_LIMIT, arm.lower - BEYOND_LIMIT)
        left = np.where(self._running == 0, 0.0, np.maximum(self._running * (end - angles), 0.0))
        self._emulated.ailments.misreading += self._running * np.minimum(left, RUN_AWAY * passed)
        self._running[left <= RUN_AWAY * passed] = 0.0

    def _heat(self, joints: Mask) -> None:
        self._heating |= joints

    def _go_on_heating(self, passed: float) -> None:
        missing = np.maximum(HOT - self._emulated.temperature, 0.0)
        self._emulated.ailments.warmth += np.where(self._heating, np.minimum(missing, HEATING * passed), 0.0)

    def _alarm(self, joints: Mask, bit: int, reading: Array | None = None, value: float = 0.0) -> None:
        self._emulated.ailments.alarms[joints] |= bit
        if reading is not None:
            reading[joints] = value
