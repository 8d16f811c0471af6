"""Controllers that take part in an evaluation, their trials on many arms, and what is concluded from them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.control.comparison.result import Columns
from rejoint.control.controllers.catalogue import (
    BASELINES,
    PREDICTIVE,
    SHELF,
    make_controller,
    shelf_arms,
    shelf_controller,
    shelf_path,
)
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.controllers.policy import load_policy
from rejoint.control.robot import Controller
from rejoint.system.errors import InputError
from rejoint.system.files import write_json
from rejoint.system.progress import Progress
from rejoint.twin.predictive import PredictiveController
from rejoint.twin.twin import Twin
from rejoint_lab.research.evaluation.family import ArmFamily, Variant
from rejoint_lab.research.evaluation.summary import Evaluation, pool, summarise
from rejoint_lab.research.evaluation.trials import (
    OnTargets,
    keep,
    own_twins,
    try_controller,
)
from rejoint_lab.research.rivals.laws import GAINS, RIVALS, make_rival


@dataclass(frozen=True, kw_only=True, eq=False)
class Contestant:
    """One controller of an evaluation."""

    name: str
    """unique, such as ``policy default #0``"""
    group: str
    """what tables put together: the name without the training seed"""
    make: Callable[[Arm, Sequence[Twin]], Controller]
    """from the twins of the arms, if they have any"""
    identity: str
    """changes with everything that the behaviour depends on, except the software"""
    learned: bool = False

    def on(self, twins: Sequence[Twin]) -> Callable[[Arm], Controller]:
        """Return what makes it for arms with these twins."""
        return lambda arm: self.make(arm, twins)


def known_names() -> tuple[str, ...]:
    """Names that need neither file nor twins."""
    return (*BASELINES, *RIVALS, SHELF)


def classical(name: str, gains: Mapping[str, Mapping[str, float]] | None = None) -> Contestant:
    """Baseline or rival by name; ``gains`` replace its own; InputError names the alternatives."""
    identity, learns, on_twins = name, name == SHELF, {FeedforwardController.name: _raised, PREDICTIVE: planned}
    made: Callable[[Arm], Controller] = partial(make_controller, name)
    if learns:
        made, identity = shelf_controller, _digest(b"".join(shelf_path(arm).read_bytes() for arm in shelf_arms()))
    elif name in RIVALS:
        own = dict((gains or {}).get(name, GAINS[name]))
        made, identity = partial(make_rival, name, gains=own), f"{name} {sorted(own.items())}"
    elif name not in (*BASELINES, PREDICTIVE):
        raise InputError(f"no controller is called {name!r}; known: {', '.join(known_names())}, and --policy FILE")

    def make(arm: Arm, twins: Sequence[Twin]) -> Controller:
        return on_twins[name](arm, twins) if twins and name in on_twins else made(arm)

    return Contestant(name=name, group=name, make=make, identity=identity, learned=learns)


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
        make=lambda arm, _: load_policy(path, arm),
        identity=_digest(path.read_bytes()),
        learned=True,
    )


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


@dataclass(frozen=True, kw_only=True, eq=False)
class Trials:
    """The trials of a contestant under one condition."""

    where: str
    """the condition, as `conclude` names its meaning"""
    contestant: Contestant
    drive: Callable[[OnTargets], Columns]
    identity: str
    """changes with everything else that the results depend on"""


def evaluate(
    arm: Arm,
    contestants: Sequence[Contestant],
    variants: Sequence[Variant],
    family: ArmFamily,
    folder: Path,
    on_progress: Progress,
) -> Evaluation:
    """Evaluate on all variants; InputError for two contestants of one name."""
    names = [one.name for one in contestants]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"these take part twice: {', '.join(twice)}; policies need different training seeds")

    def drive(variant: Variant, one: Contestant, on_targets: OnTargets) -> Columns:
        twins = own_twins(arm, family.wear_seeds, folder, family.seed) if variant.twins else []
        return try_controller(arm, variant, one.on(twins), family, on_targets, twins)

    trials = [
        Trials(where=variant.name, contestant=one, drive=partial(drive, variant, one), identity=repr(variant))
        for variant in variants
        for one in contestants
    ]
    meanings = {variant.name: variant.meaning for variant in variants}
    return conclude(arm, meanings, trials, family, folder / "evaluation.json", on_progress)


def conclude(
    arm: Arm,
    meanings: dict[str, str],
    trials: Sequence[Trials],
    family: ArmFamily,
    file: Path,
    on_progress: Progress,
) -> Evaluation:
    """Drive, sum up and write the JSON ``file``, and outcomes as Parquet in ``outcomes`` beside it.

    An outcome of the same contestant, condition and settings is taken over. ``meanings`` say what conditions are.
    """
    outcomes, each = {}, family.arms * (family.targets + family.crossings)
    for number, one in enumerate(trials):
        text, begun = f"{one.where}: {one.contestant.name}", number / len(trials)
        identity = repr((arm.name, one.identity, one.contestant.identity, family))

        def report(done: int, text: str = text, begun: float = begun) -> None:
            on_progress(begun + done / each / len(trials), text)

        report(0)
        path = outcome_path(file.parent, one.where, one.contestant.name)
        outcomes[one.where, one.contestant.name] = keep(path, identity, partial(one.drive, report))
    contestants = [one.contestant for one in trials]
    pooled = pool({one.name: one.group for one in contestants}, outcomes)
    result = summarise(arm.name, family, meanings, pooled, {one.group for one in contestants if one.learned})
    write_json(file, result)
    return result


def outcome_path(folder: Path, where: str, controller: str) -> Path:
    """Where the trials of a controller on some arms are kept."""
    name = re.sub(r"[^\w.-]+", "-", f"{where}--{controller}")
    return folder / "outcomes" / f"{name}.parquet"
