"""From outcomes to rows, pairs, tables and the page.

Intervals resample whole arms. Times that may be infinite are compared by ratio.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.result import Columns, ControllerRow, Protocol, cycle_times
from rejoint.control.comparison.result import summarise as summarise_trials
from rejoint.pages import html
from rejoint.pages.html import LOOKS
from rejoint.pages.report.figures import HALF, Picture, canvas, inline_svg
from rejoint.pages.report.tables import ResultColumn, plain_table, result_columns
from rejoint.pages.words import MM, NEVER, Cell, measured, number
from rejoint.system.shell import __version__
from rejoint.system.statistics import (
    CONFIDENCE,
    FEWEST_CLUSTERS,
    Estimate,
    Labels,
    Spread,
    clustered_share,
    paired_difference,
)
from rejoint_lab.research.evaluation.family import FAMILY_SIZE, ArmFamily
from rejoint_lab.research.evaluation.trials import TrialSettings

NEVER_RATIO = 100.0
"""Ratio where only one of two ever stays (chosen)"""

RESAMPLES = 1000
"""chosen: ends of the interval repeat within 3 % of its width"""


def difference(first: Array, second: Array, *, seed: int = 0) -> Estimate | None:
    """Mean of ``first - second`` (A, K) over what both have."""
    arms = np.repeat(np.arange(first.shape[0]), first.shape[1])
    return paired_difference(first.ravel(), second.ravel(), arms, seed=seed)


def time_ratio(first: Array, second: Array, *, seed: int = 0) -> Estimate:
    """Median of ``first / second`` (A, K) for times that may be infinite or NaN (stopped).

    Without interval for few arms.
    """
    ratio = ratios(first, second)  # (A, K)
    median = float(np.median(ratio))
    if len(ratio) < FEWEST_CLUSTERS:
        return Estimate(value=median, low=None, high=None)
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, len(ratio), (RESAMPLES, len(ratio)))
    medians = np.median(ratio[picks].reshape(RESAMPLES, -1), axis=1)
    low, high = np.quantile(medians, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="nearest")
    return Estimate(value=median, low=min(float(low), median), high=max(float(high), median))


def ratios(first: Array, second: Array) -> Array:
    """``first / second`` for times; 1 for never over never."""
    (first, late), (second, later) = ((np.maximum(times, 1e-3), ~np.isfinite(times)) for times in (first, second))
    cases = (late & later, late, later)
    return np.select(cases, (1.0, NEVER_RATIO, 1 / NEVER_RATIO), first / np.where(later, 1.0, second))


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
    stay_ratio: tuple[Estimate, ...]
    """median ratio of the times to stay within each distance"""
    cycle_time: Estimate | None
    """[s] mean difference for ten targets of the crossing protocol"""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Everything."""

    arm: str
    software: str
    family: ArmFamily
    protocol: Protocol
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
    arm: str, settings: TrialSettings, meanings: dict[str, str], pooled: Outcomes, learned: Collection[str]
) -> Evaluation:
    """Compute every number of an evaluation; ``meanings`` says what its variants are, ``learned`` are no rivals."""
    protocol, variants = settings.protocol, tuple(meanings)
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
        family=settings.family,
        protocol=protocol,
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
    return VariantRow(
        **vars(row),
        variant=variant,
        seeds=held.shape[1],
        outside=clustered_share(outside, arms) if held.any() else None,
    )


def make_pair(variant: str, mine: tuple[str, Columns], other: tuple[str, Columns], protocol: Protocol) -> Pair:
    """Compare two groups: each seed with each, on the same arm and target."""
    (controller, ours), (rival, theirs) = ((name, _comparable(found, protocol)) for name, found in (mine, other))
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
        stay_ratio=tuple(time_ratio(*matched(name)) for name in protocol.stay_names),
        cycle_time=difference(*matched("cycle_time")),
    )


def _comparable(found: Columns, protocol: Protocol) -> Columns:
    """Results at the targets that arms were held at, times that never came as infinity, and the cycle time."""
    held = found["held"][0, 0] == 1.0
    stays = {name: found[name][..., held] for name in protocol.stay_names}
    times = {name: np.where(stay >= protocol.hold, np.inf, stay) for name, stay in stays.items()}
    return found | times | {"cycle_time": cycle_times(found)[..., None]}


