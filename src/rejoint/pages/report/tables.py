"""The comparison as a table of words: the same cells on the page and at the terminal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.control.comparison.protocols import STANDS_FOR
from rejoint.control.comparison.racing import Race
from rejoint.control.comparison.result import Comparison, ControllerRow, HoldRow, PoseAccuracy, Stay
from rejoint.pages.report.numerals import NEVER, UNKNOWN, interval, number, spread
from rejoint.pages.report.palette import colour_number
from rejoint.pages.report.view import Cell, Row, Table
from rejoint.pages.report.words import CONTROLLERS, day_and_time, plural
from rejoint.system.statistics import FEWEST_CLUSTERS, Spread

MM, PERCENT = 1e3, 1e2


@dataclass(frozen=True, kw_only=True)
class PaperRow:
    """One column of Table 4 of Park et al. 2024."""

    success: str
    error: str
    cycle: str


PAPER = {
    "default": PaperRow(success="6.67", error="22.0 ± 14.6", cycle="197"),
    "pid-sum": PaperRow(success="75.0", error="13.4 ± 12.2", cycle="96.3"),
    "pid-literal": PaperRow(success="75.0", error="13.4 ± 12.2", cycle="96.3"),
    "policy": PaperRow(success="100", error="8.21 ± 1.11", cycle="14.2"),
}
"""Park et al. 2024, Table 4: the real worn myCobot of the paper, n = 6, ten targets. Their PID is not said to be
one reading of their equation 27 or the other, so it stands beside both."""

PAPER_ARM = "mycobot280"
"""Arm of the paper; errors of another one, in millimetres, are not comparable"""

PAPER_TARGETS = 10
"""Targets in a cycle of the paper; other numbers of targets are not comparable"""


def comparison_table(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Return headers and rows of plain text, first column the controllers' names on the command line."""
    rows = [
        [f"{row.controller}{' (by diagnosis)' if row.source else ''}", *(cell.text for cell in _cells(row, comparison))]
        for row in comparison.rows
    ]
    return ["controller", *_headers(comparison)], rows


def comparison_view(comparison: Comparison, best: str) -> Table:
    """Return the same table for the page, with small print, and the row of the ``best`` controller set off."""
    rows = tuple(
        Row(
            cells=(
                Cell(row.controller, _what(row)),
                *_cells(row, comparison),
            ),
            look=colour_number(row.controller),
            badge="recommended" if row.controller == best else "",
            emphasis=row.controller == best,
        )
        for row in comparison.rows
    )
    return Table(
        caption="Every controller on the same arm with the same targets",
        headers=("controller", *_headers(comparison)), rows=rows, notes=_notes(comparison),
    )  # fmt: skip


def _what(row: ControllerRow) -> str:
    """Say what a controller does, and where its results are from if it was not driven for this table."""
    return "\n".join(filter(None, (CONTROLLERS.get(row.controller, ""), row.source and f"measured by {row.source}")))


def _headers(comparison: Comparison) -> list[str]:
    within = " / ".join(f"{distance * MM:g}" for distance in comparison.protocol.within)
    return [
        "success [%]", "error at the crossing [mm]", f"{plural(_count(comparison), 'target')} [s]",
        "settled error, encoders [mm]", *(["orientation, encoders [deg]"] if comparison.orientations else []),
        "settled error, true [mm]", f"time to stay within {within} mm [s]",
        "oscillation [mm]", "guard",
    ]  # fmt: skip


def _count(comparison: Comparison) -> int:
    return len(comparison.targets[0])


def _cells(row: ControllerRow, comparison: Comparison) -> list[Cell]:
    crossing, hold, success = row.crossing, row.hold, row.crossing.success
    nothing = PaperRow(success="", error="", cycle="")
    paper = PAPER.get(row.controller, nothing) if comparison.arm == PAPER_ARM else nothing
    cycle = paper.cycle if _count(comparison) == PAPER_TARGETS else ""
    likely = interval(success.low, success.high, 2, factor=PERCENT)
    return [
        Cell(number(success.value * PERCENT, 3), _small_print(likely, paper.success)),
        Cell(_spread(crossing.error, MM), _small_print("", paper.error)),
        Cell(_mean(crossing.cycle_time, 1.0, 3), _small_print(_range(crossing.cycle_time, 1.0), cycle)),
        Cell(_mean(hold.settled, MM, 3), _small_print(_range(hold.settled, MM), "", _held(row, comparison))),
        *([_turned(hold)] if comparison.orientations else []),
        _true(hold),
        _stays(hold.stays),
        Cell(_mean(hold.oscillation, MM, 2)),
        _guard(row),
    ]


