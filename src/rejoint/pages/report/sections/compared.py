"""The section that compares the controllers: the table, errors per target, settled errors with intervals."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.failure import failure
from rejoint.control.comparison.recommend import NO_INTERVAL
from rejoint.control.comparison.result import Comparison, ControllerRow
from rejoint.control.geared import own_policy
from rejoint.pages.report.bytarget import by_target
from rejoint.pages.report.figures import Series, error_per_target, intervals
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.numerals import number
from rejoint.pages.report.palette import look_of
from rejoint.pages.report.tables import MM, comparison_view, poses_view
from rejoint.pages.report.view import Part, Picture, Section
from rejoint.pages.report.words import plural, short
from rejoint.system.statistics import Spread

KEY, SHORT, HEADING = "comparison", "Comparison", "Every controller on this arm"

_BARS = 3  # controllers in the bar chart: more cannot be told apart at ten targets


def comparison_section(comparison: Comparison, best: str, healthy: Series | None, gallery: Gallery) -> Section:
    """Build the section; ``healthy`` is the error [mm] of a healthy arm open loop, where that is known."""
    per_target = _per_target(comparison, best, healthy, gallery)
    means = (_settled(comparison, gallery), _cycles(comparison, gallery))
    failed = tuple(line for row in comparison.rows if (line := failure(row)))
    poses = poses_view(comparison)
    parts = (
        Part(tables=(comparison_view(comparison, best), *((poses,) if poses is not None else ()))),
        *(
            (
                Part(
                    heading="What failed, and why" if comparison.race is None else "Who was stopped, and why",
                    lines=failed,
                ),
            )
            if failed
            else ()
        ),
        Part(heading="Error per target", figures=(per_target,)),
        *by_target(comparison, best, gallery),
        Part(heading="Accuracy and speed", figures=means, columns=2),
    )
    return Section(key=KEY, short=SHORT, heading=HEADING, parts=parts)


def _per_target(comparison: Comparison, best: str, healthy: Series | None, gallery: Gallery) -> Picture:
    chosen = _chosen(comparison, best)
    series = [_bars(row) for row in chosen]
    words = "; ".join(
        f"{one.label}: {number(np.nanmin(one.value), 2)} to {number(np.nanmax(one.value), 2)} mm"
        for one in series
        if np.isfinite(one.value).any()
    )
    return gallery.show(
        "error-per-target", error_per_target(series, healthy),
        alt=f"Bars: settled encoder error at each target of the first set. {words}. The table has the means.",
        caption="Settled encoder error at each target of the first set; lines: smallest to largest of the repetitions. "
        "Compare Park et al. 2024, Figs. 8 and 9.",
    )  # fmt: skip


def _chosen(comparison: Comparison, best: str) -> list[ControllerRow]:
    """Pick what matters most: the arm as it was, the recommended controller, the policy."""
    wanted = dict.fromkeys(
        name for name in ("default", best, own_policy(comparison.controllers)) if name in comparison.controllers
    )
    others = [name for name in comparison.controllers if name not in wanted]
    names = [*wanted, *others][:_BARS]
    return [row for row in comparison.rows if row.controller in names]


def _bars(row: ControllerRow) -> Series:
    settled = row.outcomes.array("settled")[0] * MM  # (R, K)
    middle, low, high = _over_repetitions(settled)
    return Series(label=short(row.controller), look=look_of(row.controller), value=middle, low=low, high=high)


def _over_repetitions(values: Array) -> tuple[Array, Array, Array]:
    """Mean, smallest and largest (K,) of ``values`` (R, K); NaN where no repetition has a value."""
    result = np.full((3, values.shape[1]), np.nan)
    known = np.isfinite(values).any(axis=0)
    some = values[:, known]
    result[:, known] = np.nanmean(some, axis=0), np.nanmin(some, axis=0), np.nanmax(some, axis=0)
    return result[0], result[1], result[2]


def _settled(comparison: Comparison, gallery: Gallery) -> Picture:
    rows = [_settled_row(row) for row in comparison.rows]
    words = "; ".join(f"{one.label}: {number(one.value[0], 3, 'mm')}" for one in rows)
    caption = f"Filled: encoder error{_bars_of([row.hold.settled for row in comparison.rows])}."
    true = [row.hold.true_error.how for row in comparison.rows if row.hold.true_error.value is not None]
    if true:
        how = " by the calibration, modelled" if "modelled" in true else ""
        caption += f" Hollow: true error of the tool{how}, which holds play and flex behind the encoders."
    return gallery.show(
        "settled-error", intervals(rows, "settled error [mm]", log=True),
        alt=f"Settled encoder error of each controller. {words}.", caption=caption,
    )  # fmt: skip


def _cycles(comparison: Comparison, gallery: Gallery) -> Picture:
    rows = []
    for row in comparison.rows:
        value, low, high = (np.array([end]) for end in _ends(row.crossing.cycle_time))
        rows.append(Series(label=short(row.controller), look=look_of(row.controller), value=value, low=low, high=high))
    words = "; ".join(f"{one.label}: {number(one.value[0], 3, 's')}" for one in rows)
    count = plural(len(comparison.targets[0]), "target")
    how = "sent on at the first crossing" if comparison.race is None else "each until its first crossing"
    return gallery.show(
        "cycle-time", intervals(rows, f"time for {count} [s]", log=True),
        alt=f"Time for {count} with each controller. {words}.",
        caption=f"Time for {count}, {how}"
        f"{_bars_of([row.crossing.cycle_time for row in comparison.rows])}.",
    )  # fmt: skip


def _bars_of(spreads: list[Spread | None]) -> str:
    known = any(one is not None and one.mean.low is not None for one in spreads)
    return " with its 95 % interval" if known else f" ({NO_INTERVAL})"


def _settled_row(row: ControllerRow) -> Series:
    """Return the encoder error and, where it is known, the true error (hollow)."""
    true = row.hold.true_error
    found = [_ends(row.hold.settled)]
    if true.value is not None:
        low, high = (np.nan if end is None else end for end in (true.low, true.high))
        found.append((true.value, low, high))
    ends = np.array(found, dtype=float) * MM
    return Series(
        label=short(row.controller), look=look_of(row.controller), value=ends[:, 0], low=ends[:, 1],
        high=ends[:, 2],
    )  # fmt: skip


def _ends(one: Spread | None) -> tuple[float, float, float]:
    """Return mean, lower and upper end; NaN where there is none, and so nothing is drawn."""
    if one is None or one.mean.low is None or one.mean.high is None:
        return np.nan if one is None else one.mean.value, np.nan, np.nan
    return one.mean.value, one.mean.low, one.mean.high
