"""The evaluation as one self-contained page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rejoint.arms import Array
from rejoint.pages.report.embed import inline_svg
from rejoint.pages.report.figures import HALF, canvas
from rejoint.pages.report.page import render
from rejoint.pages.report.palette import LOOKS
from rejoint.pages.report.view import Cell, Page, Part, Picture, Row, Section, Table
from rejoint.research.evaluation.family import FAMILY_SIZE
from rejoint.research.evaluation.outcome import Outcome
from rejoint.research.evaluation.paired import NEVER_RATIO
from rejoint.research.evaluation.result import Evaluation
from rejoint.research.evaluation.tables import HEADERS, pair_cells, pair_headers, row_cells
from rejoint.system.files import write_whole
from rejoint.system.statistics import Estimate

SHOWN_FAILURES = 200
"""Failures listed on the page; all are in ``evaluation.json`` (chosen: a page that still opens at once)"""

Pooled = dict[tuple[str, str], list[Outcome]]
"""Outcomes by variant and controller, one per training seed"""


def write_page(path: Path, evaluation: Evaluation, pooled: Pooled) -> None:
    """Write the page."""
    sections = [_variant_section(evaluation, variant, pooled) for variant in evaluation.variants]
    page = Page(
        title=f"{evaluation.family.arms} arms never met",
        subtitle=f"{evaluation.arm}, family {evaluation.family.seed}, rejoint {evaluation.software}",
        verdict=tuple(_verdict(evaluation)),
        sections=(*sections, _failures(evaluation), _method(evaluation)),
        footer="Everything on this page is in evaluation.json; every trial is in outcomes/*.parquet.",
    )
    html = render(page)
    write_whole(path, lambda temporary: temporary.write_text(html, encoding="utf-8"))


def _verdict(evaluation: Evaluation) -> list[str]:
    """Say per variant who is better than the best rival, and by how much."""
    lines = []
    for pair in evaluation.pairs:
        if pair.rival != evaluation.best.get(pair.variant) or pair.settled is None:
            continue
        ratio, settled = pair.stay_ratio[-1], pair.settled
        speed = f"(median ratio {ratio.value:.2f})"
        if ratio.value >= NEVER_RATIO:
            speed = "(mostly it never stays there)"
        faster = _side(ratio, 1.0, ("sooner", "later", "neither clearly sooner nor later"))
        nearer = _side(settled, 0.0, ("nearer", "farther off", "neither nearer nor farther off"))
        lines.append(
            f"{evaluation.meanings[pair.variant]}: {pair.controller} is within "
            f"{1e3 * evaluation.protocol.within[-1]:g} mm {faster} than {pair.rival} {speed} "
            f"and settles {nearer} ({1e3 * settled.value:+.2f} mm)."
        )
    return [f"{line[:1].upper()}{line[1:]}" for line in lines] or ["No learned policy took part."]


def _side(estimate: Estimate, middle: float, words: tuple[str, str, str]) -> str:
    """Pick the first word for an interval below ``middle``, the second above, the third for all others."""
    if estimate.low is None or estimate.high is None:
        return words[2]
    return words[0] if estimate.high < middle else words[1] if estimate.low > middle else words[2]


def _variant_section(evaluation: Evaluation, name: str, pooled: Pooled) -> Section:
    rows = [row for row in evaluation.rows if row.variant == name]
    best, meaning = evaluation.best.get(name, ""), evaluation.meanings[name]
    table = Table(
        caption=f"{evaluation.family.arms} {meaning}",
        headers=("controller", *HEADERS),
        rows=tuple(
            Row(cells=tuple(row_cells(row, row.controller == best)), look=_look(evaluation, row.controller))
            for row in rows
        ),
    )
    pairs = [pair for pair in evaluation.pairs if pair.variant == name]
    against = Table(
        caption="Paired differences: the same arm, the same target; 95 % intervals resample arms",
        headers=("pair", *pair_headers(evaluation)),
        rows=tuple(Row(cells=tuple(pair_cells(pair)), emphasis=pair.rival == best) for pair in pairs),
        notes=("Ratios of times are medians; below 1 the first is sooner. Differences below 0: the first is nearer.",),
    )
    chosen = {controller: pooled[name, controller] for controller in evaluation.controllers}
    figures = (
        _picture(evaluation, chosen, f"{name}-settled", "settled", "settled encoder error [mm]"),
        _picture(evaluation, chosen, f"{name}-stay", "stay", "time to stay within the narrowest distance [s]"),
    )
    tables = (table, against) if pairs else (table,)
    parts = (Part(tables=tables), Part(figures=figures, columns=2))
    return Section(key=name, short=name, heading=f"{meaning[:1].upper()}{meaning[1:]}", parts=parts)


def _picture(evaluation: Evaluation, chosen: dict[str, list[Outcome]], key: str, field: str, xlabel: str) -> Picture:
    """Distribution over all holds: the share of holds that are better than a value."""
    figure, grid = canvas((HALF, 3.4))
    axes = grid[0, 0]
    for controller, outcomes in chosen.items():
        look = LOOKS[_look(evaluation, controller)]
        values = np.concatenate([_values(outcome, field) for outcome in outcomes])
        axes.plot(
            np.sort(values), 100 * np.arange(1, len(values) + 1) / len(values), color=look.colour, linestyle=look.dash,
            label=controller, linewidth=1.5,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set(xlabel=xlabel, ylabel="holds [%]", ylim=(0, 100))
    axes.legend(frameon=False, fontsize=8)
    return Picture(svg=inline_svg(figure, key, f"Distribution of the {xlabel} of every controller"))


def _values(outcome: Outcome, field: str) -> Array:
    if field == "stay":
        return np.where(np.isfinite(outcome.stay[..., -1]), outcome.stay[..., -1], np.inf).ravel()
    return np.where(np.isfinite(outcome.settled), 1e3 * outcome.settled, np.inf).ravel()


def _failures(evaluation: Evaluation) -> Section:
    counts = Counter((failure.variant, failure.controller) for failure in evaluation.failures)
    summary = Table(
        caption="Holds that ended farther than 5 mm from their target, or that the guard stopped",
        headers=("variant", "controller", "holds"),
        rows=tuple(Row(cells=(Cell(v), Cell(c), Cell(str(count)))) for (v, c), count in sorted(counts.items())),
        words=True,
    )
    # The learned ones are what the reader came for; the others are only counted when there are many.
    learned = {pair.controller for pair in evaluation.pairs}
    first = sorted(evaluation.failures, key=lambda failure: not any(failure.controller.startswith(g) for g in learned))
    shown = first[:SHOWN_FAILURES]
    table = Table(
        caption=f"One by one ({len(shown)} of {len(evaluation.failures)})",
        headers=("variant", "controller", "arm (wear seed), target", "settled, true [mm]", "what happened"),
        rows=tuple(
            Row(
                cells=(
                    Cell(one.variant), Cell(one.controller), Cell(f"{one.arm}, {one.target}", _point(one.point_mm)),
                    Cell("-" if one.settled_mm is None else f"{one.settled_mm:.1f}, {one.true_mm:.1f}"), Cell(one.what),
                )
            )
            for one in shown
        ),
        words=True,
    )  # fmt: skip
    parts = (Part(tables=(summary, table)),) if evaluation.failures else ()
    return Section(
        key="failures", short="Failures", heading="Failures", parts=parts, missing="" if parts else "No hold failed."
    )


def _point(point: Sequence[float]) -> str:
    return f"({', '.join(f'{value:.0f}' for value in point)}) mm"


def _method(evaluation: Evaluation) -> Section:
    family, protocol = evaluation.family, evaluation.protocol
    first = family.wear_seed(0)
    texts = (
        f"Arms: wear seeds {first} to {first + family.arms - 1} ({FAMILY_SIZE} seeds belong to a family; recipes and "
        f"gains are chosen on other families). Each is held at {family.targets} targets of its own for "
        f"{protocol.hold:g} s; settled is the mean of the last {protocol.window:g} s.",
        f"Ten targets: the protocol of Park et al. 2024, next target at the first crossing of "
        f"{1e3 * protocol.threshold:g} mm or after {protocol.dwell:g} s.",
        "Encoder error and true error of the tool are told apart: play and flex lie behind the encoders.",
    )
    return Section(key="method", short="Method", heading="Method", parts=(Part(texts=texts),))


def _look(evaluation: Evaluation, controller: str) -> int:
    return evaluation.controllers.index(controller) % len(LOOKS)
