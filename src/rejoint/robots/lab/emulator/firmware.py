"""The robot's own computer: keeps the limits, runs the moves, powers and releases the servos, and answers requests."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_pose
from rejoint.arms.wire.computer import FULL_SPEED, at_angles, at_place
from rejoint.arms.wire.mover import Mover
from rejoint.robots.lab.emulator.faults import OVER_TEMPERATURE_BIT, EmulatedArm, Mask

if TYPE_CHECKING:
    from rejoint.robots.lab.plant.plant import Plant

TICK_MS = 10
"""[ms] between set-points that the firmware writes while it interpolates (chosen)"""
COMMAND_DELAY = (0.008, 0.013)
"""[s] from the arrival of a command to its effect in the servos (the plant's own channel)"""
MAX_WRITES = 64
"""Goals on their way over the servo bus; the oldest of more are lost (chosen)"""

CURRENT_PER_TORQUE = 2.7 / 2.94
"""[A/(N m)] of an STS3215 at 12 V: 2.7 A at its stall torque of 30 kg cm (Feetech data sheet)"""

# [rad/s] below this speed a joint counts as standing (chosen)
_AT_REST = np.radians(2.0)
# [deg C] default protection threshold of Feetech STS servos (their register table)
_OVER_TEMPERATURE = 70.0


class _Write(NamedTuple):
    due_ms: int
    goal: Array
    speed: float


class Firmware(EmulatedArm, Mover):
    """State and behaviour of one emulated myCobot; ``plant`` holds one arm, already reset."""

    def __init__(self, plant: Plant, arm: Arm, *, seed: int = 0) -> None:
        EmulatedArm.__init__(self, plant, arm)
        Mover.__init__(self, arm, plant.goal[0])
        self.powered = True
        self.enabled = np.ones(arm.joints, dtype=bool)
        self.zero = np.zeros(arm.joints)
        """(n,) [rad] what calibration took as zero, on the encoders' own scale"""
        self.registers: dict[tuple[int, int], int] = {}
        """(servo, address) -> value; kept and read back, without effect on the servos"""
        self._rng = np.random.default_rng(seed)
        self._clock_ms = 0
        self._owed = 0.0
        self.outbox: list[_Write] = []

    # --- what is measured -------------------------------------------------------------------

    @property
    def angles(self) -> Array:
        """(n,) [rad] joint angles by the encoders."""
        return super().angles - self.zero

    @property
    def pose(self) -> Array:
        """(4, 4) TCP pose by the encoders."""
        return tcp_pose(self.arm, self.angles)

    @property
    def speed(self) -> Array:
        """(n,) [rad/s]."""
        return self.plant.speed[0]

    @property
    def torque(self) -> Array:
        """(n,) [N m] of the motors."""
        return self.plant.torque[0]

    @property
    def hot(self) -> Mask:
        """(n,) whether a servo is over its temperature threshold."""
        return self.temperature >= _OVER_TEMPERATURE

    @property
    def current(self) -> Array:
        """(n,) [A]."""
        return np.maximum(np.abs(self.torque) * CURRENT_PER_TORQUE, self.ailments.current)

    @property
    def voltage(self) -> Array:
        """(n,) [V]."""
        return self.ailments.voltage

    @property
    def alarms(self) -> NDArray[np.uint8]:
        """(n,) status bits of the servos."""
        return np.where(self.hot, OVER_TEMPERATURE_BIT, 0).astype(np.uint8) | self.ailments.alarms

    @property
    def moving(self) -> bool:
        """Whether the reference is under way or a joint still moves."""
        return (self._motion.moving and not self._motion.paused) or bool((np.abs(self.speed) > _AT_REST).any())

    def in_position(self, angles: Array) -> bool:
        """Whether the encoders are within a degree of ``angles`` (n,) [rad]."""
        return at_angles(self.angles, angles)

    def at_pose(self, pose: Array) -> bool:
        """Whether the TCP is within 3 mm and a degree of ``pose`` (4, 4), by the encoders."""
        return at_place(self.pose, pose)

    # --- moves ------------------------------------------------------------------------------

    def stop(self, joint: int | None = None) -> None:
        """Hold where the reference is, and forget what was to come: one joint, or the arm."""
        self._motion.hold(joint)
        if joint is not None:
            self._write(self._motion.ramp_speed, self._motion.goal)
            return
        self.outbox.clear()
        self.plant.halt()
        self._track(np.ones(self.arm.joints, dtype=bool), self.plant.goal[0] - self.zero)

    def pause(self) -> None:
        """Hold where the reference is, to go on later."""
        self._motion.paused = True
        self._write(FULL_SPEED)

    def resume(self) -> None:
        """Go on."""
        self._motion.paused = False
        if not self._motion.interpolating:
            self._write(self._motion.ramp_speed, self._motion.goal)

    # --- power ------------------------------------------------------------------------------

    def power(self, on: bool) -> None:
        """Power all servos, which then hold where they are, or none: the arm falls."""
        self.powered = on
        self.enable(np.full(self.arm.joints, on))

    def enable(self, wanted: Mask) -> None:
        """Let the servos in ``wanted`` (n,) hold, those newly switched on where they are; release the others."""
        self._motion.hold()
        self.outbox.clear()
        self._track(wanted & ~self.enabled, self.angles)
        self.enabled = wanted.copy()
        self.plant.set_power(np.array([bool(wanted.any())]))
        self.outbox.append(_Write(self._clock_ms, self._motion.reference + self.zero, FULL_SPEED))

    def calibrate(self, joint: int) -> None:
        """Take the present position of a joint as its zero."""
        shift = float(self.angles[joint])
        self.zero[joint] += shift
        self._motion.hold()
        self._motion.place(joint, float(self._motion.reference[joint]) - shift)

    # --- time -------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """[s] since the start, on the plant's clock."""
        return self._clock_ms * 1e-3

    def advance(self, duration: float) -> None:
        """Let ``duration`` [s] pass; what is less than a millisecond waits for the next call."""
        self._owed += duration * 1e3
        left = int(self._owed + 1e-6)
        self._owed -= left
        while left > 0:
            next_due = min((write.due_ms for write in self.outbox), default=self._clock_ms + TICK_MS)
            step = min(left, TICK_MS, max(1, next_due - self._clock_ms))
            interpolating = self._motion.interpolating
            self._motion.advance(step * 1e-3)
            if interpolating or not self.enabled.all():
                self._track(~self.enabled, self.angles)
                self._write_now()
            self._deliver()
            self.plant.advance(step * 1e-3)
            self._clock_ms += step
            left -= step

    def _ready(self) -> bool:
        if self.powered and not self.enabled.all():
            self.enable(np.ones(self.arm.joints, dtype=bool))
        return self.powered

    def _track(self, joints: Mask, angles: Array) -> None:
        """Put the reference of ``joints`` (n,) at ``angles`` (n,) [rad], so that nothing pulls."""
        for joint in np.flatnonzero(joints):
            self._motion.place(int(joint), float(angles[joint]))

    def _ramped(self, speed: float, goal: Array) -> None:
        self._write(speed, goal)

    def _write(self, speed: float, goal: Array | None = None) -> None:
        """Send a goal (n,) [rad], by default the reference, over the servo bus."""
        due_ms = self._clock_ms + round(1e3 * self._rng.uniform(*COMMAND_DELAY))
        if self.outbox:
            due_ms = max(due_ms, self.outbox[-1].due_ms)  # a bus does not overtake itself
        target = (self._motion.reference if goal is None else goal) + self.zero
        self.outbox.append(_Write(due_ms, target, speed))
        del self.outbox[:-MAX_WRITES]

    def _deliver(self) -> None:
        arrived = [write for write in self.outbox if write.due_ms <= self._clock_ms]
        self.outbox = [write for write in self.outbox if write.due_ms > self._clock_ms]
        if arrived:
            self.plant.set_speed_limit(arrived[-1].speed)
            self.plant.command(arrived[-1].goal[None])

    def _write_now(self) -> None:
        self.outbox.clear()
        self.plant.set_speed_limit(FULL_SPEED)
        self.plant.command((self._motion.reference + self.zero)[None])
