"""A Dynamixel X servo's registers and gains, and addresses of arms with such servos.

Sources: ROBOTIS' e-manual, pages of XL330, XL430, XC430, XM430 and XM540.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from math import copysign
from typing import Any, ClassVar, NamedTuple

from rejoint.arms import Arm, Array
from rejoint.control.servogains import Rung
from rejoint.robots.knobs import COMPLEMENT, LIMIT, Gains, Knob, Register, ServoAddress

TABLE = {
    "id": Register(7),
    "delay": Register(9),
    "drive": Register(10),
    "mode": Register(11),
    "homing": Register(20, 4, COMPLEMENT),
    "largest": Register(38, 2),
    "high": Register(48, 4, COMPLEMENT),
    "low": Register(52, 4, COMPLEMENT),
    "torque": Register(64),
    "confirms": Register(68),
    "error": Register(70),
    "d": Register(80, 2),
    "i": Register(82, 2),
    "p": Register(84, 2),
    "watchdog": Register(98),
    LIMIT: Register(100, 2),
    "current": Register(102, 2, COMPLEMENT),
    "acceleration": Register(108, 4),
    "speed": Register(112, 4),
    "goal": Register(116, 4, COMPLEMENT),
    "load": Register(126, 2, COMPLEMENT),
    "position": Register(132, 4, COMPLEMENT),
    "voltage": Register(144, 2),
    "heat": Register(146),
}
"""Registers below 64 are kept without power, and never written"""
KNOBS = {
    "p": Knob(("p",), 50, 4000, 50),
    "i": Knob(("i",), 0, 1600, 50),
    "d": Knob(("d",), 0, 8000, 200),
    LIMIT: Knob((LIMIT,), 100, 885, 885),
    "current": Knob(("current",), 1, 100, 100),
    "speed": Knob(("speed",), 0, 1023, 1023),
    "acceleration": Knob(("acceleration",), 0, 32767, 32767),
}
"""Gains and tried limits (chosen). The limit of the output is in 1/885; that of the current, which acts in the mode
`CURRENT_BASED` alone, in percent of the servo's own; speed and acceleration are those of the profile, 0: none"""
RUNGS = (
    Rung((LIMIT,), (885,)),
    Rung(("current",), (100,)),
    Rung(("p",), (800, 1200, 1800, 2700)),
    Rung(("p",), (2700,), beside=(("d", 4000),)),
    Rung(("i",), (400, 1600), alone=True),
    Rung(("acceleration",), (100,), beside=(("speed", 1023),), alone=True),
)
"""Search order (chosen: within `KNOBS`). More D is tried where a joint is restless under more P; the last ones, I and a
profile, would lag behind a controller"""
CURRENT_BASED = 5
"""Operating mode"""


class Model(NamedTuple):
    """A kind of servo."""

    name: str
    full: float
    """value of the register ``load`` at the largest torque: the stall current, or 100 % in an XL430 and XC430"""
    supply: bool = False
    """the current is that of the supply, of which the torque goes as the root"""

    def share(self, load: int) -> float:
        """Share of the largest torque, -1 to 1."""
        part = min(abs(load) / self.full, 1.0)
        return copysign(part**0.5 if self.supply else part, load)


MODELS = {
    1190: Model("XL330-M077", 1470.0, supply=True),
    1200: Model("XL330-M288", 1470.0, supply=True),
    1060: Model("XL430-W250", 1000.0),
    1070: Model("XC430-W150", 1000.0),
    1020: Model("XM430-W350", 2.3 / 0.00269),
    1120: Model("XM540-W270", 4.4 / 0.00269),
}
"""Known ones, by number"""
ERRORS = {
    1: "voltage",
    4: "heat",
    8: "encoder",
    16: "electrical shock, or too little power",
    32: "overload",
}
"""Bits of the register ``error``"""

FORM = "dynamixel:///dev/DEVICE or dynamixel://HOST:PORT"


def _ids(text: str) -> tuple[tuple[int, ...], ...]:
    if not re.fullmatch(r"\d{1,3}([+,]\d{1,3})*", text):
        raise ValueError(f"expected ids=N,N+N,... with the servos of each joint, got {text!r}")
    return tuple(tuple(map(int, one.split("+"))) for one in text.split(","))


def _yes(text: str) -> bool:
    if text != "yes":
        raise ValueError(f"expected reboot=yes, got {text!r}")
    return True


@dataclass(frozen=True, kw_only=True)
class DynamixelAddress(ServoAddress):
    """A bus of Dynamixel servos."""

    port, knobs, table = 9000, KNOBS, TABLE
    driven: ClassVar[Gains] = {"speed": 0, "acceleration": 0}
    options: ClassVar[dict[str, Callable[[str], Any]]] = {
        **ServoAddress.options,
        "ids": _ids,
        "reverse": lambda text: tuple(text.split(",")),
        "reboot": _yes,
    }
    ids: tuple[tuple[int, ...], ...] = ()
    """servos of each joint; empty: in the calibration, or counted from 1 or 11"""
    reverse: tuple[str, ...] = ()
    """joints that turn against their servos"""
    reboot: bool = False
    """restart servos that have switched themselves off"""

    def middle(self, arm: Arm) -> Array:
        """Angles (n,) [rad] in the middle of a calibrated range, else at 2048 counts; InputError."""
        if self.calibration is None or self.zero:
            return super().middle(arm)
        return (arm.lower + arm.upper) / 2
