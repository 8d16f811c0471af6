"""The robot's computer: limits, moves, servo power and answers."""

from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, Mask
from rejoint.robots.mycobot.motion import FULL_SPEED
from rejoint.robots.mycobot.wire import Computer, Sensed
from rejoint_lab.emulator.faults import OVER_TEMPERATURE_BIT, EmulatedArm
from rejoint_lab.plant.wear import Wear

TICK_MS = 10
"""[ms] between set-points (chosen)"""
COMMAND_DELAY = (0.008, 0.013)
"""[s] from a command to its effect"""
MAX_WRITES = 64
"""Goals on the bus; more drop the oldest (chosen)"""

CURRENT_PER_TORQUE = 2.7 / 2.94
"""[A/(N m)] of an STS3215 at 12 V: 2.7 A at 30 kg cm stall (Feetech data sheet)"""

# [rad/s] below this speed a joint counts as standing (chosen)
_AT_REST = np.radians(2.0)
# [deg C] default protection threshold of Feetech STS servos (their register table)
_OVER_TEMPERATURE = 70.0


class _Write(NamedTuple):
    due_ms: int
    goal: Array
    speed: float


class Firmware(EmulatedArm, Computer):
    """An emulated myCobot."""

    def __init__(self, arm: Arm, wear: Wear, *, seed: int = 0) -> None:
        EmulatedArm.__init__(self, arm, wear, seed=seed)
        Computer.__init__(self, arm, self.plant.goal[0])
        self.zero = np.zeros(arm.joints)
        """(n,) [rad] calibrated zeros by the encoders"""
        self._rng = np.random.default_rng(seed)
        self._clock_ms, self._owed = 0, 0.0
        self.outbox: list[_Write] = []

    # --- what is measured -------------------------------------------------------------------

    @property
    def angles(self) -> Array:
        """(n,) [rad] by the encoders."""
        return super().angles - self.zero

    @property
    def moving(self) -> bool:
        """Whether the reference or a joint moves."""
        return (self.motion.moving and not self.motion.paused) or (np.abs(self.plant.speed) > _AT_REST).any()

    @property
    def sensed(self) -> Sensed:
        """What else is measured."""
        heat = self.temperature
        return Sensed(
            speed=self.plant.speed[0],
            current=np.maximum(np.abs(self.plant.torque[0]) * CURRENT_PER_TORQUE, self.least_current),
            voltage=self.voltage,
            temperature=heat,
            alarms=np.where(heat >= _OVER_TEMPERATURE, OVER_TEMPERATURE_BIT, 0).astype(np.uint8) | self.alarms,
        )

    # --- moves ------------------------------------------------------------------------------

    def stop(self, joint: int | None = None) -> None:
        """Hold one joint, or the arm; drop its moves."""
        self.motion.hold(joint)
        if joint is not None:
            self._write(self.motion.ramp_speed, self.motion.goal)
            return
        self.outbox.clear()
        self.plant.halt()
        self.motion.place(slice(None), self.plant.goal[0] - self.zero)

    def pause(self, on: bool) -> None:
        """Hold, or continue."""
        super().pause(on)
        if on:
            self._write(FULL_SPEED)
        elif not self.motion.interpolating:
            self._write(self.motion.ramp_speed, self.motion.goal)

    # --- power ------------------------------------------------------------------------------

    def power(self, on: bool) -> None:
        """Power all servos, which hold, or none: the arm falls."""
        self.powered = on
        self.enable(np.full(self.arm.joints, on))

    def enable(self, wanted: Mask) -> None:
        """Hold with the servos in ``wanted`` (n,); release the others."""
        self.motion.hold()
        held = wanted & ~self.enabled
        self.motion.place(held, self.angles[held])
        self.enabled = wanted.copy()
        self.plant.set_power(bool(wanted.any()))
        self.outbox = [_Write(self._clock_ms, self.motion.reference + self.zero, FULL_SPEED)]

    def calibrate(self, joint: int) -> None:
        """Set a joint's zero here."""
        shift = self.angles[joint]
        self.zero[joint] += shift
        self.motion.hold()
        self.motion.place(joint, self.motion.reference[joint] - shift)

    # --- time -------------------------------------------------------------------------------

    def advance(self, duration: float) -> None:
        """Advance by ``duration`` [s], in whole milliseconds."""
        self._owed += duration * 1e3
        left = int(self._owed + 1e-6)
        self._owed -= left
        while left > 0:
            next_due = min((write.due_ms for write in self.outbox), default=self._clock_ms + TICK_MS)
            step = min(left, TICK_MS, max(1, next_due - self._clock_ms))
            interpolating = self.motion.interpolating
            self.motion.advance(step * 1e-3)
            if interpolating or not self.enabled.all():
                self.motion.place(~self.enabled, self.angles[~self.enabled])
                self.outbox = [_Write(self._clock_ms, self.motion.reference + self.zero, FULL_SPEED)]
            arrived = [write for write in self.outbox if write.due_ms <= self._clock_ms]
            self.outbox = [write for write in self.outbox if write.due_ms > self._clock_ms]
            if arrived:
                self.plant.set_speed_limit(arrived[-1].speed)
                self.plant.command(arrived[-1].goal[None])
            self.plant.advance(step * 1e-3)
            self._clock_ms += step
            left -= step

    def _ready(self) -> bool:
        if self.powered and not self.enabled.all():
            self.enable(np.ones(self.arm.joints, dtype=bool))
        return self.powered

    def _write(self, speed: float, goal: Array | None = None) -> None:
        """Send a goal (n,) [rad], by default the reference."""
        due_ms = self._clock_ms + round(1e3 * self._rng.uniform(*COMMAND_DELAY))
        due_ms = max([due_ms, *(write.due_ms for write in self.outbox)])  # a bus does not overtake itself
        target = (self.motion.reference if goal is None else goal) + self.zero
        self.outbox.append(_Write(due_ms, target, speed))
        del self.outbox[:-MAX_WRITES]
