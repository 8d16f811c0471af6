"""A controller under gains of the servos' own: `default` under tuned ones is what owners try first."""

from __future__ import annotations

from rejoint.arms import Array
from rejoint.control.controller import ControlInput, Controller, heeds_turn
from rejoint.control.default import DefaultController
from rejoint.control.robot import Mask
from rejoint.control.servogains import ServoGains

GEARED = "servo-gains"
"""Name of the servos' own loops, tuned, with nothing above; before a plus and a name, that controller under them"""
UNDER = ("integrator", "feedforward")
"""Controllers that are tried under tuned gains as well (chosen: the best of the classical ones)"""
RIVALS = (GEARED, *(f"{GEARED}+{name}" for name in UNDER))


def inner_name(name: str) -> str:
    """Name of the controller that drives under tuned gains; any other name as it is."""
    return DefaultController.name if name == GEARED else name.removeprefix(f"{GEARED}+")


class Geared:
    """Passes everything on to ``controller``; whoever drives it sets ``gains`` first (`under_gains`)."""

    def __init__(self, controller: Controller, gains: ServoGains) -> None:
        self._controller, self.servo_gains = controller, gains
        inner, self.heeds_turn = controller.name, heeds_turn(controller)
        self.name = GEARED if inner == DefaultController.name else f"{GEARED}+{inner}"

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Pass a new target on."""
        self._controller.reset(inputs, where)

    def command(self, inputs: ControlInput) -> Array:
        """Return the controller's command (B, n) [rad]."""
        return self._controller.command(inputs)
