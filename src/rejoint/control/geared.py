"""A controller under gains of the servos' own: `default` under tuned ones is what owners try first."""

from __future__ import annotations

from collections.abc import Sequence

from rejoint.arms import Array
from rejoint.control.catalogue import POLICY, PREDICTIVE, PUSH
from rejoint.control.controller import ControlInput, Controller, heeds_turn
from rejoint.control.default import DefaultController
from rejoint.control.robot import Mask
from rejoint.control.servogains import ServoGains

GEARED = "servo-gains"
"""Name of the servos' own loops, tuned, with nothing above; before a plus and a name, that controller under them"""
UNDER = ("integrator", "feedforward", PUSH, POLICY, PREDICTIVE)
"""Controllers that are driven under tuned gains as well (chosen: the best of the classical ones, what owners try
against friction, and what the run has made for its arm)"""
RIVALS = (GEARED, *(f"{GEARED}+{name}" for name in UNDER))
GEARED_PUSH, GEARED_POLICY, GEARED_PREDICTIVE = (f"{GEARED}+{name}" for name in (PUSH, POLICY, PREDICTIVE))


def inner_name(name: str) -> str:
    """Name of the controller that drives under tuned gains; any other name as it is."""
    return DefaultController.name if name == GEARED else name.removeprefix(f"{GEARED}+")


def own_policy(names: Sequence[str]) -> str | None:
    """Name under which the policy of a run is among controllers; None where it is not."""
    return next((name for name in names if inner_name(name) == POLICY), None)


class Geared:
    """Passes everything on to ``controller``; whoever drives it sets ``gains`` first (`under_gains`)."""

    def __init__(self, controller: Controller, gains: ServoGains) -> None:
        self._controller, self.servo_gains = controller, gains
        self.contract, self.heeds_turn = getattr(controller, "contract", None), heeds_turn(controller)
        inner = controller.name
        self.name = GEARED if inner == DefaultController.name else f"{GEARED}+{inner}"

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Pass a new target on."""
        self._controller.reset(inputs, where)

    def command(self, inputs: ControlInput) -> Array:
        """Return the controller's command (B, n) [rad]."""
        return self._controller.command(inputs)
