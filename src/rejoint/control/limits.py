"""What the guard allows, and the names of its reasons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntFlag
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.arms.size import length_size
from rejoint.control.following import Bands, Knowledge
from rejoint.system.errors import InputError

Reasons = NDArray[np.uint16]

JOINT_CLEARANCE = 0.01
"""[m] height of joint frames above the floor of the TCP, for a myCobot 280 (chosen: the radius of a link and a little
more, less the floor of 20 mm); goes with the reach."""

RAMP = 0.018
"""[s] in which a command may go from rest to full speed (chosen: the shortest control period that policies are trained
for, so that starting and stopping are limited by speed alone and only turning round takes its time; with 0.03 a policy
is 9 +- 9 ms slower to a target, with 0.06 it is 21 +- 11 ms, see docs/benchmarks.md)"""


class Reason(IntFlag):
    """Why a command was changed, or why the guard tripped."""

    NONE = 0
    POSITION = 1
    """beyond a joint limit"""
    STEP = 2
    """further from the last command than the joint's speed allows in one period"""
    LEAD = 4
    """further ahead of the measured position than allowed"""
    FLOOR = 8
    """a point of the arm would come too low"""
    NOT_FINITE = 16
    """a command or a measured position is not a finite number"""
    STALE = 32
    """the joint state is too old"""
    OUT_OF_RANGE = 64
    """a measured position lies far outside the joint limits"""
    TEMPERATURE = 128
    """a servo is too hot"""
    SERVO_FAULT = 256
    """a servo reports a fault"""
    GAP = 512
    """no answers came for a while, or a joint that was not believed broke loose; the arm held, and goes on as from a
    start (flagged by the control loop)"""
    NOT_FOLLOWING = 1024
    """a joint's reading stands still and is not believed, see `rejoint.control.following`"""
    ACCELERATION = 2048
    """the command would gain speed, or turn round, faster than allowed"""
    COLLISION = 4096
    """a link would touch another one or the ground"""


TRIPS = (
    Reason.NOT_FINITE | Reason.STALE | Reason.OUT_OF_RANGE | Reason.TEMPERATURE | Reason.SERVO_FAULT
    | Reason.NOT_FOLLOWING
)  # fmt: skip
"""Reasons that end the motion."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GuardLimits:
    """What the guard allows. `GuardLimits.of` fills it for an arm."""

    arm: Arm
    lower: Array
    """(n,) [rad] lowest command"""
    upper: Array
    """(n,) [rad] highest command"""
    max_speed: Array
    """(n,) [rad/s] times the period: largest change of the command in one cycle"""
    max_acceleration: Array
    """(n,) [rad/s^2] of the command, away from rest; braking is free, down to the hold. Infinite: no limit"""
    collisions: bool = True
    """whether commands are kept from postures in which a link touches another one or the ground"""
    parts: int = 16
    """of a step that are tried, all at once, where the whole would end too low or in contact (chosen: 0.23 deg each of
    the largest step in 25 ms; with twice as many a call takes 53 instead of 45 us)"""
    max_lead: float = np.radians(20.0)
    """[rad] between command and measured position (chosen: twice what the worn arm's sag needs)"""
    max_period: float = 0.1
    """[s] periods longer than this do not allow a larger step (chosen: twice the slowest regular period)"""
    tcp_floor: float = 0.0
    """[m] lowest height of the TCP"""
    joint_floor: float = 0.03
    """[m] lowest height of a joint frame: radius of a link and a little more, for a myCobot 280"""
    max_age: float = 0.5
    """[s] oldest joint state (chosen: ten periods of the slowest wire)"""
    max_temperature: float = 65.0
    """[deg C] hottest servo (chosen: 5 below the 70 at which servos of this class switch themselves off)"""
    range_margin: float = np.radians(10.0)
    """[rad] a measured position further than this outside the arm's limits is not believed (chosen)"""
    servos: Knowledge | None = None
    """what is known of the servos beforehand; it makes the monitor of joints that do not follow quicker"""
    bands: Bands | None = None
    """at which pushes its joints stood when the arm was measured; that monitor needs it where no load is told"""
    gains: Mapping[str, tuple[int, ...]] | None = None
    """of the servos, for which both of these hold (`rejoint.control.servogains`); None: for any"""

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "max_speed", "max_acceleration"):
            array = np.array(getattr(self, name), dtype=float)
            endless = name == "max_acceleration" and not np.isnan(array).any()
            if array.shape != (self.arm.joints,) or not (endless or np.isfinite(array).all()):
                raise InputError(f"guard limits: {name} needs {self.arm.joints} finite numbers, got {array}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if (self.lower >= self.upper).any() or (self.max_speed <= 0).any() or (self.max_acceleration <= 0).any():
            raise InputError("guard limits: lower must be below upper, speeds and accelerations must be positive")
        for name in ("parts", "max_lead", "max_period", "max_age"):
            if not getattr(self, name) > 0:
                raise InputError(f"guard limits: {name} must be positive, got {getattr(self, name)}")

    @cached_property
    def floors(self) -> Array:
        """(n,) [m] lowest heights of all joint frames but the first, which stands still, and of the TCP."""
        return np.append(np.full(self.arm.joints - 1, self.joint_floor), self.tcp_floor)

    @cached_property
    def shares(self) -> Array:
        """(parts + 1, 1) shares of a step, from none to all of it."""
        return np.arange(self.parts + 1)[:, None] / self.parts

    @cached_property
    def believed(self) -> tuple[Array, Array]:
        """(n,), (n,) [rad] lowest and highest measured positions that are believed."""
        return self.arm.lower - self.range_margin, self.arm.upper + self.range_margin

    @classmethod
    def of(cls, arm: Arm, *, margin: float = np.radians(0.5)) -> GuardLimits:
        """Limits of an arm; commands stay ``margin`` [rad] inside the joint limits (chosen).

        Joint frames keep farther from the ground than the TCP, by `JOINT_CLEARANCE`, since links have a
        thickness.
        """
        return cls(
            arm=arm, lower=arm.lower + margin, upper=arm.upper - margin, max_speed=arm.max_speed,
            max_acceleration=arm.max_speed / RAMP, tcp_floor=arm.floor,
            joint_floor=arm.floor + JOINT_CLEARANCE * length_size(arm),
        )  # fmt: skip

    def of_simulation(self) -> GuardLimits:
        """Return limits without those of acceleration and of contacts, for trainings.

        Steps are cut into twice as many parts, as they always were in trainings: the same seed gives the same policy.
        """
        return replace(self, max_acceleration=np.full(self.arm.joints, np.inf), collisions=False, parts=32)


def reason_names(reasons: int) -> tuple[str, ...]:
    """Names of the flags in one element of `Guarded.reasons`, as shown to people."""
    return tuple(reason.name.lower().replace("_", " ") for reason in Reason(int(reasons)) if reason.name)
