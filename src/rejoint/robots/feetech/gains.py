"""An STS3215's registers and position loop.

Duty: P / 4 per mille per count beyond the dead zone, plus the startup force.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from rejoint.control.servogains import Rung, ServoGains
from rejoint.robots import knobs
from rejoint.robots.knobs import LIMIT, Knob, Register, ServoAddress

LIMITED = 50
"""Limit of the I part: 20 % of PWM (chosen: beyond friction)"""
KNOBS: dict[str, Knob] = {
    "p": Knob(("p",), 8, 64, 4),
    "i": Knob(("i",), 0, 8, 1, beside=((LIMIT, LIMITED),)),
    "d": Knob(("d",), 16, 64, 8),
    "dead": Knob(("dead_cw", "dead_ccw"), 0, 16, -1),
    "startup": Knob(("startup",), 8, 48, 4),
}
"""Gains and tried limits (chosen: beyond, servos shake)"""
REGISTERS = {LIMIT: 25, "p": 21, "d": 22, "i": 23, "startup": 24, "dead_cw": 26, "dead_ccw": 27}
"""Addresses, one byte each, side by side"""
RUNGS = (
    Rung(("p",), (8, 16, 24, 32, 40, 48, 56, 64)),
    Rung(("dead_cw", "dead_ccw"), (0,), rising=False),
    Rung(("startup",), (16, 24, 32)),
    Rung(("i",), (1, 2, 4, 8), beside=((LIMIT, LIMITED),), alone=True),
)
"""Search order (chosen: within `KNOBS`)"""
TABLE = {
    "id": Register(5),
    "confirms": Register(8),
    "low": Register(9, 2),
    "high": Register(11, 2),
    "homing": Register(31, 2, 11),
    "mode": Register(33),
    "torque": Register(40),
    "acceleration": Register(41),
    "goal": Register(42, 2),
    "speed": Register(46, 2),
    "force": Register(48, 2),
    "lock": Register(55),
    "position": Register(56, 2),
    "load": Register(60, 2, 10),
    "voltage": Register(62),
    "heat": Register(63),
    "fastest": Register(85),
    "times": Register(86),
} | {name: Register(address) for name, address in REGISTERS.items()}
"""Feetech's memory table of the STS/SMS series"""

read_gains = partial(knobs.read_gains, knobs=KNOBS)
for_all = partial(knobs.for_all, knobs=KNOBS)

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


FORM = "feetech:///dev/DEVICE or feetech://HOST:PORT"


class FeetechAddress(ServoAddress):
    """A bus of Feetech servos."""

    port, knobs, table = 9000, KNOBS, TABLE
