"""What the duty of a servo says of the error that it sees, by the settings in its registers.

An STS3215 gives P / 4 per mille of duty for each count of error beyond its dead zone, and its startup force on top. Its
load as it is told here is in proportion to the error, as of any position servo: less the startup force, which makes up
for friction within the servo, and with what the dead zone leaves out, also inside of it. Duty and load differ by a
percent. Without that, a joint that rests in its dead zone would look to the monitor like one that is off its line.
"""

from __future__ import annotations

from dataclasses import dataclass

FULL = 1000.0
"""Duty of all of PWM, in the unit of the registers"""


@dataclass(frozen=True, kw_only=True)
class DutyLaw:
    """Settings of one servo, as its registers hold them."""

    p: int
    startup: int
    above: int
    """[counts] of the dead zone for positive errors"""
    below: int
    """[counts] likewise for negative ones"""

    def share(self, duty: int, error: int = 0) -> float:
        """Share of the largest torque, -1 to 1, of a ``duty`` [0.1 %] with its sign, at an ``error`` [counts]."""
        size: float = abs(duty) - self.startup
        if size <= 0:
            return min(max(error, -self.below), self.above) * self.p / 4 / FULL
        size += (self.above if duty > 0 else self.below) * self.p / 4
        return min(size / FULL, 1.0) if duty > 0 else max(-size / FULL, -1.0)
