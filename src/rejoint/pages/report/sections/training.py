"""The section about the training: curves, and what the policy file promises."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from rejoint.arms import Array
from rejoint.control.contract import PolicyContract
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.logs.runlog import read_parquet
from rejoint.pages.report import palette
from rejoint.pages.report.figures import training_curves
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.numerals import number
from rejoint.pages.report.view import Part, Section
from rejoint.pages.report.words import cycles
from rejoint.system.errors import FileError, first_line

KEY, SHORT, HEADING = "training", "Training", "Training of the policy"

_COLUMNS = ("step", "reward", "success_rate", "error_mm", "wall_s")
_LAST = 5  # updates that are averaged for "at the end"


@dataclass(frozen=True, kw_only=True, eq=False)
class Curves:
    """Training curves with one entry per update, K updates."""

    step: Array
    """(K,) transitions so far"""
    reward: Array
    """(K,) mean per control cycle"""
    success_rate: Array
    """(K,) fraction of the targets"""
    error_mm: Array
    """(K,) median distance at the end of a target"""
    wall_s: Array
    """(K,) time since the start"""


def read_curves(path: Path) -> Curves:
    """Read ``training/curves.parquet``; FileError if it is damaged or holds no update."""
    remedy = "delete it and train again"
    try:
        table = read_parquet(path, remedy, list(_COLUMNS))
        columns = {name: table[name].to_numpy().astype(float) for name in _COLUMNS}
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "train a policy first") from error
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError) as error:
        first = first_line(error)
        raise FileError(path, f"not readable as training curves ({first})", remedy) from error
    if not len(columns["step"]):
        raise FileError(path, "no update in the training curves", remedy)
    return Curves(**columns)


def draw_training(folder: RunFolder) -> Path:
    """Draw the training curves of a run alone, as the PNG file that the report would write; returns its path."""
    gallery = Gallery()
    training_section(read_curves(folder.outputs.curves), None, gallery)
    return gallery.save(folder.figures)[0]


def training_section(curves: Curves | None, contract: PolicyContract | None, gallery: Gallery) -> Section:
    """Build the section from the curves and the contract, either of which may be missing."""
    parts = []
    if curves is not None:
        of_twin = contract is not None and bool(contract.twin_digest)
        parts.append(_curves(curves, "copies of the twin" if of_twin else "simulated arms", gallery))
    if contract is not None:
        parts.append(Part(heading="The policy file", facts=_facts(contract)))
    return Section(key=KEY, short=SHORT, heading=HEADING, parts=tuple(parts))


def _curves(curves: Curves, pupils: str, gallery: Gallery) -> Part:
    success, error = (float(np.mean(values[-_LAST:])) for values in (curves.success_rate, curves.error_mm))
    figure = training_curves(
        curves.step,
        (
            ("reward per control cycle", curves.reward),
            ("success rate [%]", 100 * curves.success_rate),
            ("median error at the end of a target [mm]", curves.error_mm),
        ),
        palette.BLUE,
    )
    outcome = f"{number(100 * success, 3, '%')} success and a median error of {number(error, 2, 'mm')}"
    picture = gallery.show(
        "training", figure,
        alt=f"Reward, success rate and error over {cycles(curves.step[-1])}; "
        f"at the end: {outcome}.",
    )  # fmt: skip
    text = (
        f"The policy learned by trial and error on randomised {pupils}: {cycles(curves.step[-1])} in "
        f"{number(curves.wall_s[-1], 2, 's')}, without a motion of the arm. In training, with the noise of "
        f"exploration, it ended at {outcome}."
    )
    return Part(texts=(text,), figures=(picture,))


def _facts(contract: PolicyContract) -> tuple[tuple[str, str], ...]:
    periods = f"{1e3 * contract.min_period:.0f} to {1e3 * contract.max_period:.0f}\N{NO-BREAK SPACE}ms"
    return (
        ("arm", contract.arm),
        ("recipe", contract.preset),
        ("seed", str(contract.seed)),
        ("control periods met in training", periods),
        ("observation", f"{contract.observation_size} numbers ({contract.layout})"),
        ("twin it was trained on", contract.twin_digest or "none: broad ranges alone"),
        ("software", contract.software),
    )
