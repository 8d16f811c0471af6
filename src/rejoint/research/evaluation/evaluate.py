"""Run every contestant on every variant, keep what is done, and sum it up."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rejoint.arms import Arm
from rejoint.research.evaluation.contestants import Contestant, check_names
from rejoint.research.evaluation.family import Variant
from rejoint.research.evaluation.outcome import Outcome, read_outcome, write_outcome
from rejoint.research.evaluation.page import write_page
from rejoint.research.evaluation.result import Evaluation
from rejoint.research.evaluation.summary import Outcomes, group, summarise
from rejoint.research.evaluation.trials import TrialSettings, try_controller
from rejoint.system.files import write_json
from rejoint.system.progress import Progress
from rejoint.system.version import __version__


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
    family, cells = settings.family, len(contestants) * len(variants)
    each = family.arms * (family.targets + (family.crossings if settings.crossing else 0))
    outcomes: dict[tuple[str, str], Outcome] = {}
    for variant in variants:
        for one in contestants:
            before, text = len(outcomes) * each, f"{variant.name}: {one.name}"
            on_progress(before / (cells * each), text)
            path, identity = outcome_path(folder, variant, one), _identity(arm, variant, one, settings)
            found = read_outcome(path, identity)
            if found is None:

                def report(done: int, before: int = before, text: str = text) -> None:
                    on_progress((before + done) / (cells * each), text)

                found = try_controller(arm, variant, one.make, settings, report)
                write_outcome(path, found, identity)
            outcomes[variant.name, one.name] = found
    return conclude(arm, settings, contestants, {v.name: v.meaning for v in variants}, outcomes, folder)


def conclude(
    arm: Arm, settings: TrialSettings, contestants: Sequence[Contestant], meanings: dict[str, str], outcomes: Outcomes,
    folder: Path,
) -> Evaluation:  # fmt: skip
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
        "arm": arm.name, "variant": asdict(variant), "controller": contestant.identity,
        "family": asdict(settings.family), "protocol": asdict(settings.protocol), "crossing": settings.crossing,
        "software": __version__,
    }  # fmt: skip
