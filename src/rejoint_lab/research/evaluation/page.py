"""The evaluation as tables for the terminal, and as a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import cast

import numpy as np

from rejoint.control.comparison.result import Columns
from rejoint.pages import html
from rejoint.pages.html import LOOKS
from rejoint.pages.report.figures import HALF, Picture, canvas, inline_svg
from rejoint.pages.report.tables import ResultColumn, plain_table, result_columns
from rejoint.pages.words import MM, NEVER, Cell, measured, number
from rejoint.system.statistics import Estimate, Spread
from rejoint_lab.research.evaluation.family import FAMILY_SIZE
from rejoint_lab.research.evaluation.summary import NEVER_RATIO, Evaluation, Pair, VariantRow


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
