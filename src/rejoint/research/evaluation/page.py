"""The evaluation as tables for the terminal, and as a page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rejoint.pages import html
from rejoint.pages.html import LOOKS
from rejoint.pages.report.figures import HALF, Picture, canvas, inline_svg
from rejoint.pages.words import MM, NEVER, Cell, measured, number
from rejoint.research.evaluation.family import FAMILY_SIZE
from rejoint.research.evaluation.outcome import Outcome
from rejoint.research.evaluation.summary import NEVER_RATIO, Evaluation, Pair, VariantRow
from rejoint.system.statistics import Estimate

HEADERS = (
    "settled, encoders [mm]",
    "95 % below [mm]",
    "farther than 5 mm [%]",
    "settled, true [mm]",
    "oscillation [mm]",
    "stays within 10 / 5 / 2 mm after [s]",
    "ten targets [s]",
)


def row_cells(row: VariantRow) -> list[Cell]:
    """Cells of one controller on one variant, under `HEADERS`."""
    stays = " / ".join(NEVER if w.median is None else number(w.median, 2) for w in row.within)
    shares = " / ".join(f"{100 * w.share.value:.0f}" for w in row.within)
    reached = None if row.success is None or row.cycle_time is None else f"{number(100 * row.success.value)} % reached"
    return [
        measured(row.settled, MM, 3),
        Cell(_mm(row.settled_p95, 3)),
        measured(row.outside, 100.0),
        Cell(measured(row.settled_true).text, f"95 %: {_mm(row.true_p95, 2)}"),
        Cell(_mm(row.oscillation, 2)),
        Cell(stays, f"{shares} %"),
        Cell(measured(row.cycle_time if reached else None, 1.0, 3).text, reached or ""),
    ]


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
    tables = []
    for variant in evaluation.variants:
        rows = [
            [row.controller, *(cell.text for cell in row_cells(row))]
            for row in evaluation.rows
            if row.variant == variant
        ]
        tables.append((f"{variant}: {evaluation.family.arms} arms", ["controller", *HEADERS], rows))
    pairs = [
        [
            pair.variant,
            f"{pair.controller} against {pair.rival}",
            *(f"{text} ({note})" if note else text for text, note in pair_cells(pair)),
        ]
        for pair in evaluation.pairs
        if pair.rival == evaluation.best.get(pair.variant)
    ]
    if pairs:
        headers = ["variant", "against the best rival", *pair_headers(evaluation)]
        tables.append(("Paired differences, 95 % intervals over arms", headers, pairs))
    return tables


def _mm(value: float | None, digits: int) -> str:
    return number(None if value is None else value * MM, digits)


def _signed(value: Estimate | None, factor: float) -> Cell:
    text, note = measured(value, factor)
    return Cell(f"{'+' if value is not None and value.value > 0 else ''}{text}", note)


def _ratio(value: Estimate) -> Cell:
    one, *ends = (
        "" if end is None else NEVER if end >= NEVER_RATIO else number(end, 2)
        for end in (value.value, value.low, value.high)
    )
    return Cell(one, " to ".join(filter(None, ends)))


SHOWN_FAILURES = 200
"""Failures on the page; all are in ``evaluation.json`` (chosen)"""

Pooled = dict[tuple[str, str], list[Outcome]]
"""Outcomes by variant and controller, one per training seed"""


def write_page(path: Path, evaluation: Evaluation, pooled: Pooled) -> None:
    """Write the page."""

    def look(controller: str) -> int:
        return evaluation.controllers.index(controller) % len(LOOKS)

    def figures(variant: str) -> Iterator[Picture]:
        """Draw the share of holds below each value."""
        for key, label in (
            ("settled", "settled encoder error [mm]"),
            ("stay", "time to stay within the narrowest distance [s]"),
        ):
            figure, grid = canvas((HALF, 3.4))
            axes = grid[0, 0]
            for controller in evaluation.controllers:
                some = pooled[variant, controller]
                found = [1e3 * one.settled if key == "settled" else one.stay[..., -1] for one in some]
                values = np.sort(
                    np.nan_to_num(np.concatenate([one.ravel() for one in found]), nan=np.inf, posinf=np.inf)
                )
                axes.plot(
                    values,
                    100 * np.arange(1, len(values) + 1) / len(values),
                    color=LOOKS[look(controller)].colour,
                    linestyle=LOOKS[look(controller)].dash,
                    label=controller,
                    linewidth=1.5,
                )
            axes.set_xscale("log")
            axes.set(xlabel=label, ylabel="holds [%]", ylim=(0, 100))
            axes.legend(frameon=False, fontsize=8)
            alt = f"Distribution of the {label} of every controller"
            yield Picture(svg=inline_svg(figure, f"{variant}-{key}", alt))

    # The learned ones are what the reader came for; the others are only counted when there are many.
    learned = tuple({pair.controller for pair in evaluation.pairs})
    failures = sorted(evaluation.failures, key=lambda failure: not failure.controller.startswith(learned))
    html.write_page(
        path, "evaluation.html", title=f"{evaluation.family.arms} arms never met", evaluation=evaluation,
        subtitle=f"{evaluation.arm}, family {evaluation.family.seed}, rejoint {evaluation.software}",
        verdict=_verdict(evaluation), look=look, figures=figures, failures=failures[:SHOWN_FAILURES],
        parts=[*zip(evaluation.variants, evaluation.variants, strict=True), ("failures", "Failures"),
               ("method", "Method")],
        headers=HEADERS, row_cells=row_cells, pair_headers=pair_headers(evaluation), pair_cells=pair_cells,
        family_size=FAMILY_SIZE,
        footer="Everything on this page is in evaluation.json; every trial is in outcomes/*.parquet.",
    )  # fmt: skip


def _verdict(evaluation: Evaluation) -> list[str]:
    """Say per variant how each policy compares with the best rival."""
    lines = []
    for pair in evaluation.pairs:
        if pair.rival != evaluation.best.get(pair.variant) or pair.settled is None:
            continue
        ratio, settled, meaning = pair.stay_ratio[-1], pair.settled, evaluation.meanings[pair.variant]
        never = ratio.value >= NEVER_RATIO
        faster = _side(ratio, 1.0, ("sooner", "later", "neither clearly sooner nor later"))
        nearer = _side(settled, 0.0, ("nearer", "farther off", "neither nearer nor farther off"))
        lines.append(
            f"{meaning[:1].upper()}{meaning[1:]}: {pair.controller} is within "
            f"{1e3 * evaluation.protocol.within[-1]:g} mm {faster} than {pair.rival} "
            f"({'mostly it never stays there' if never else f'median ratio {ratio.value:.2f}'}) "
            f"and settles {nearer} ({1e3 * settled.value:+.2f} mm)."
        )
    return lines or ["No learned policy took part."]


def _side(estimate: Estimate, middle: float, words: tuple[str, str, str]) -> str:
    """Pick the word for an interval below, above or across ``middle``."""
    if estimate.low is None or estimate.high is None:
        return words[2]
    return words[0] if estimate.high < middle else words[1] if estimate.low > middle else words[2]