def _true(hold: HoldRow) -> Cell:
    """Give the true error; one that is modelled says so."""
    found = hold.true_error
    if found.value is None or found.how == "known":
        return Cell(_mean(hold.settled_true, MM, 2), _range(hold.settled_true, MM, 2))
    return Cell(f"{number(found.value * MM, 2)}, {found.how}", found.range)


def _turned(hold: HoldRow) -> Cell:
    degrees = float(np.degrees(1.0))
    return Cell(_mean(hold.turned, degrees, 2), _range(hold.turned, degrees, 2))


def _small_print(own: str, paper: str, more: str = "") -> str:
    return "\n".join(part for part in (own, f"paper: {paper}" if paper else "", more) if part)


def _held(row: ControllerRow, comparison: Comparison) -> str:
    """Say how many targets a controller had in a race."""
    return "" if comparison.race is None else f"{plural(row.held, 'target')}"


def _mean(value: Spread | None, factor: float, digits: int) -> str:
    return UNKNOWN if value is None else number(value.mean.value * factor, digits)


def _range(value: Spread | None, factor: float, digits: int = 3) -> str:
    return "" if value is None else interval(value.mean.low, value.mean.high, digits, factor=factor)


def _spread(value: Spread | None, factor: float) -> str:
    if value is None:
        return UNKNOWN
    return spread(value.mean.value * factor, None if value.std is None else value.std * factor)


def _stays(stays: tuple[Stay, ...]) -> Cell:
    times = " / ".join(NEVER if stay.median is None else number(stay.median, 2) for stay in stays)
    shares = " / ".join(f"{stay.share.value * PERCENT:.0f}" for stay in stays)
    return Cell(times or UNKNOWN, f"{shares} %" if stays else "")


def _guard(row: ControllerRow) -> Cell:
    reasons = [f"{number(count.share * PERCENT, 2)} % {count.reason}" for count in row.guard]
    stopped = [f"{plural(row.failures, 'trial')} stopped"] if row.failures else []
    what, _, where = row.out.partition(" (")
    out = [f"stopped: {what}", *([where.removesuffix(")")] if where else [])] if row.out else []
    parts = [*out, *stopped, *reasons] or [NEVER]
    return Cell(parts[0], "\n".join(parts[1:]))


def _without(comparison: Comparison) -> str:
    """Say what has no interval."""
    trials = len(comparison.targets) * comparison.repetitions
    if trials >= FEWEST_CLUSTERS:
        return ""
    whole = f"; none for the time of {plural(_count(comparison), 'target')}"
    if trials * _count(comparison) < FEWEST_CLUSTERS:
        whole = "; none where they would be"
    return f"{whole}: {plural(trials, 'trial')} of it say{'s' * (trials == 1)} too little about another one"


def _notes(comparison: Comparison) -> tuple[str, ...]:
    protocol, sets = comparison.protocol, len(comparison.targets)
    how = "side by side on equal emulated arms" if comparison.batched else "interleaved on the same arm"
    if comparison.most is not None:
        how += (
            f", in a race of at most {plural(comparison.most[0] * comparison.most[1] * _count(comparison), 'target')}"
        )
    notes = [
        f"{plural(sets, 'set')} of {plural(_count(comparison), 'target')}, "
        f"{plural(comparison.repetitions, 'repetition')}, {how}. Small print: 95 % intervals, resampled over "
        f"{comparison.clusters}{_without(comparison)}.",
        _crossings(comparison),
        f"Settled error: mean over the last {protocol.window:g} s of {protocol.hold:g} s at each target. Time to stay "
        f"within a distance: median over the holds, and the share that does; “{NEVER}” where fewer than half do. "
        "Oscillation: root mean square around the settled position. Guard: share of all control cycles, by reason.",
    ]
    if comparison.race is not None:
        notes.append(_race(comparison.race))
    notes += [
        f"{row.controller} was not driven again where {row.source} had measured it, open loop."
        for row in comparison.rows
        if row.source
    ]
    if comparison.arm == PAPER_ARM:
        notes.append(
            "“paper”: Park et al. 2024 (IEEE Access), Table 4, measured on their own worn myCobot 280, for reference."
        )
    if not comparison.true_known:
        modelled = any(row.hold.settled_modelled is not None for row in comparison.rows)
        notes.append(
            "True error: modelled by the calibration at the postures in which the arm came to rest; its interval holds "
            "what the calibration leaves open."
            if modelled
            else "The true position of the tool is not known on this robot: it has to be measured from outside."
        )
    if comparison.calibration:
        aimed = f"All controllers were aimed by the calibration of {day_and_time(comparison.calibration)}."
        notes.append(f"{aimed} Encoder errors are distances from the aim, true errors from the target.")
    return tuple(notes)


