"""From outcomes to rows, pairs and tables; intervals resample whole arms."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import cast

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.result import Columns, ControllerRow, Protocol, cycle_times
from rejoint.control.comparison.result import summarise as summarise_trials
from rejoint.pages.report.tables import ResultColumn, plain_table, result_columns
from rejoint.pages.words import MM, Cell, measured, number
from rejoint.system.shell import __version__
from rejoint.system.statistics import (
    Estimate,
    Labels,
    Spread,
    clustered_share,
    paired_difference,
)
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
    settled: Estimate | None
    """[m] mean difference, negative where the controller is better"""
    settled_true: Estimate | None
    """[m]"""
    worst_true: float | None
    """[m] the same on the arm where it is largest"""
    stays: tuple[Estimate | None, ...]
    """[s] mean differences of the times to stay within each distance; never: the hold's length"""
    cycle_time: Estimate | None
    """[s] mean difference for ten targets of the crossing protocol"""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Everything."""

    arm: str
    software: str
    family: ArmFamily
    variants: tuple[str, ...]
    meanings: dict[str, str]
    """of the variants, in words"""
    controllers: tuple[str, ...]
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
    protocol, variants = family.protocol, tuple(meanings)
    groups = tuple(dict.fromkeys(group for _, group in pooled))
    rows = tuple(make_row(*key, found, protocol) for key, found in pooled.items())
    rivals = {v: [row for row in rows if row.variant == v and row.controller not in learned] for v in variants}
    pairs = [
        make_pair(v, (g, pooled[v, g]), (rival, pooled[v, rival]), protocol)
        for v, g, rival in product(variants, groups, groups)
        if g in learned and rival != g
    ]
    return Evaluation(
        arm=arm,
        software=__version__,
        family=family,
        variants=variants,
        meanings=meanings,
        controllers=groups,
        rows=rows,
        best={v: min(some, key=_late).controller for v, some in rivals.items() if some},
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


def make_pair(variant: str, mine: tuple[str, Columns], other: tuple[str, Columns], protocol: Protocol) -> Pair:
    """Compare two groups: each seed with each, on the same arm and target."""
    (controller, ours), (rival, theirs) = (
        (name, found | {"cycle_time": cycle_times(found)[..., None]}) for name, found in (mine, other)
    )
    count = len(np.unique(_arms(mine[1])))

    def matched(name: str) -> Iterator[Array]:
        # Arms stay the first axis, so that a resampled arm brings all its seeds along.
        both = np.broadcast_arrays(ours[name][:, :, None], theirs[name][:, None])
        return (one.reshape(count, -1) for one in both)

    return Pair(
        variant=variant,
        controller=controller,
        rival=rival,
        settled=difference(*matched("settled")),
        settled_true=difference(*matched("settled_true")),
        worst_true=worst(*matched("settled_true")),
        stays=tuple(difference(*matched(name)) for name in protocol.stay_names),
        cycle_time=difference(*matched("cycle_time")),
    )


def _arms(found: Columns) -> Labels:
    """Return the number (T,) of each trial's arm."""
    return np.unique(found["arm"][:, 0, 0], return_inverse=True)[1]


def _late(row: VariantRow) -> tuple[float, float]:
    """Rank of a rival: who is soonest within the narrowest distance, else the nearest."""
    return row.stays[-1].median or np.inf, np.inf if row.settled is None else row.settled.mean.value


# --- tables and page --------------------------------------------------------------------------


def row_columns(evaluation: Evaluation) -> tuple[ResultColumn, ...]:
    """Columns of the controllers on one variant."""
    family, shown = evaluation.family, list[ResultColumn]()
    if any(row.inside is not None for row in evaluation.rows):
        shown = [
            ResultColumn("expected by the calibration [mm]", lambda row: Cell(_expected(row))),
            ResultColumn("in its interval [%]", lambda row: measured(cast(VariantRow, row).inside, 100.0)),
            ResultColumn("corrected arms [%]", lambda row: Cell(number(100 * (cast(VariantRow, row).used or 0.0), 3))),
        ]
    return (
        *result_columns(family.protocol, max(family.targets, family.crossings)),
        ResultColumn("95 % below, encoders [mm]", lambda row: Cell(_p95(row.settled, 3))),
        ResultColumn("95 % below, true [mm]", lambda row: Cell(_p95(row.settled_true, 2))),
        ResultColumn("farther than 5 mm [%]", lambda row: measured(cast(VariantRow, row).outside, 100.0)),
        *shown,
    )


def pair_headers(evaluation: Evaluation) -> tuple[str, ...]:
    """Headers of `pair_cells`."""
    within = (f"time to stay within {distance * MM:g} mm [s]" for distance in evaluation.family.protocol.within)
    return ("settled, encoders [mm]", "settled, true [mm]", "the worst arm's [mm]", *within, "ten targets [s]")


def pair_cells(pair: Pair) -> list[Cell]:
    """Cells of one controller against one rival."""
    worst_true = Cell(number(pair.worst_true and MM * pair.worst_true, 2))
    settled = _signed(pair.settled, MM), _signed(pair.settled_true, MM), worst_true
    return [*settled, *(_signed(one, 1.0) for one in (*pair.stays, pair.cycle_time))]


def terminal_tables(evaluation: Evaluation) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, headers and rows of a table per variant, and of pairs."""
    tables = [
        (f"{one}: {evaluation.family.arms} arms", *plain_table(row_columns(evaluation), evaluation.on(one)))
        for one in evaluation.variants
    ]
    pairs = [
        [
            pair.variant,
            f"{pair.controller} against {pair.rival}",
            *map(str, pair_cells(pair)),
        ]
        for pair in evaluation.pairs
        if pair.rival == evaluation.best.get(pair.variant)
    ]
    if pairs:
        headers = ["variant", "against the best rival", *pair_headers(evaluation)]
        tables.append(("Paired differences, 95 % intervals over arms", headers, pairs))
    return tables


def _expected(row: ControllerRow) -> str:
    return "" if row.settled_modelled is None else row.settled_modelled.millimetres


def _p95(one: Spread | None, digits: int) -> str:
    return number(None if one is None else one.p95 * MM, digits)


def _signed(value: Estimate | None, factor: float) -> Cell:
    text, note = measured(value, factor)
    return Cell(f"{'+' if value is not None and value.value > 0 else ''}{text}", note)
