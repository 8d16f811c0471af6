"""Arms on ROBOTIS Dynamixel X servos (protocol 2.0): Koch, WidowX, ViperX, OpenMANIPULATOR; their addresses."""

import re
from collections.abc import Callable
from typing import Any, ClassVar

from rejoint.arms import Arm, Array
from rejoint.robots.knobs import Gains, ServoAddress, ServoKind
from rejoint.system.files import read_shipped
from rejoint.system.records import value_type

KIND = read_shipped(__file__, "servo.toml", ServoKind)
CURRENT_BASED = 5
"""Operating mode"""


def _ids(text: str) -> tuple[tuple[int, ...], ...]:
    if not re.fullmatch(r"\d{1,3}([+,]\d{1,3})*", text):
        raise ValueError(f"expected ids=N,N+N,... with the servos of each joint, got {text!r}")
    return tuple(tuple(map(int, one.split("+"))) for one in text.split(","))


def _yes(text: str) -> bool:
    if text != "yes":
        raise ValueError(f"expected reboot=yes, got {text!r}")
    return True


@value_type
class DynamixelAddress(ServoAddress):
    """A bus of Dynamixel servos."""

    kind = KIND
    driven: ClassVar[Gains] = {"speed": 0, "acceleration": 0}
    options: ClassVar[dict[str, Callable[[str], Any]]] = {
        **ServoAddress.options,
        "ids": _ids,
        "reverse": lambda text: tuple(text.split(",")),
        "reboot": _yes,
    }
    reverse: tuple[str, ...] = ()
    """joints that turn against their servos"""
    reboot: bool = False
    """restart servos that have switched themselves off"""

    def middle(self, arm: Arm) -> Array:
        """Angles (n,) [rad] in the middle of a calibrated range, else at 2048 counts; InputError."""
        if self.calibration is None or self.zero:
            return super().middle(arm)
        return (arm.lower + arm.upper) / 2
