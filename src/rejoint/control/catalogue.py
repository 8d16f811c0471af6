"""Controllers by name, as the command line and the comparison ask for them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rejoint.arms import Arm, Array
from rejoint.control.controller import Controller
from rejoint.control.default import DefaultController
from rejoint.control.feedforward import FeedforwardController
from rejoint.control.integrator import IntegratorController
from rejoint.control.pid import PidController, PidGains
from rejoint.control.push import PushController
from rejoint.control.shelf import SHELF, shelf_controller
from rejoint.system.errors import InputError

BASELINES: dict[str, Callable[[Arm], Controller]] = {
    "default": DefaultController,
    "pid-sum": lambda arm: PidController(arm, PidGains(integral_times_period=False)),
    "pid-literal": lambda arm: PidController(arm, PidGains(integral_times_period=True)),
    "integrator": IntegratorController,
    "feedforward": FeedforwardController,
}
"""Everything that was not learned, from the simplest to the most demanding."""

PUSH = PushController.name
"""Name of the feed-forward with a push against the friction that the arm's own twin tells"""
POLICY = "policy"
"""Name of the policy among the controllers"""
PREDICTIVE = "predictive"
"""Name of the controller that plans on the arm's own twin (`rejoint.twin.predictive`)"""

CONTROLLERS = (*BASELINES, PUSH, SHELF, POLICY, PREDICTIVE)
"""Names of controllers, from the simplest to the most demanding."""

ON_REQUEST = ("pid-sum", "pid-literal")
"""Baselines that a repair, or a real arm, is driven with only where they are asked for: they are there to repeat the
paper"""


def contenders(*, real: bool, shelf: bool, policy: bool, twin: bool) -> tuple[str, ...]:
    """Return who takes part in a comparison where nobody is named, on a ``real`` arm or in virtual time.

    ``shelf``, ``policy`` and ``twin`` tell whether there is one for this arm. A real arm is driven with the policy from
    the shelf until it has its own: to drive both takes a minute more and buys nothing (`python -m benchmarks.racing
    --shelf`). The push is for servos that hold still under it, and so takes part under tuned gains (`geared.UNDER`), or
    where it is asked for.
    """
    missing = {PUSH: True, SHELF: not shelf or (real and policy), POLICY: not policy, PREDICTIVE: not twin}
    return tuple(name for name in CONTROLLERS if not missing.get(name) and not (real and name in ON_REQUEST))


def make_controller(
    name: str, arm: Arm, *, stiffness: Array | float | None = None, friction: Array | float | None = None,
    policy: Path | None = None,
) -> Controller:  # fmt: skip
    """Build the controller called ``name``.

    ``stiffness`` (n,) [N m/rad] is what the feed-forward believes of the servos, by default
    what a worn arm of this size may have; ``friction`` (n,) [N m] is what the push believes of the joints; ``policy``
    is the file that the name ``policy`` needs. InputError names the alternatives.
    """
    if name == POLICY:
        if policy is None:
            raise InputError("the controller 'policy' needs a policy file; train one or name its path")
        from rejoint.control.policy import load_policy  # ONNX Runtime is slow to import and not needed elsewhere

        return load_policy(policy, arm)
    if name == PREDICTIVE:
        raise InputError("the controller 'predictive' needs the twin of the arm; fit one with: rejoint identify")
    if name == PUSH:
        if stiffness is None or friction is None:
            raise InputError("the controller 'push' needs the twin of the arm; fit one with: rejoint identify")
        return PushController(arm, stiffness, friction)
    if name == SHELF:
        return shelf_controller(arm)
    if name == "feedforward":
        return FeedforwardController(arm, stiffness)
    if name not in BASELINES:
        raise InputError(f"no controller is called {name!r}; known controllers: {', '.join(CONTROLLERS)}")
    return BASELINES[name](arm)
