"""Controllers by name, and the generic policies of the package."""

from collections.abc import Callable
from pathlib import Path

from rejoint.arms import CATALOGUE, Arm, Array
from rejoint.control.controllers.classical import DefaultController, IntegratorController
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.controllers.policy import Policy, PolicyController, check_contract, load_policy
from rejoint.control.robot import Controller
from rejoint.system.errors import ContractError, InputError

BASELINES: dict[str, Callable[[Arm], Controller]] = {
    "default": DefaultController,
    "integrator": IntegratorController,
    "feedforward": FeedforwardController,
}
"""Without learning, the simplest first"""

POLICY = "policy"
SHELF = "shelf"
PREDICTIVE = "predictive"
"""Planning on the arm's own twin"""

CONTROLLERS = (*BASELINES, SHELF, POLICY, PREDICTIVE)
"""The simplest first"""


def make_controller(
    name: str,
    arm: Arm,
    *,
    stiffness: Array | float | None = None,
    policy: Path | None = None,
) -> Controller:
    """Build the controller ``name``; InputError.

    ``stiffness`` (n,) [N m/rad] serves the feed-forward.
    """
    if name == POLICY:
        if policy is None:
            raise InputError("the controller 'policy' needs a policy file; train one or name its path")
        return load_policy(policy, arm)
    if name == PREDICTIVE:
        raise InputError("the controller 'predictive' needs the twin of the arm; fit one with: rejoint identify")
    if name == SHELF:
        return shelf_controller(arm)
    if name == "feedforward":
        return FeedforwardController(arm, stiffness)
    if name not in BASELINES:
        raise InputError(f"no controller is called {name!r}; known controllers: {', '.join(CONTROLLERS)}")
    return BASELINES[name](arm)


def shelf_path(name: str) -> Path:
    """File of the generic policy for ``name``."""
    return Path(__file__).parent / "policies" / f"{name}.onnx"


def shelf_arms() -> tuple[str, ...]:
    """Arms with a generic policy."""
    return tuple(name for name in CATALOGUE if shelf_path(name).exists())


def shelf_policy(arm: Arm) -> Policy:
    """Load the generic policy of an arm; ContractError: none."""
    if arm.name not in shelf_arms():
        known = ", ".join(shelf_arms())
        raise ContractError(
            f"no policy comes with rejoint for the arm {arm.name!r}, only for {known}; train one with: "
            "rejoint repair, or take another controller, such as integrator"
        )
    policy = Policy.load(shelf_path(arm.name))
    check_contract(policy.contract, arm)
    return policy


def shelf_controller(arm: Arm) -> PolicyController:
    """Load the controller of `shelf_policy`; ContractError: none."""
    return shelf_policy(arm).controller(arm)
