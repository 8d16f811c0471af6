"""From outcomes to rows, pairs and tables; intervals resample whole arms."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.result import Columns, ControllerRow, Protocol, cycle_times
from rejoint.control.comparison.result import summarise as summarise_trials
from rejoint.pages.report.tables import ResultColumn, plain_table, result_columns
from rejoint.pages.words import MM, Cell, measured, number
from rejoint.system.shell import __version__
from rejoint.system.statistics import Estimate, Labels, Spread, clustered_share, paired_difference
from rejoint_lab.research.evaluation.family import ArmFamily


def difference(first: Array, second: Array, *, seed: int = 0) -> Estimate | None:
    """Mean of ``first - second`` (A, K) over what both have."""
    arms = np.repeat(np.arange(first.shape[0]), first.shape[1])
    return paired_difference(first.ravel(), second.ravel(), arms, seed=seed)


def worst(first: Array, second: Array) -> float | None:
    """Largest mean of ``first - second`` (A, K) of one arm."""
    apart = first - second
    known = np.isfinite(apart)
    sums, counts = np.where(known, apart, 0.0).sum(axis=1), known.sum(axis=1)
    return float((sums[counts > 0] / counts[counts > 0]).max()) if counts.any() else None


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

    def on(self, variant: str) -> tuple[VariantRow, ...]:
        """Rows of a variant."""
        return tuple(row for row in self.rows if row.variant == variant)


Outcomes = Mapping[tuple[str, str], Columns]
"""Results by variant and contestant, (T, K) of T trials (see `try_on`), or (T, seeds, K) of seeds put together"""


def pool(groups: Mapping[str, str], outcomes: Outcomes) -> dict[tuple[str, str], Columns]:
    """Put the seeds of a learner together: by variant and group; ``groups`` by contestant."""
    members: dict[tuple[str, str], list[Columns]] = {}
    for (variant, name), found in outcomes.items():
        members.setdefault((variant, groups[name]), []).append(found)
    return {
        at: {key: np.stack([one[key] for one in found], axis=1) for key in found[0]} for at, found in members.items()
    }


def summarise(
    arm: str, family: ArmFamily, meanings: dict[str, str], pooled: Outcomes, learned: Collection[str]
) -> Evaluation:
    """Compute every number of an evaluation; ``meanings`` says what its variants are, ``learned`` are no rivals."""
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


def make_row(variant: str, controller: str, found: Columns, protocol: Protocol) -> VariantRow:
    """Summarise the results (T, seeds, K) of a controller."""
    arms = np.repeat(_arms(found), found["settled"][0].size)
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
    count = len(np.unique(_arms(results[0])))
    ours, theirs = (found | {"cycle_time": cycle_times(found)[..., None]} for found in results)
    matched = {}
    for name in ("settled", "settled_true", *protocol.stay_names, "cycle_time"):
        # Arms stay the first axis, so that a resampled arm brings all its seeds along.
        both = np.broadcast_arrays(ours[name][:, :, None], theirs[name][:, None])
        matched[name] = [one.reshape(count, -1) for one in both]
    return Pair(
        variant=where[0],
        controller=where[1],
        rival=rival,
        differences={name: difference(*both) for name, both in matched.items()},
        worst_true=worst(*matched["settled_true"]),
    )


def _arms(found: Columns) -> Labels:
    """Return the number (T,) of each trial's arm."""
    return np.unique(found["arm"][:, 0, 0], return_inverse=True)[1]


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
    own = COLUMNS | (CALIBRATED if calibrated else {})
    columns = [
        *result_columns(family.protocol, max(family.targets, family.crossings)),
        *(ResultColumn(header, cast("Callable[[ControllerRow], Cell]", cell)) for header, cell in own.items()),
    ]
    tables = [(f"{one}: {family.arms} arms", *plain_table(columns, evaluation.on(one))) for one in evaluation.meanings]
    pairs = [one for one in evaluation.pairs if one.rival == evaluation.best.get(one.variant)]
    if pairs:
        units = {name: "[mm]" if name.startswith("settled") else "[s]" for name in pairs[0].differences}
        headers = [
            "variant",
            "against the best rival",
            "worst arm, true [mm]",
            *(f"{name} {unit}" for name, unit in units.items()),
        ]
        rows = [
            [
                pair.variant,
                f"{pair.controller} against {pair.rival}",
                number(pair.worst_true and MM * pair.worst_true, 2),
                *(str(measured(one, MM if units[name] == "[mm]" else 1.0)) for name, one in pair.differences.items()),
            ]
            for pair in pairs
        ]
        tables.append(("Paired differences, 95 % intervals over arms", headers, rows))
    return tables


def _p95(one: Spread | None, digits: int) -> Cell:
    return Cell(number(None if one is None else one.p95 * MM, digits))
