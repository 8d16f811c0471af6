"""Run every contestant on every variant, keep what is done, and sum it up."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rejoint.arms import Arm
from rejoint.control.comparison.protocols import Columns
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.logs.runlog import read_parquet
from rejoint.research.evaluation.contestants import Contestant, check_names
from rejoint.research.evaluation.family import ArmFamily, Variant
from rejoint.research.evaluation.page import write_page
from rejoint.research.evaluation.summary import Evaluation, Outcomes, pool, summarise
from rejoint.research.evaluation.trials import TrialSettings, own_twin, try_controller
from rejoint.system.errors import FileError
from rejoint.system.files import write_json, write_whole
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
    outcomes: dict[tuple[str, str], Columns] = {}
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
    write_page(folder / "evaluation.html", result, pool(contestants, meanings, outcomes))
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


_IDENTITY = b"rejoint.research.evaluation"


def write_outcome(path: Path, found: Columns, identity: dict[str, Any]) -> None:
    """Write results as a tidy table, a row per arm and target; ``identity`` says what they belong to."""
    table = pa.table({name: values.ravel() for name, values in found.items()})
    table = table.replace_schema_metadata({_IDENTITY: json.dumps(identity).encode()})
    write_whole(path, lambda temporary: pq.write_table(table, temporary, compression="zstd", write_page_checksum=True))


def read_outcome(path: Path, identity: dict[str, Any]) -> Columns | None:
    """Read results; None if missing, damaged, or of another identity."""
    try:
        table = read_parquet(path, "delete it")
        if json.loads((table.schema.metadata or {})[_IDENTITY]) != json.loads(json.dumps(identity)):
            return None
        count = int(np.max(table["target"])) + 1
        return {name: table[name].to_numpy().reshape(-1, count) for name in table.column_names}
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, RecursionError, FileError):
        return None
