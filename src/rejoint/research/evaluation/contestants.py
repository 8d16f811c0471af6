"""Controllers of an evaluation, each with an identity."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.control.catalogue import (
    BASELINES,
    PREDICTIVE,
    SHELF,
    make_controller,
    shelf_arms,
    shelf_controller,
    shelf_path,
)
from rejoint.control.controller import Controller
from rejoint.control.feedforward import FeedforwardController
from rejoint.control.policy import load_policy
from rejoint.research.rivals.catalogue import RIVALS, make_rival
from rejoint.research.rivals.pid import PIDS
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
    """changes with everything that the behaviour depends on, except the software"""
    learned: bool = False
    on_twins: Callable[[Arm, Sequence[Twin]], Controller] | None = None
    """makes it where each arm has a twin; None: it needs none"""

    def maker(self, twins: Sequence[Twin]) -> Callable[[Arm], Controller]:
        """Return what makes the controller for arms with these ``twins``, or without any."""
        of = self.on_twins
        return self.make if of is None or not twins else lambda arm: of(arm, twins)


def known_names() -> tuple[str, ...]:
    """Names that need neither file nor twins."""
    return (*BASELINES, *PIDS, *RIVALS, SHELF)


def classical(name: str, gains: Mapping[str, Mapping[str, float]] | None = None) -> Contestant:
    """Baseline or rival by name; ``gains`` replace its own; InputError names the alternatives."""
    identity, learns, on_twins = name, name == SHELF, None
    make: Callable[[Arm], Controller] = partial(make_controller, name)
    if name in BASELINES or name == PREDICTIVE:
        on_twins = {FeedforwardController.name: _raised, PREDICTIVE: planned}.get(name)
    elif name in PIDS:
        make = PIDS[name]
    elif learns:
        make, identity = shelf_controller, _digest(b"".join(shelf_path(arm).read_bytes() for arm in shelf_arms()))
    elif name in RIVALS:
        own = dict((gains or {}).get(name, RIVALS[name].gains))
        make, identity = partial(make_rival, name, gains=own), f"{name} {sorted(own.items())}"
    else:
        raise InputError(f"no controller is called {name!r}; known: {', '.join(known_names())}, and --policy FILE")
    return Contestant(name=name, group=name, make=make, identity=identity, learned=learns, on_twins=on_twins)


def planned(arm: Arm, twins: Sequence[Twin]) -> Controller:
    """Predictive control on the arms' own twins, with the generic policy or, without one, the feed-forward."""
    holder = shelf_controller(arm) if arm.name in shelf_arms() else _raised(arm, twins)
    return PredictiveController.of(arm, twins, holder)


def _raised(arm: Arm, twins: Sequence[Twin]) -> FeedforwardController:
    """Feed-forward with the stiffness of the arms' own twins."""
    return FeedforwardController(arm, np.stack([twin.parameters.stiffness for twin in twins]))


def learned(path: Path, arm: Arm) -> Contestant:
    """Policy from a file; FileError or ContractError for a wrong one."""
    contract = load_policy(path, arm).contract
    group = f"policy {contract.preset}" + (" on its twin" if contract.twin_digest else "")
    return Contestant(
        name=f"{group} #{contract.seed}",
        group=group,
        make=lambda arm: load_policy(path, arm),
        identity=_digest(path.read_bytes()),
        learned=True,
    )


def on_twin(one: Contestant, twin: Twin, name: str | None = None) -> Contestant:
    """Return a contestant for an arm that has this ``twin``, called so."""
    name = f"{name or one.name} on its twin"
    return replace(one, name=name, group=name, make=one.maker([twin]))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def check_names(contestants: Sequence[Contestant]) -> None:
    """Refuse (InputError) two contestants of one name."""
    names = [one.name for one in contestants]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"these take part twice: {', '.join(twice)}; policies need different training seeds")
