"""Feetech's servos: addresses of arms with them, and their position loop.

Duty: P / 4 per mille per count beyond the dead zone, plus the startup force.
"""

from __future__ import annotations

from typing import NamedTuple

from rejoint.control.servogains import ServoGains
from rejoint.robots.knobs import ServoAddress, ServoKind

KIND = ServoKind.beside(__file__)

FULL = 1000.0
"""Duty of full PWM"""


class DutyLaw(NamedTuple):
    """Duty settings of one servo."""

    p: int
    startup: int
    above: int
    """[counts] dead zone for positive errors"""
    below: int
    """[counts] for negative errors"""

    def share(self, duty: int, error: int = 0) -> float:
        """Share of the largest torque, -1 to 1, of ``duty`` [0.1 %] at ``error`` [counts]."""
        size: float = abs(duty) - self.startup
        if size <= 0:
            return min(max(error, -self.below), self.above) * self.p / 4 / FULL
        size += (self.above if duty > 0 else self.below) * self.p / 4
        return min(size / FULL, 1.0) if duty > 0 else max(-size / FULL, -1.0)


def duty_laws(gains: ServoGains) -> list[DutyLaw]:
    """Laws (n,) of servos with these gains."""
    names = ("p", "startup", "dead_cw", "dead_ccw")
    return [DutyLaw(*values) for values in zip(*(gains[name] for name in names), strict=True)]


class FeetechAddress(ServoAddress):
    """A bus of Feetech servos."""

    kind = KIND