def _crossings(comparison: Comparison) -> str:
    """Say what it means to reach a target, and how long that takes."""
    protocol, count = comparison.protocol, plural(_count(comparison), "target")
    what = "Success, error at the crossing and time for the targets"
    if comparison.race is not None:
        return (
            f"{what}: read from the holds, where {protocol.threshold * MM:g} mm are first crossed, each target come to "
            f"from rest. The time is that for {count} at the mean of those driven to; none where one was missed."
        )
    return (
        f"{what}: the protocol of Park et al. 2024. The next target is set at the first crossing of "
        f"{protocol.threshold * MM:g} mm or after {protocol.dwell:g} s, which count in full where an arm stood for "
        f"{STANDS_FOR:g} s under one command and was not waited for; the error is the one at that moment, mean ± "
        "standard deviation."
    )


def _race(race: Race) -> str:
    """Say when a controller was stopped, and how sure that is."""
    return (
        "Race: a controller is better at a target if it alone reaches it, or else settles nearer by more than "
        f"{race.nearer * MM:g} mm, or else stays within the narrowest distance sooner by more than {race.sooner:g} s. "
        "Who is the worse one too often for chance is beaten, and driven no further; neither is who does not lead all "
        f"simpler ones by {race.lead * PERCENT:g} % of the targets or more. In {race.error * PERCENT:g} % of such "
        "races at most the best one is called beaten, and in as many one with such a lead is passed over, however "
        "often one looks. Of those left undecided the simplest is recommended that none leads by "
        f"{race.likely * PERCENT:g} %. The numbers of one that was stopped are of few targets, and of those that spoke "
        "against it."
    )


def poses_view(comparison: Comparison) -> Table | None:
    """Return accuracy and repeatability after ISO 9283, by the encoders and of the tool; None in old comparisons."""
    known = [row for row in comparison.rows if row.hold.poses is not None]
    if not known:
        return None
    rows = tuple(
        Row(cells=(Cell(row.controller), *_pose_cells(row.hold.poses), *_pose_cells(row.hold.poses_true)))
        for row in known
    )
    cycles = known[0].hold.poses.cycles if known[0].hold.poses is not None else 0
    notes = (
        "AP: distance from the target to the mean of the places attained; RP: mean distance of these places from their "
        "mean, and three standard deviations of it. Means over the targets as poses; small print: 95 % intervals. "
        f"{plural(cycles, 'cycle')} for each pose, where the norm asks for 30.",
        *_directions(comparison),
    )
    headers = ("controller", "AP, encoders [mm]", "RP, encoders [mm]", "AP, tool [mm]", "RP, tool [mm]")
    return Table(caption="Accuracy after ISO 9283", headers=headers, rows=rows, notes=notes)


def _directions(comparison: Comparison) -> tuple[str, ...]:
    """Say how far the place attained varies with the direction of approach, vAP."""
    found = comparison.directions
    if found is None:
        return ()
    ends = (("by the encoders", found.encoders), ("of the tool", found.tool))
    said = [f"{_mean(one, MM, 2)} mm {whose}{_in_brackets(_range(one, MM, 2))}" for whose, one in ends if one]
    return (
        f"vAP of {found.controller}: {' and '.join(said)}, the largest distance between the mean places attained from "
        f"three directions; mean over {plural(found.poses, 'pose')}, {plural(found.cycles, 'cycle')} from each "
        "direction, where the norm asks for 30.",
    )


def _in_brackets(text: str) -> str:
    return f" ({text})" if text else ""


def _pose_cells(found: PoseAccuracy | None) -> tuple[Cell, Cell]:
    accuracy, again = (None, None) if found is None else (found.accuracy, found.repeatability)
    return Cell(_mean(accuracy, MM, 2), _range(accuracy, MM, 2)), Cell(_mean(again, MM, 2), _range(again, MM, 2))