def _arms(found: Columns) -> Labels:
    """Return the number (T,) of each trial's arm."""
    return np.unique(found["arm"][:, 0, 0], return_inverse=True)[1]


def _late(row: VariantRow) -> tuple[float, float]:
    """Rank of a rival: who is soonest within the narrowest distance, else the nearest."""
    return row.stays[-1].median or np.inf, np.inf if row.settled is None else row.settled.mean.value


# --- tables and page --------------------------------------------------------------------------


def row_columns(evaluation: Evaluation) -> tuple[ResultColumn, ...]:
    """Columns of the controllers on one variant."""
    family = evaluation.family
    return (
        *result_columns(evaluation.protocol, max(family.targets, family.crossings)),
        ResultColumn("95 % below, encoders [mm]", lambda row: Cell(_p95(row.settled, 3))),
        ResultColumn("95 % below, true [mm]", lambda row: Cell(_p95(row.settled_true, 2))),
        ResultColumn("farther than 5 mm [%]", lambda row: measured(cast(VariantRow, row).outside, 100.0)),
    )


def pair_headers(evaluation: Evaluation) -> tuple[str, ...]:
    """Headers of `pair_cells`."""
    within = (f"time to stay within {distance * MM:g} mm, ratio" for distance in evaluation.protocol.within)
    return ("settled, encoders [mm]", "settled, true [mm]", *within, "ten targets [s]")


def pair_cells(pair: Pair) -> list[Cell]:
    """Cells of one controller against one rival."""
    ratios = map(_ratio, pair.stay_ratio)
    return [_signed(pair.settled, MM), _signed(pair.settled_true, MM), *ratios, _signed(pair.cycle_time, 1.0)]


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


def _p95(one: Spread | None, digits: int) -> str:
    return number(None if one is None else one.p95 * MM, digits)


def _signed(value: Estimate | None, factor: float) -> Cell:
    text, note = measured(value, factor)
    return Cell(f"{'+' if value is not None and value.value > 0 else ''}{text}", note)


def _ratio(value: Estimate) -> Cell:
    one, *ends = (
        "" if end is None else NEVER if end >= NEVER_RATIO else number(end, 2)
        for end in (value.value, value.low, value.high)
    )
    return Cell(one, " to ".join(filter(None, ends)))


def write_page(path: Path, evaluation: Evaluation, pooled: Mapping[tuple[str, str], Columns]) -> None:
    """Write the page; ``pooled`` results (T, seeds, K) are by variant and controller."""

    def look(controller: str) -> int:
        return evaluation.controllers.index(controller) % len(LOOKS)

    def figures(variant: str) -> Iterator[Picture]:
        """Draw the share of holds below each value."""
        narrow, hold = evaluation.protocol.stay_names[-1], evaluation.protocol.hold
        for key, label, factor, most in (
            ("settled", "settled encoder error [mm]", MM, np.inf),
            (narrow, "time to stay within the narrowest distance [s]", 1.0, hold),
        ):
            figure, grid = canvas((HALF, 3.4))
            axes = grid[0, 0]
            for controller in evaluation.controllers:
                found, one = pooled[variant, controller], LOOKS[look(controller)]
                values = np.nan_to_num(found[key][found["held"] == 1.0], nan=np.inf)
                axes.ecdf(
                    np.where(values >= most, np.inf, factor * values),
                    color=one.colour,
                    linestyle=one.dash,
                    label=controller,
                    linewidth=1.5,
                )
            axes.set_xscale("log")
            axes.set(xlabel=label, ylabel="share of the holds", ylim=(0, 1))
            axes.legend(frameon=False, fontsize=8)
            yield Picture(
                svg=inline_svg(figure, f"{variant}-{key}", f"Distribution of the {label} of every controller")
            )

    html.write_page(
        path,
        "evaluation.html",
        title=f"{evaluation.family.arms} arms never met",
        evaluation=evaluation,
        subtitle=f"{evaluation.arm}, family {evaluation.family.seed}, rejoint {evaluation.software}",
        look=look,
        figures=figures,
        parts=[*((variant, variant) for variant in evaluation.variants), ("method", "Method")],
        columns=row_columns(evaluation),
        pair_headers=pair_headers(evaluation),
        pair_cells=pair_cells,
        family_size=FAMILY_SIZE,
        footer="Everything on this page is in evaluation.json; every trial is in outcomes/*.parquet.",
    )
