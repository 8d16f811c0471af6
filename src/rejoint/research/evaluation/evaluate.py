"""Run every contestant on every variant, keep what is done, and sum it up."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rejoint.arms import Arm
from rejoint.logs.runfolder import RunFolder
from rejoint.research.evaluation.contestants import Contestant, check_names
from rejoint.research.evaluation.family import ArmFamily, Variant
from rejoint.research.evaluation.page import write_page
from rejoint.research.evaluation.summary import Evaluation, Outcomes, pool, summarise
from rejoint.research.evaluation.trials import TrialSettings, keep, own_twin, try_controller
from rejoint.system.files import write_json
from rejoint.system.progress import Progress
from rejoint.twin.twin import Twin


def evaluate(
    arm: Arm,
    contestants: Sequence[Contestant],
    variants: Sequence[Variant],
    settings: TrialSettings,
    folder: Path,
    on_progress: Progress,
) -> Evaluation:
    """Evaluate and write ``evaluation.json`` and ``.html`` into ``folder``, outcomes as Parquet below ``outcomes/``.

    An outcome of the same contestant, arms and settings is taken over.
    """
    check_names(contestants)
    family, outcomes = settings.family, {}
    cells = [(variant, one) for variant in variants for one in contestants]
    each = family.arms * (family.targets + family.crossings)
    for number, (variant, one) in enumerate(cells):

        def report(done: int, before: int = number * each, text: str = f"{variant.name}: {one.name}") -> None:
            on_progress((before + done) / (len(cells) * each), text)

        report(0)
        twins = own_twins(arm, family, folder) if variant.anywhere else []
        identity = {
            "arm": arm.name,
            "variant": asdict(variant),
            "controller": one.identity,
            "family": asdict(family),
            "protocol": asdict(settings.protocol),
        }
        outcomes[variant.name, one.name] = keep(
            outcome_path(folder, variant.name, one.name),
            identity,
            lambda: try_controller(arm, variant, one.maker(twins), settings, report, twins),  # noqa: B023 - at once
        )
    return conclude(arm, settings, contestants, {v.name: v.meaning for v in variants}, outcomes, folder)


def own_twins(arm: Arm, family: ArmFamily, folder: Path) -> list[Twin]:
    """Return a twin of each arm of a family, fitted to an excitation of its own."""
    seeds = map(family.wear_seed, range(family.arms))  # one plan of excitation: a few are not safe and are refused
    return [own_twin(arm, seed, RunFolder(folder / "arms" / str(seed)), family.seed) for seed in seeds]


def conclude(
    arm: Arm,
    settings: TrialSettings,
    contestants: Sequence[Contestant],
    meanings: dict[str, str],
    outcomes: Outcomes,
    folder: Path,
) -> Evaluation:
    """Sum up and write ``evaluation.json`` and ``evaluation.html``."""
    result = summarise(arm, settings, contestants, meanings, outcomes)
    write_json(folder / "evaluation.json", result)
    write_page(folder / "evaluation.html", result, pool(contestants, meanings, outcomes))
    return result


def outcome_path(folder: Path, where: str, controller: str) -> Path:
    """Where the trials of a controller on some arms are kept."""
    name = re.sub(r"[^\w.-]+", "-", controller)
    return folder / "outcomes" / f"{where}--{name}.parquet"
