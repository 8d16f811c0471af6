"""Controllers that take part in an evaluation, their trials on many arms, and what is concluded from them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
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
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import RunFolder
from rejoint.system.errors import InputError
from rejoint.system.files import write_json
from rejoint.system.progress import Progress, part
from rejoint.twin.predictive import PredictiveController
from rejoint.twin.twin import Twin
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.family import Variant
from rejoint_lab.research.evaluation.summary import Evaluation, pool, summarise
from rejoint_lab.research.evaluation.trials import (
    OnTargets,
    TrialArms,
    TrialSettings,
    keep,
    own_twin,
    own_twins,
    try_controller,
    try_on,
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


def on_twin(one: Contestant, twin: Twin, name: str | None = None) -> Contestant:
    """Return a contestant for an arm that has this ``twin``, called so."""
    name, identity = f"{name or one.name} on its twin", f"{one.identity} {twin.digest()}"
    return replace(one, name=name, group=name, identity=identity, make=lambda arm, _: one.make(arm, [twin]))


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
    settings: TrialSettings,
    folder: Path,
    on_progress: Progress,
) -> Evaluation:
    """Evaluate on all variants; InputError for two contestants of one name."""
    names = [one.name for one in contestants]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"these take part twice: {', '.join(twice)}; policies need different training seeds")

    def drive(variant: Variant, one: Contestant, on_targets: OnTargets) -> Columns:
        family = settings.family
        twins = own_twins(arm, family.wear_seeds, folder, family.seed) if variant.anywhere else []
        return try_controller(arm, variant, one.on(twins), settings, on_targets, twins)

    trials = [
        Trials(where=variant.name, contestant=one, drive=partial(drive, variant, one), identity=repr(variant))
        for variant in variants
        for one in contestants
    ]
    meanings = {variant.name: variant.meaning for variant in variants}
    return conclude(arm, meanings, trials, settings, folder / "evaluation.json", on_progress)


def conclude(
    arm: Arm,
    meanings: dict[str, str],
    trials: Sequence[Trials],
    settings: TrialSettings,
    file: Path,
    on_progress: Progress,
) -> Evaluation:
    """Drive, sum up and write the JSON ``file``, and outcomes as Parquet in ``outcomes`` beside it.

    An outcome of the same contestant, condition and settings is taken over. ``meanings`` say what conditions are.
    """
    family, outcomes = settings.family, {}
    each = family.arms * (family.targets + family.crossings)
    for number, one in enumerate(trials):
        text, begun = f"{one.where}: {one.contestant.name}", number / len(trials)
        identity = repr((arm.name, one.identity, one.contestant.identity, family, settings.protocol))

        def report(done: int, text: str = text, begun: float = begun) -> None:
            on_progress(begun + done / each / len(trials), text)

        report(0)
        path = outcome_path(file.parent, one.where, one.contestant.name)
        outcomes[one.where, one.contestant.name] = keep(path, identity, partial(one.drive, report))
    contestants = [one.contestant for one in trials]
    pooled = pool({one.name: one.group for one in contestants}, outcomes)
    result = summarise(arm.name, settings, meanings, pooled, {one.group for one in contestants if one.learned})
    write_json(file, result)
    return result


def outcome_path(folder: Path, where: str, controller: str) -> Path:
    """Where the trials of a controller on some arms are kept."""
    name = re.sub(r"[^\w.-]+", "-", f"{where}--{controller}")
    return folder / "outcomes" / f"{name}.parquet"


# --- what identification brings ---------------------------------------------------------------

IDENTIFIED = "identified"
"""Name of the condition"""
COPIES = 8
"""Trials of one arm side by side (chosen)"""


def evaluate_identification(
    arm: Arm,
    policies: Sequence[Path],
    settings: TrialSettings,
    folder: Path,
    iterations: int | None,
    on_progress: Progress,
) -> Evaluation:
    """Compare controllers with and without each arm's own twin; ``policies`` are generic."""
    seeds, own = settings.family.wear_seeds, list[list[Contestant]]()
    for i, seed in enumerate(seeds):
        ahead = part(on_progress, 0.9 * i / len(seeds), 0.9 * (i + 1) / len(seeds), f"arm {seed}: ")
        own.append(_contestants(arm, seed, RunFolder(folder / "arms" / str(seed)), policies, iterations, ahead))

    def drive(ones: Sequence[Contestant], _: OnTargets) -> Columns:
        copies = [copies_of(arm, seed, settings) for seed in seeds]
        parts = [try_on(arm, arms, one.on(()), settings) for arms, one in zip(copies, ones, strict=True)]
        return {key: np.concatenate([one[key] for one in parts]) for key in parts[0]}

    trials = [
        Trials(
            where=IDENTIFIED,
            contestant=ones[0],
            drive=partial(drive, ones),
            identity=" ".join(one.identity for one in ones),
        )
        for ones in zip(*own, strict=True)
    ]
    meanings = {IDENTIFIED: "worn arms, each with a twin of its own"}
    return conclude(arm, meanings, trials, settings, folder / "evaluation.json", part(on_progress, 0.9, 1.0))


def _contestants(
    arm: Arm, seed: int, folder: RunFolder, policies: Sequence[Path], iterations: int | None, on_progress: Progress
) -> list[Contestant]:
    """Return controllers without the twin of ``worn?seed=``, and with it, identified and trained for in ``folder``."""
    from rejoint.training.train import TrainingOptions, train  # torch is slow to import, and may not be needed

    twin = own_twin(arm, seed, folder, seed, part(on_progress, 0.0, 0.5))
    if not folder.policy.exists():
        options = TrainingOptions(iterations=iterations, resume=True)
        train(arm, twin, out=folder.path, options=options, on_progress=part(on_progress, 0.5, 1.0))
    return [
        *map(classical, ("feedforward", "tuned-feedforward")),
        *(on_twin(classical(name), twin) for name in ("feedforward", "predictive")),
        *(learned(path, arm) for path in policies),
        on_twin(learned(folder.policy, arm), twin, "policy"),
    ]


def copies_of(arm: Arm, wear_seed: int, settings: TrialSettings) -> TrialArms:
    """Return copies of the arm ``worn?seed=``, each with other noise and targets."""
    family, wear = settings.family, load_wear(f"worn?seed={wear_seed}", arm)
    return TrialArms(
        open=lambda: EmulatedRobot(arm, [wear] * COPIES, seed=wear_seed, threads=settings.threads),
        targets=draw_targets(arm, sets=COPIES, count=max(family.targets, family.crossings), seed=wear_seed),
        wear_seeds=[wear_seed] * COPIES,
    )
