"""What identification buys: arms that are diagnosed, identified and trained for one by one.

Each arm then meets controllers that know its twin and controllers that do not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.control.comparison.protocols import Columns
from rejoint.control.controller import Controller
from rejoint.control.feedforward import FeedforwardController
from rejoint.control.policy import load_policy
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.research.evaluation.contestants import Contestant, classical, learned, planned
from rejoint.research.evaluation.evaluate import conclude
from rejoint.research.evaluation.family import find_variant
from rejoint.research.evaluation.summary import Evaluation
from rejoint.research.evaluation.trials import TrialArms, TrialSettings, own_twin, try_on
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.wear import load_wear
from rejoint.system.progress import Progress, part
from rejoint.twin.twin import Twin

VARIANT = "identified"

COPIES = 8
"""Trials of one arm side by side (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownArm:
    """An arm that went through the chain."""

    wear_seed: int
    twin: Twin
    policy: Path


def know_arm(arm: Arm, wear_seed: int, folder: RunFolder, iterations: int | None, on_progress: Progress) -> KnownArm:
    """Diagnose, identify and train for ``worn?seed=``, or read ``folder``."""
    from rejoint.training.train import TrainingOptions, train  # torch is slow to import, and may not be needed

    twin = own_twin(arm, wear_seed, folder, wear_seed, on_progress)
    if not folder.policy.exists():
        options = TrainingOptions(iterations=iterations, resume=True)
        train(arm, twin, out=folder.path, options=options, on_progress=on_progress)
    return KnownArm(wear_seed=wear_seed, twin=twin, policy=folder.policy)


def evaluate_identification(
    arm: Arm,
    policies: Sequence[Path],
    settings: TrialSettings,
    folder: Path,
    iterations: int | None,
    on_progress: Progress,
) -> Evaluation:
    """Compare controllers with and without each arm's twin; ``policies`` are generic."""
    family = settings.family
    total, merged = family.arms, dict[str, list[Columns]]()
    contestants: list[Contestant] = []
    for i in range(family.arms):
        seed = family.wear_seed(i)

        chain = part(on_progress, i / total, (i + 0.8) / total, f"arm {seed}: ")
        known = know_arm(arm, seed, RunFolder(folder / "arms" / str(seed)), iterations, chain)
        contestants = _contestants(arm, known, policies)
        for k, one in enumerate(contestants):
            on_progress((i + 0.8 + 0.2 * k / len(contestants)) / total, f"arm {seed}: {one.name}")
            found = try_on(arm, bench_of(arm, seed, settings), one.make, settings, lambda done: None)  # noqa: ARG005
            merged.setdefault(one.name, []).append(found)
    outcomes = {
        (VARIANT, name): {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        for name, parts in merged.items()
    }
    meanings = {VARIANT: "worn arms, each with a twin of its own"}
    return conclude(arm, settings, contestants, meanings, outcomes, folder)


def _contestants(arm: Arm, known: KnownArm, policies: Sequence[Path]) -> list[Contestant]:
    """Return controllers without the arm's twin, and with it."""
    own = known.twin.parameters

    def make(build: Callable[[Arm], Controller], name: str) -> Contestant:
        return Contestant(name=name, group=name, make=build, identity=name)

    return [
        classical("feedforward"),
        classical("tuned-feedforward"),
        make(lambda arm: FeedforwardController(arm, own.stiffness), "feedforward on its twin"),
        make(lambda arm: planned(arm, [known.twin]), "predictive on its twin"),
        *(learned(path, arm) for path in policies),
        Contestant(
            name="policy on its twin",
            group="policy on its twin",
            make=lambda arm: load_policy(known.policy, arm),
            identity="",
            learned=True,
        ),
    ]


def bench_of(arm: Arm, wear_seed: int, settings: TrialSettings) -> TrialArms:
    """Return copies of the arm ``worn?seed=``, each with other noise and targets."""
    worn, family = find_variant("worn"), settings.family

    def open_copies() -> EmulatedRobot:
        wear = load_wear(f"worn?seed={wear_seed}", arm)
        return EmulatedRobot(
            arm,
            [wear] * COPIES,
            seed=wear_seed,
            period=worn.period,
            command_latency=worn.latency,
            threads=settings.threads,
        )

    targets = draw_targets(arm, sets=COPIES, count=max(family.targets, family.crossings), seed=wear_seed)
    return TrialArms(open=open_copies, targets=targets, wear_seed=np.full(COPIES, float(wear_seed)))
