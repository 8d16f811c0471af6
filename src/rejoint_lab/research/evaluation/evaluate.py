"""Controllers that take part in an evaluation, their trials on many arms, and what is concluded from them.

Intervals resample whole arms.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.result import Columns, ControllerRow, Protocol, cycle_times
from rejoint.control.comparison.result import summarise as summarise_trials
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
from rejoint.pages.report.tables import ResultColumn, plain_table, result_columns
from rejoint.pages.words import MM, Cell, measured, number
from rejoint.system.errors import InputError
from rejoint.system.files import write_json
from rejoint.system.progress import Progress
from rejoint.system.shell import __version__
from rejoint.system.statistics import Estimate, Labels, Spread, bootstrap_mean, clustered_share
from rejoint.twin.predictive import PredictiveController
from rejoint.twin.twin import Twin
from rejoint_lab.research.evaluation.family import ArmFamily, OnTargets, Variant, keep, own_twins, try_controller
from rejoint_lab.research.rivals import GAINS, RIVALS, make_rival


class Contestant(NamedTuple):
    """One controller of an evaluation."""

    name: str
    """unique, such as ``policy default #0``"""
    make: Callable[[Arm, Sequence[Twin]], Controller]
    """from the twins of the arms, if they have any"""
    identity: str
    """changes with everything that the behaviour depends on, except the software"""
    learned: bool = False


KNOWN = (*BASELINES, *RIVALS, SHELF)
"""Names that need neither file nor twins"""


def classical(name: str, gains: Mapping[str, Mapping[str, float]] | None = None) -> Contestant:
    """Baseline or rival by name; ``gains`` replace its own; InputError names the alternatives."""
    identity, on_twins = name, {FeedforwardController.name: _raised, PREDICTIVE: planned}.get(name)
    made: Callable[[Arm], Controller] = partial(make_controller, name)
    if name == SHELF:
        made, identity = shelf_controller, _digest(b"".join(shelf_path(arm).read_bytes() for arm in shelf_arms()))
    elif name in RIVALS:
        own = dict((gains or {}).get(name, GAINS[name]))
        made, identity = partial(make_rival, name, gains=own), f"{name} {sorted(own.items())}"
    elif name not in (*BASELINES, PREDICTIVE):
        raise InputError(f"no controller is called {name!r}; known: {', '.join(KNOWN)}, and --policy FILE")
    return Contestant(
        name, lambda arm, twins: on_twins(arm, twins) if twins and on_twins else made(arm), identity, name == SHELF
    )


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
    name = f"policy {contract.preset}{' on its twin' if contract.twin_digest else ''} #{contract.seed}"
    return Contestant(name, lambda arm, _: load_policy(path, arm), _digest(path.read_bytes()), learned=True)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def group_of(name: str) -> str:
    """Return what tables put together: the name of a contestant without its training seed."""
    return name.partition(" #")[0]


class Trials(NamedTuple):
    """The trials of a contestant under one condition."""

    identity: str
    """changes with everything that the results depend on"""
    drive: Callable[[OnTargets], Columns]


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
        return try_controller(arm, variant, lambda arm: one.make(arm, twins), family, on_targets, twins)

    trials = {
        (variant.name, one.name): Trials(f"{variant!r}, {one.identity}", partial(drive, variant, one))
        for variant in variants
        for one in contestants
    }
    policies = {group_of(one.name) for one in contestants if one.learned}
    meanings = {variant.name: variant.meaning for variant in variants}
    return conclude(arm, meanings, trials, policies, family, folder / "evaluation.json", on_progress)


def conclude(
    arm: Arm,
    meanings: dict[str, str],
    trials: Mapping[tuple[str, str], Trials],
    learned: Collection[str],
    family: ArmFamily,
    file: Path,
    on_progress: Progress,
) -> Evaluation:
    """Drive ``trials`` of condition and contestant, sum up and write the JSON ``file``, outcomes as Parquet beside it.

    An outcome of the same identity and family is taken over. ``meanings`` say what conditions are; the groups
    ``learned`` are no rivals.
    """
    outcomes, each = {}, family.arms * (family.targets + family.crossings)
    for place, ((where, name), one) in enumerate(trials.items()):

        def report(done: int, text: str = f"{where}: {name}", place: int = place) -> None:
            on_progress((place + done / each) / len(trials), text)

        report(0)
        identity = repr((arm.name, one.identity, family))
        outcomes[where, name] = keep(outcome_path(file.parent, where, name), identity, partial(one.drive, report))
    result = summarise(arm.name, family, meanings, outcomes, learned)
    write_json(file, result)
    return result


