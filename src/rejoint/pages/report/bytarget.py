"""Errors before and after, target by target: by the encoders and of the tool, never mixed."""

from __future__ import annotations

import numpy as np

from rejoint.control.accuracy import TrueError
from rejoint.control.comparison.holding import errors_of
from rejoint.control.comparison.result import Comparison, TargetErrors
from rejoint.control.default import DefaultController
from rejoint.pages.report.figures import Series, error_per_target
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.numerals import UNKNOWN, number
from rejoint.pages.report.palette import BROWN, look_of
from rejoint.pages.report.view import Cell, Part, Picture, Row, Table
from rejoint.pages.report.words import short

MM = 1e3


def target_errors(comparison: Comparison, controller: str) -> TargetErrors:
    """Return the errors of a controller at each target of the first set, means over the repetitions."""
    found = comparison.row(controller).outcomes
    modelled = found.array("modelled")[:, 0] if found.modelled else np.full((3, *found.shape[1:]), np.nan)
    return errors_of(found.array("settled")[0], found.array("settled_true")[0], modelled)


def errors_as_found(comparison: Comparison) -> TargetErrors | None:
    """Return those of the arm as it was found: by its own controller, not aimed; None where that was not driven."""
    own = DefaultController.name
    if comparison.calibration or own not in comparison.controllers:
        return comparison.as_found
    return target_errors(comparison, own)


def by_target(comparison: Comparison, best: str, gallery: Gallery) -> tuple[Part, ...]:
    """Show where the tool was before and is after, at each target of the first set; nothing where nobody knows."""
    before, after = errors_as_found(comparison), target_errors(comparison, best)
    if before is None or best == DefaultController.name or all(error.value is None for error in after.true):
        return ()
    table = _table(comparison, best, before, after)
    figures = (_picture(best, before, after, gallery),)
    return (Part(heading="True error before and after, target by target", figures=figures, tables=(table,)),)


def _table(comparison: Comparison, best: str, before: TargetErrors, after: TargetErrors) -> Table:
    rows = [
        Row(
            cells=(
                Cell(f"target {k + 1}"),
                *(cell for one in (before, after) for cell in (_encoders(one.encoders[k]), _tool(one.true[k]))),
            )
        )
        for k in range(len(after.true))
    ]
    means = (cell for one in (before, after) for cell in (_mean(one.encoders), _mean(tuple(e.value for e in one.true))))
    rows.append(Row(cells=(Cell("mean"), *means), emphasis=True))
    headers = (
        "target",
        *(f"{when}, {what} [mm]" for when in ("before", f"with “{best}”") for what in ("encoders", "tool")),
    )
    modelled = any(error.how == "modelled" for error in after.true)
    how = " What is modelled has its 95 % interval by the calibration in small print." if modelled else ""
    note = (
        "First set of targets. Before: the arm's own controller, sent once, not "
        f"corrected, once. After: means over {comparison.repetitions} of the trials of the table above.{how}"
    )
    return Table(caption="Errors before and after", headers=headers, rows=tuple(rows), notes=(note,))


def _encoders(value: float | None) -> Cell:
    return Cell(UNKNOWN if value is None else number(value * MM, 2))


def _tool(error: TrueError) -> Cell:
    if error.value is None:
        return Cell(UNKNOWN)
    how = "" if error.how == "known" else f"{error.how}{f', {error.range}' if error.range else ''}"
    return Cell(number(error.value * MM, 2), how)


def _mean(found: tuple[float | None, ...]) -> Cell:
    known = [value for value in found if value is not None]
    return _encoders(float(np.mean(known)) if known else None)


def _picture(best: str, before: TargetErrors, after: TargetErrors, gallery: Gallery) -> Picture:
    series = [
        Series(label=label, look=look, value=MM * np.array([np.nan if e.value is None else e.value for e in one.true]))
        for label, look, one in (
            ("before, the tool itself", BROWN, before),
            (f"with {short(best)}, the tool itself", look_of(best), after),
        )
    ]
    words = "; ".join(
        f"{one.label}: {number(np.nanmin(one.value), 2)} to {number(np.nanmax(one.value), 2)} mm"
        for one in series
        if np.isfinite(one.value).any()
    )
    return gallery.show(
        "true-error-per-target",
        error_per_target(series),
        alt=f"Bars: true error of the tool at each target of the first set. {words}. The table has the numbers.",
        caption="How far the tool itself is from each target of the first set, before the repair and after it.",
    )
