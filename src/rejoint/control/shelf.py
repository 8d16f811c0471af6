"""Policies from the shelf: one for any worn arm of a build of the catalogue, which comes with the package.

Such a policy was trained on broad ranges, without the twin of any arm, and so needs nothing to be known of the one that
it drives: it is there before anything is trained. Its contract is checked as that of any other policy. Each is made
by one command (`rejoint.training.shelf`), and `python -m benchmarks shelf` makes it again and compares.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.arms import CATALOGUE, Arm
from rejoint.control.contract import check_contract
from rejoint.system.errors import ContractError

if TYPE_CHECKING:
    from rejoint.control.policy import Policy, PolicyController

SHELF = "shelf"
"""Name of such a policy among the controllers"""


def shelf_path(name: str) -> Path:
    """Where the package keeps the policy for the arm of the catalogue that is called ``name``."""
    return Path(str(files("rejoint.control"))) / "policies" / f"{name}.onnx"


def shelf_arms() -> tuple[str, ...]:
    """Names of the arms for which there is a policy."""
    return tuple(name for name in CATALOGUE if shelf_path(name).exists())


def shelf_policy(arm: Arm) -> Policy:
    """Return the policy for an arm of the catalogue, in a file or not; ContractError for any other arm."""
    if arm.name not in shelf_arms():
        known = ", ".join(shelf_arms())
        raise ContractError(
            f"no policy comes with rejoint for the arm {arm.name!r}, only for {known}; train one with: "
            "rejoint repair, or take another controller, such as integrator"
        )
    from rejoint.control.policy import Policy  # ONNX Runtime is slow to import and not needed elsewhere

    policy = Policy.load(shelf_path(arm.name))
    check_contract(policy.contract, arm)
    return policy


def shelf_controller(arm: Arm) -> PolicyController:
    """Return what drives ``arm`` with the policy for its build; ContractError where none suits."""
    return shelf_policy(arm).controller(arm)