def outcome_path(folder: Path, where: str, controller: str) -> Path:
    """Where the trials of a controller on some arms are kept."""
    name = re.sub(r"[^\w.-]+", "-", f"{where}--{controller}")
    return folder / "outcomes" / f"{name}.parquet"


FAR = 0.005
"""[m] settled encoder error beyond which a hold counts as failed"""


@dataclass(frozen=True, kw_only=True)
class VariantRow(ControllerRow):
    """One controller, or several seeds of a learner together, on one variant."""

    variant: str
    seeds: int
    """trainings that are put together"""
    outside: Estimate | None
    """share of holds beyond 5 mm or stopped"""
    inside: Estimate | None
    """share of targets whose true error was in the calibration's interval"""
    used: float | None
    """share of arms that a calibration corrected"""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A controller against another, target by target on the same arms."""

    variant: str
    controller: str
    rival: str
    differences: dict[str, Estimate | None]
    """[m] or [s] mean differences by column, negative where the controller is better; never: the hold's length"""
    worst_true: float | None
    """[m] that of the settled true error on the arm where it is largest"""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Everything."""

    arm: str
    software: str
    family: ArmFamily
    meanings: dict[str, str]
    """of the variants, in words"""
    rows: tuple[VariantRow, ...]
    best: dict[str, str]
    """per variant, the rival that is soonest within the narrowest distance"""
    pairs: tuple[Pair, ...]

    def on(self, variant: str) -> list[VariantRow]:
        """Rows of a variant."""
        return [row for row in self.rows if row.variant == variant]


def summarise(
    arm: str,
    family: ArmFamily,
    meanings: dict[str, str],
    outcomes: Mapping[tuple[str, str], Columns],
    learned: Collection[str],
) -> Evaluation:
    """Compute every number of an evaluation.

    ``outcomes``: results (T, K) of T trials by variant and contestant, see `try_on`; ``meanings`` and ``learned`` as in
    `conclude`.
    """
    members: dict[tuple[str, str], list[Columns]] = {}
    for (variant, name), found in outcomes.items():
        members.setdefault((variant, group_of(name)), []).append(found)
    pooled = {at: together(found) for at, found in members.items()}
    rows = tuple(make_row(*key, found, family.protocol) for key, found in pooled.items())
    rivals = {one: [row for row in rows if row.variant == one and row.controller not in learned] for one in meanings}
    pairs = (
        make_pair((variant, group), rival, (ours, theirs), family.protocol)
        for (variant, group), ours in pooled.items()
        for (where, rival), theirs in pooled.items()
        if group in learned and where == variant and rival != group
    )
    return Evaluation(
        arm=arm,
        software=__version__,
        family=family,
        meanings=meanings,
        rows=rows,
        best={variant: min(some, key=_late).controller for variant, some in rivals.items() if some},
        pairs=tuple(pairs),
    )


def together(found: Sequence[Columns]) -> Columns:
    """Put the results (T, K) of training seeds together: (T, seeds, K)."""
    return {key: np.stack([one[key] for one in found], axis=1) for key in found[0]}


def make_row(variant: str, controller: str, found: Columns, protocol: Protocol) -> VariantRow:
    """Summarise the results (T, seeds, K) of a controller."""
    arms = _arms(found)
    row, held = summarise_trials(controller, found, arms, protocol), found["held"] == 1.0
    outside = np.where(held, ~(found["settled"] <= FAR), np.nan).ravel()
    hit = inside(found).ravel()
    return VariantRow(
        **vars(row),
        variant=variant,
        seeds=held.shape[1],
        outside=clustered_share(outside, arms) if held.any() else None,
        inside=clustered_share(hit, arms) if np.isfinite(hit).any() and row.settled_modelled is not None else None,
        used=float(found["used"].mean()) if "used" in found else None,
    )


def inside(found: Columns) -> Array:
    """1 where a true error lies in the interval of the calibration, else 0; NaN where a hold was cut short."""
    error = found["settled_true"]
    hit = (error >= found["modelled_low"]) & (error <= found["modelled_high"])
    return np.where(np.isfinite(error), hit, np.nan)


def make_pair(where: tuple[str, str], rival: str, results: tuple[Columns, Columns], protocol: Protocol) -> Pair:
    """Compare the controller of ``where`` with a rival: each seed with each, on the same arm and target."""
    arms, apart = np.unique(_arms(results[0])), dict[str, Array]()
    ours, theirs = (found | {"cycle_time": cycle_times(found)[..., None]} for found in results)
    for name in ("settled", "settled_true", *protocol.stay_names, "cycle_time"):
        # Arms stay the first axis, so that a resampled arm brings all its seeds along.
        apart[name] = (ours[name][:, :, None] - theirs[name][:, None]).reshape(len(arms), -1)
    return Pair(
        variant=where[0],
        controller=where[1],
        rival=rival,
        differences={name: difference(values) for name, values in apart.items()},
        worst_true=worst(apart["settled_true"]),
    )


def difference(apart: Array, *, seed: int = 0) -> Estimate | None:
    """Mean of differences (A, K) on A arms over what both have."""
    arms = np.repeat(np.arange(len(apart)), apart.shape[1])
    return bootstrap_mean(apart.ravel(), arms, seed=seed) if np.isfinite(apart).any() else None


def worst(apart: Array) -> float | None:
    """Largest mean of differences (A, K) of one arm."""
    largest = np.ma.masked_invalid(apart).mean(axis=1).max()
    return None if largest is np.ma.masked else float(largest)


def _arms(found: Columns) -> Labels:
    """Return the number of the arm of each result (T, seeds, K), flat."""
    return np.unique(found["arm"], return_inverse=True)[1].ravel()


def _late(row: VariantRow) -> tuple[float, float]:
    """Rank of a rival: who is soonest within the narrowest distance, else the nearest."""
    return row.stays[-1].median or np.inf, np.inf if row.settled is None else row.settled.mean.value


COLUMNS: dict[str, Callable[[VariantRow], Cell]] = {
    "95 % below, encoders [mm]": lambda row: _p95(row.settled, 3),
    "95 % below, true [mm]": lambda row: _p95(row.settled_true, 2),
    "farther than 5 mm [%]": lambda row: measured(row.outside, 100.0),
}
"""of all evaluations, besides those of a comparison"""
CALIBRATED: dict[str, Callable[[VariantRow], Cell]] = {
    "expected by the calibration [mm]": lambda row: Cell(
        "" if row.settled_modelled is None else row.settled_modelled.millimetres
    ),
    "in its interval [%]": lambda row: measured(row.inside, 100.0),
    "corrected arms [%]": lambda row: Cell(number(row.used and 100 * row.used, 3)),
}
"""where arms are calibrated"""


def terminal_tables(evaluation: Evaluation) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, headers and rows of a table per variant, and of pairs with its best rival."""
    family, calibrated = evaluation.family, any(row.inside is not None for row in evaluation.rows)
    columns = [
        *result_columns(family.protocol, max(family.targets, family.crossings)),
        *(
            ResultColumn(header, cast("Callable[[ControllerRow], Cell]", cell))
            for header, cell in (COLUMNS | CALIBRATED if calibrated else COLUMNS).items()
        ),
    ]
    tables = [(f"{one}: {family.arms} arms", *plain_table(columns, evaluation.on(one))) for one in evaluation.meanings]
    pairs = [one for one in evaluation.pairs if one.rival == evaluation.best.get(one.variant)]
    if pairs:
        factor = {name: (MM, "[mm]") if name.startswith("settled") else (1.0, "[s]") for name in pairs[0].differences}
        headers = ["variant", "against the best rival", "worst arm, true [mm]"]
        headers += [f"{name} {unit}" for name, (_, unit) in factor.items()]
        rows = [
            [
                pair.variant,
                f"{pair.controller} against {pair.rival}",
                number(pair.worst_true and MM * pair.worst_true, 2),
                *(str(measured(one, factor[name][0])) for name, one in pair.differences.items()),
            ]
            for pair in pairs
        ]
        tables.append(("Paired differences, 95 % intervals over arms", headers, rows))
    return tables


def _p95(one: Spread | None, digits: int) -> Cell:
    return Cell(number(None if one is None else one.p95 * MM, digits))
