"""Run every contestant on every variant, keep what is done, and sum it up."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rejoint.arms import Arm
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.research.evaluation.contestants import Contestant, check_names
from rejoint.research.evaluation.family import ArmFamily, Variant
from rejoint.research.evaluation.outcome import Outcome, read_outcome, write_outcome
from rejoint.research.evaluation.page import write_page
from rejoint.research.evaluation.summary import Evaluation, Outcomes, group, summarise
from rejoint.research.evaluation.trials import TrialSettings, own_twin, try_controller
from rejoint.system.files import write_json
from rejoint.system.progress import Progress
from rejoint.system.shell import __version__
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

    An outcome that is there already, of the very same contestant, arms and settings, is taken over.
    """
    check_names(contestants)
    family = settings.family
    cells = [(variant, one) for variant in variants for one in contestants]
    each = family.arms * (family.targets + (family.crossings if settings.crossing else 0))
    outcomes: dict[tuple[str, str], Outcome] = {}
    for number, (variant, one) in enumerate(cells):
        text = f"{variant.name}: {one.name}"

        def report(done: int, before: int = number * each, text: str = text) -> None:
            on_progress((before + done) / (len(cells) * each), text)

        report(0)
        path, identity = outcome_path(folder, variant, one), _identity(arm, variant, one, settings)
        found = read_outcome(path, identity)
        if found is None:
            twins = own_twins(arm, family, folder) if variant.anywhere else []
            found = try_controller(arm, variant, one.maker(twins), settings, report, twins)
            write_outcome(path, found, identity)
        outcomes[variant.name, one.name] = found
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
    groups = group(contestants)
    pooled = {(v, name): [outcomes[v, one] for one in ones] for v in meanings for name, ones in groups.items()}
    write_page(folder / "evaluation.html", result, pooled)
    return result


def outcome_path(folder: Path, variant: Variant, contestant: Contestant) -> Path:
    """Where the trials of a contestant on a variant are kept."""
    name = re.sub(r"[^\w.-]+", "-", contestant.name)
    return folder / "outcomes" / f"{variant.name}--{name}.parquet"


def _identity(arm: Arm, variant: Variant, contestant: Contestant, settings: TrialSettings) -> dict[str, Any]:
    return {
        "arm": arm.name,
        "variant": asdict(variant),
        "controller": contestant.identity,
        "family": asdict(settings.family),
        "protocol": asdict(settings.protocol),
        "crossing": settings.crossing,
        "software": __version__,
    }
