"""Who takes part in an evaluation: baselines, rivals and policy files, each with what identifies it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rejoint.arms import Arm
from rejoint.control.catalogue import BASELINES
from rejoint.control.controller import Controller
from rejoint.control.policy import load_policy
from rejoint.control.shelf import SHELF, shelf_arms, shelf_controller, shelf_path
from rejoint.research.rivals.catalogue import RIVALS, make_rival
from rejoint.system.errors import InputError
from rejoint.twin.predictive import PredictiveController
from rejoint.twin.twin import Twin


@dataclass(frozen=True, kw_only=True, eq=False)
class Contestant:
    """One controller of an evaluation."""

    name: str
    """unique, such as ``policy default #0``"""
    group: str
    """what tables put together: the name without the training seed"""
    make: Callable[[Arm], Controller]
    identity: str
    """changes with everything that the controller's behaviour depends on, but for the software's version"""
    learned: bool = False


def known_names() -> tuple[str, ...]:
    """Names that need no file."""
    return (*BASELINES, *RIVALS, SHELF)


def classical(name: str, gains: Mapping[str, Mapping[str, float]] | None = None) -> Contestant:
    """Baseline or rival by name; ``gains`` by rival replace those it comes with; InputError names the alternatives."""
    if name in BASELINES:
        return Contestant(name=name, group=name, make=BASELINES[name], identity=name)
    if name == SHELF:
        kept = b"".join(shelf_path(arm).read_bytes() for arm in shelf_arms())
        return Contestant(name=name, group=name, make=shelf_controller, identity=_digest(kept), learned=True)
    if name not in RIVALS:
        raise InputError(f"no controller is called {name!r}; known: {', '.join(known_names())}, and --policy FILE")
    own = dict((gains or {}).get(name, RIVALS[name].gains))
    return Contestant(
        name=name, group=name, make=lambda arm: make_rival(name, arm, own), identity=f"{name} {sorted(own.items())}"
    )


def planned(arm: Arm, twin: Twin) -> Controller:
    """Predictive control on an arm's own twin, with the policy from the shelf."""
    return PredictiveController.of(arm, twin, shelf_controller(arm))


def learned(path: Path, arm: Arm) -> Contestant:
    """Policy from a file; FileError or ContractError where it is none for this arm."""
    contract = load_policy(path, arm).contract
    group = f"policy {contract.preset}" + (" on its twin" if contract.twin_digest else "")
    return Contestant(
        name=f"{group} #{contract.seed}", group=group, make=lambda arm: load_policy(path, arm),
        identity=_digest(path.read_bytes()), learned=True,
    )  # fmt: skip


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def check_names(contestants: Sequence[Contestant]) -> None:
    """Refuse (InputError) two contestants of one name, such as two policies of one recipe and seed."""
    names = [one.name for one in contestants]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"these take part twice: {', '.join(twice)}; policies need different training seeds")
