"""Run every contestant on every variant, keep what is done, and sum it up."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rejoint.arms import Arm
from rejoint.research.evaluation.contestants import Contestant, check_names
from rejoint.research.evaluation.family import Variant
from rejoint.research.evaluation.outcome import Outcome, read_outcome, write_outcome
from rejoint.research.evaluation.page import write_page
from rejoint.research.evaluation.result import Evaluation
from rejoint.research.evaluation.summary import Outcomes, group, summarise
from rejoint.research.evaluation.trials import OnTargets, TrialSettings, try_controller
from rejoint.system.files import write_json
from rejoint.system.progress import Progress
from rejoint.system.version import __version__


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialCell:
    """One contestant on one variant; it can be tried in any process, and leaves its outcome as a file."""

    arm: Arm
    variant: Variant
    contestant: Contestant
    settings: TrialSettings
    folder: Path

    @property
    def key(self) -> tuple[str, str]:
        """Names of variant and contestant."""
        return self.variant.name, self.contestant.name

    def kept(self) -> Outcome | None:
        """Return the outcome of the very same contestant, arms and settings, if it is there."""
        return read_outcome(*self._file())

    def try_it(self, on_targets: OnTargets = lambda _: None) -> Outcome:
        """Try the contestant, and write the outcome."""
        found = try_controller(self.arm, self.variant, self.contestant.make, self.settings, on_targets)
        path, identity = self._file()
        write_outcome(path, found, identity)
        return found

    def leave_outcome(self) -> None:
        """Try the contestant, and leave the outcome in its file alone."""
        self.try_it()

    def _file(self) -> tuple[Path, dict[str, Any]]:
        identity = _identity(self.arm, self.variant, self.contestant, self.settings)
        return outcome_path(self.folder, self.variant, self.contestant), identity


def evaluate(
    arm: Arm,
    contestants: Sequence[Contestant],
    variants: Sequence[Variant],
    settings: TrialSettings,
    folder: Path,
    on_progress: Progress,
    elsewhere: Callable[[Sequence[TrialCell]], object] | None = None,
) -> Evaluation:
    """Evaluate and write ``evaluation.json`` and ``.html`` into ``folder``, outcomes as Parquet below ``outcomes/``.

    An outcome that is there already, of the very same contestant, arms and settings, is taken over. ``elsewhere`` is
    given the cells that are not there, and has them tried by other processes; what it leaves out is tried here.
    """
    check_names(contestants)
    family = settings.family
    cells = [
        TrialCell(arm=arm, variant=variant, contestant=one, settings=settings, folder=folder)
        for variant in variants for one in contestants
    ]  # fmt: skip
    if elsewhere is not None:
        elsewhere([cell for cell in cells if cell.kept() is None])
    each = family.arms * (family.targets + (family.crossings if settings.crossing else 0))
    outcomes: dict[tuple[str, str], Outcome] = {}
    for cell in cells:
        before, text = len(outcomes) * each, ": ".join(cell.key)
        on_progress(before / (len(cells) * each), text)

        def report(done: int, before: int = before, text: str = text) -> None:
            on_progress((before + done) / (len(cells) * each), text)

        outcomes[cell.key] = cell.kept() or cell.try_it(report)
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
