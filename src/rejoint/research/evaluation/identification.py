"""What identification buys: arms, each diagnosed, identified and trained for, under controllers with and without it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.control.comparison.protocols import Columns
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import RunFolder
from rejoint.research.evaluation.contestants import Contestant, classical, learned, on_twin
from rejoint.research.evaluation.evaluate import conclude
from rejoint.research.evaluation.family import find_variant
from rejoint.research.evaluation.summary import Evaluation
from rejoint.research.evaluation.trials import TrialArms, TrialSettings, own_twin, try_on
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.wear import load_wear
from rejoint.system.progress import Progress, part

VARIANT = "identified"
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
    """Compare controllers with and without each arm's twin; ``policies`` are generic."""
    total, merged = settings.family.arms, dict[tuple[str, str], list[Columns]]()
    contestants: list[Contestant] = []
    for i in range(total):
        seed, ahead = settings.family.wear_seed(i), part(on_progress, i / total, (i + 1) / total)
        contestants = _contestants(arm, seed, RunFolder(folder / "arms" / str(seed)), policies, iterations, ahead)
        for one in contestants:
            ahead(0.9, f"arm {seed}: {one.name}")
            found = try_on(arm, bench_of(arm, seed, settings), one.make, settings, lambda done: None)  # noqa: ARG005
            merged.setdefault((VARIANT, one.name), []).append(found)
    outcomes = {
        at: {key: np.concatenate([one[key] for one in parts]) for key in parts[0]} for at, parts in merged.items()
    }
    return conclude(arm, settings, contestants, {VARIANT: "worn arms, each with a twin of its own"}, outcomes, folder)


def _contestants(
    arm: Arm, seed: int, folder: RunFolder, policies: Sequence[Path], iterations: int | None, on_progress: Progress
) -> list[Contestant]:
    """Return controllers without the twin of ``worn?seed=``, and with it, identified and trained for in ``folder``."""
    from rejoint.training.train import TrainingOptions, train  # torch is slow to import, and may not be needed

    twin = own_twin(arm, seed, folder, seed, part(on_progress, 0.0, 0.4, f"arm {seed}: "))
    if not folder.policy.exists():
        options, ahead = (
            TrainingOptions(iterations=iterations, resume=True),
            part(on_progress, 0.4, 0.8, f"arm {seed}: "),
        )
        train(arm, twin, out=folder.path, options=options, on_progress=ahead)
    return [
        *map(classical, ("feedforward", "tuned-feedforward")),
        *(on_twin(classical(name), twin) for name in ("feedforward", "predictive")),
        *(learned(path, arm) for path in policies),
        on_twin(learned(folder.policy, arm), twin, "policy"),
    ]


def bench_of(arm: Arm, wear_seed: int, settings: TrialSettings) -> TrialArms:
    """Return copies of the arm ``worn?seed=``, each with other noise and targets."""
    worn, family, wear = find_variant("worn"), settings.family, load_wear(f"worn?seed={wear_seed}", arm)
    return TrialArms(
        open=lambda: EmulatedRobot(
            arm,
            [wear] * COPIES,
            seed=wear_seed,
            period=worn.period,
            command_latency=worn.latency,
            threads=settings.threads,
        ),
        targets=draw_targets(arm, sets=COPIES, count=max(family.targets, family.crossings), seed=wear_seed),
        wear_seed=np.full(COPIES, float(wear_seed)),
    )
