"""The evaluation as tables of words: the same cells on the page and at the terminal."""

from __future__ import annotations

from rejoint.pages.report.numerals import NEVER, UNKNOWN, interval, number
from rejoint.pages.report.view import Cell
from rejoint.research.evaluation.paired import NEVER_RATIO
from rejoint.research.evaluation.result import Evaluation, Pair, VariantRow
from rejoint.system.statistics import Estimate

MM, PERCENT = 1e3, 1e2

HEADERS = (
    "settled, encoders [mm]", "95 % below [mm]", "farther than 5 mm [%]", "settled, true [mm]", "oscillation [mm]",
    "stays within 10 / 5 / 2 mm after [s]", "ten targets [s]",
)  # fmt: skip


def row_cells(row: VariantRow, best: bool = False) -> list[Cell]:
    """Cells of one controller on one variant; the first is its name."""
    note = [f"{row.seeds} training seeds"] if row.seeds > 1 else []
    stays = " / ".join(NEVER if w.median is None else number(w.median, 2) for w in row.within)
    shares = " / ".join(f"{w.share.value * PERCENT:.0f}" for w in row.within)
    return [
        Cell(row.controller, "\n".join([*note, *(["best rival"] if best else [])])),
        _measured(row.settled, 3),
        Cell(_mm(row.settled_p95, 3)),
        Cell(number(row.outside.value * PERCENT, 2), _interval(row.outside, PERCENT, 2)),
        Cell(_measured(row.settled_true, 2).text, f"95 %: {_mm(row.true_p95, 2)}"),
        Cell(_mm(row.oscillation, 2)),
        Cell(stays, f"{shares} %"),
        _cycle(row),
    ]


def pair_headers(evaluation: Evaluation) -> tuple[str, ...]:
    """Headers of `pair_cells`."""
    within = [f"time to stay within {distance * MM:g} mm, ratio" for distance in evaluation.protocol.within]
    return ("settled, encoders [mm]", "settled, true [mm]", *within, "ten targets [s]")


def pair_cells(pair: Pair) -> list[Cell]:
    """Cells of one controller against one rival; the first names the two."""
    return [
        Cell(f"{pair.controller} against {pair.rival}"),
        _signed(pair.settled, MM),
        _signed(pair.settled_true, MM),
        *(_ratio(ratio) for ratio in pair.stay_ratio),
        _signed(pair.cycle_time, 1.0),
    ]


def terminal_tables(evaluation: Evaluation) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, headers and rows of a table per variant, and one of the pairs against the best rivals."""
    tables = []
    for variant in evaluation.variants:
        rows = [
            [cell.text for cell in row_cells(row)] for row in evaluation.rows if row.variant == variant
        ]  # fmt: skip
        tables.append((f"{variant}: {evaluation.family.arms} arms", ["controller", *HEADERS], rows))
    pairs = [
        [pair.variant, *(" ".join(part for part in (cell.text, cell.note and f"({cell.note})") if part)
         for cell in pair_cells(pair))]
        for pair in evaluation.pairs
        if pair.rival == evaluation.best.get(pair.variant)
    ]  # fmt: skip
    if pairs:
        headers = ["variant", "against the best rival", *pair_headers(evaluation)]
        tables.append(("Paired differences, 95 % intervals over arms", headers, pairs))
    return tables


def _measured(value: Estimate | None, digits: int) -> Cell:
    return Cell(UNKNOWN) if value is None else Cell(number(value.value * MM, digits), _interval(value, MM))


def _mm(value: float | None, digits: int) -> str:
    return UNKNOWN if value is None else number(value * MM, digits)


def _cycle(row: VariantRow) -> Cell:
    if row.cycle_time is None or row.success is None:
        return Cell(UNKNOWN)
    return Cell(number(row.cycle_time.value, 3), f"{number(row.success.value * PERCENT, 3)} % reached")


def _interval(value: Estimate, factor: float, digits: int = 3) -> str:
    return interval(value.low, value.high, digits, factor=factor)


def _signed(value: Estimate | None, factor: float) -> Cell:
    if value is None:
        return Cell(UNKNOWN)
    return Cell(f"{'+' if value.value > 0 else ''}{number(value.value * factor, 2)}", _interval(value, factor, 2))


def _ratio(value: Estimate) -> Cell:
    def shown(end: float) -> str:
        return NEVER if end >= NEVER_RATIO else number(end, 2)

    if value.low is None or value.high is None:
        return Cell(shown(value.value))
    return Cell(shown(value.value), f"{shown(value.low)} to {shown(value.high)}")
