"""Results as cells of words, for a page or the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.result import Comparison, ControllerRow, Protocol
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.pages.words import MM, NEVER, UNKNOWN, Cell, interval, listed, measured, number, plural, spread
from rejoint.system.statistics import NORMAL95, Estimate, Spread, above_zero, bootstrap_mean
from rejoint.twin.judgement import NO_TWIN, Judgement, PredictionError

DEG = float(np.degrees(1.0))


class ResultColumn(NamedTuple):
    """A column of a table of controllers."""

    header: str
    cell: Callable[[ControllerRow], Cell]


def columns(comparison: Comparison) -> tuple[ResultColumn, ...]:
    """Columns of a comparison, without the names."""
    basic = result_columns(comparison.protocol, len(comparison.targets[0]), comparison.block)
    turned = ResultColumn("orientation, encoders [deg]", lambda row: measured(row.turned, DEG))
    return (*basic[:4], *([turned] if comparison.orientations else []), *basic[4:], ResultColumn("guard", _guard))


def result_columns(protocol: Protocol, count: int, block: int = 0) -> tuple[ResultColumn, ...]:
    """Columns of what controllers reach at ``count`` targets, in blocks of ``block``."""
    within = " / ".join(f"{distance * MM:g}" for distance in protocol.within)
    return (
        ResultColumn("success [%]", _success),
        ResultColumn("error at the crossing [mm]", lambda row: Cell(_crossing(row.crossing_error))),
        ResultColumn(f"{plural(count, 'target')} [s]", lambda row: measured(row.cycle_time, 1.0, 3)),
        ResultColumn("settled error, encoders [mm]", lambda row: _settled(row, block)),
        ResultColumn("settled error, true [mm]", _true),
        ResultColumn(f"time to stay within {within} mm [s]", _stays),
        ResultColumn("oscillation [mm]", lambda row: Cell(measured(row.oscillation).text)),
    )


def plain_table(
    found: Sequence[ResultColumn], rows: Iterable[ControllerRow], *, notes: bool = False
) -> tuple[list[str], list[list[str]]]:
    """Headers and rows of plain text, first column the controllers; ``notes``: with the small print."""
    lines = [
        [f"{row.controller}{' (by diagnosis)' if row.source else ''}", *map(str, cells)]
        for row in rows
        for cells in [[column.cell(row) if notes else column.cell(row).text for column in found]]
    ]
    return ["controller", *(column.header for column in found)], lines


def _success(row: ControllerRow) -> Cell:
    one = row.success
    return Cell(number(100 * row.reached, 3), "" if one is None else interval(one.low, one.high, 2, factor=100))


def _crossing(found: Spread | None) -> str:
    return UNKNOWN if found is None else spread(MM * found.mean.value, MM * (found.std or math.nan))


def _settled(row: ControllerRow, block: int) -> Cell:
    text, note = measured(row.settled, MM, 3)
    held = plural(row.held, "target") if block else ""  # at fewer than all where some are eliminated
    return Cell(text, "\n".join(filter(None, (note, held))))


def _true(row: ControllerRow) -> Cell:
    true = row.true_error
    if true.value is None or true.how == "known":
        return measured(row.settled_true)
    return Cell(f"{number(MM * true.value, 2)}, {true.how}", true.range)


def _stays(row: ControllerRow) -> Cell:
    stays = " / ".join(NEVER if stay.median is None else number(stay.median, 2) for stay in row.stays)
    shares = " / ".join(f"{100 * stay.share.value:.0f}" for stay in row.stays)
    return Cell(stays or UNKNOWN, f"{shares} %" if stays else "")


def _guard(row: ControllerRow) -> Cell:
    what, _, where = row.out.partition(" (")
    out = [f"stopped: {what}", *([where.removesuffix(")")] if where else [])] if row.out else []
    stopped = [f"{plural(row.failures, 'trial')} stopped"] if row.failures else []
    reasons = (f"{number(100 * share, 2)} % {reason}" for reason, share in row.guard.items())
    first, *more = [*out, *stopped, *reasons] or [NEVER]
    return Cell(first, "\n".join(more))


def directions(comparison: Comparison) -> tuple[str, ...]:
    """Report vAP: variation with the direction of approach."""
    found = comparison.directions
    if found is None:
        return ()
    ends = [(measured(one), whose) for one, whose in ((found.encoders, "by the encoders"), (found.tool, "of the tool"))]
    said = [f"{text} mm {whose}{f' ({note})' if note else ''}" for (text, note), whose in ends if text != UNKNOWN]
    return (
        f"vAP of {found.controller}: {' and '.join(said)}, the largest distance between the mean places attained from "
        f"three directions; mean over {plural(found.poses, 'pose')}, {plural(found.cycles, 'cycle')} from each "
        "direction, where the norm asks for 30.",
    )


def behind(found: Calibration) -> list[tuple[str, list[Cell]]]:
    """Offset, compliance and play per joint [deg, deg/(N m), deg], with the fit's intervals."""
    sigma, rows = np.sqrt(np.diag(found.covariance)), []
    for i, name in enumerate(found.arm.joint_names):
        row = []
        for kind in ("offset", "compliance", "play"):
            value, half = float(getattr(found.displacement, kind)[i]), NORMAL95 * float(sigma[found.layout.at(kind)][i])
            low = value - half if kind == "offset" else max(value - half, 0.0)
            row.append(measured(Estimate(value, low, value + half), DEG))
        rows.append((name, row))
    return rows


class Quantity(NamedTuple):
    """A measured quantity of a joint."""

    field: str
    """of `JointMetrics`"""
    name: str
    unit: str
    meaning: str
    """plain words"""
    factor: float = 1.0
    """from SI to ``unit``"""
    signed: bool = False
    """may be negative"""
    parameter: str = ""
    """of a twin, if the same property"""

    def healthy(self, estimate: Estimate | None) -> str:
        """Range of a healthy joint."""
        if estimate is None or estimate.low is None:
            return UNKNOWN
        low = estimate.low if self.signed else max(estimate.low, 0.0)
        return interval(low, estimate.high, 2, factor=self.factor) or UNKNOWN


QUANTITIES = (
    Quantity(
        "stiffness_nm_per_rad",
        "stiffness",
        "N m/rad",
        "how strongly the servo holds its position; soft joints sag",
        parameter="stiffness",
    ),
    Quantity(
        "hysteresis_rad",
        "hysteresis",
        "deg",
        "how far apart the joint stops when it comes from below and from above",
        DEG,
    ),
    Quantity("coulomb_nm", "dry friction", "N m", "torque that is lost before anything moves", parameter="coulomb"),
    Quantity("lag_s", "lag", "ms", "how far the joint trails behind its command in motion", 1e3),
    Quantity("damping_ratio", "damping ratio", "1", "1 comes to rest at once, 0.3 rings"),
    Quantity("overshoot", "overshoot", "%", "how far it shoots beyond after a step", 1e2),
    Quantity(
        "offset_rad",
        "offset",
        "deg",
        "how far the joint rests from its command where nothing loads it",
        DEG,
        parameter="offset",
        signed=True,
    ),
    Quantity("hunting_rad", "unrest", "deg", "motion while nothing is asked of the joint", DEG),
    Quantity("noise_rad", "noise", "deg", "scatter of single readings at rest", DEG),
)


FEWEST = 3
"""Motions for an interval (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """A prediction over all motions."""

    name: str
    free_mm: Array
    """(K,) per motion; NaN: no free space"""
    contact_mm: Array
    """(K,) likewise"""

    def mean(self, where: str) -> Estimate | None:
        """Mean with 95 % interval over motions, or None."""
        values: Array = getattr(self, f"{where}_mm")
        known = values[np.isfinite(values)]
        if not len(known):
            return None
        return bootstrap_mean(known, np.arange(len(known)), fewest=FEWEST)


def scores(judgement: Judgement) -> tuple[Score, ...]:
    """Errors of every prediction per motion."""

    def value(error: PredictionError | None) -> float:
        return float("nan") if error is None else error.tcp * MM

    return tuple(
        Score(
            name=name,
            free_mm=np.array([value(motion.errors[name].free) for motion in judgement.motions]),
            contact_mm=np.array([value(motion.errors[name].contact) for motion in judgement.motions]),
        )
        for name in judgement.mean
    )


def answer(judgement: Judgement) -> tuple[str, ...]:
    """Say which prediction to trust, how far and where; the answer first."""
    found = scores(judgement)
    lines = [*_free(judgement, found), *_contact(judgement, found)]
    lines.append("All this is by the arm's own encoders: play and flex behind them show in no log.")
    return tuple(lines)


def gap(one: Score, other: Score) -> Estimate | None:
    """Mean difference of errors in free space [mm], paired by motion, with interval."""
    difference = other.free_mm - one.free_mm
    known = difference[np.isfinite(difference)]
    return bootstrap_mean(known, np.arange(len(known)), fewest=FEWEST) if len(known) >= FEWEST else None


def _free(judgement: Judgement, found: tuple[Score, ...]) -> list[str]:
    known = [(score, mean) for score in found if (mean := score.mean("free")) is not None]
    if not known:
        return ["Nothing can be said about free space: no motion shows it."]
    (best, mean), *others = sorted(known, key=lambda pair: pair[1].value)
    count = int(np.isfinite(best.free_mm).sum())
    rest = listed([f"{score.name} {number(value.value, 3, 'mm')}" for score, value in others], "and")
    motions = f"mean of {plural(count, 'motion')}{_interval(mean)}"
    lines = (
        [
            f"Trust none of them: {'; '.join(judgement.doubts)}.",
            f"“{best.name}” comes nearest, within {number(mean.value, 3, 'mm')} in free space ({motions}).",
        ]
        if judgement.doubts
        else [
            f"Trust “{best.name}”: it predicts the tool within {number(mean.value, 3, 'mm')} in free space ({motions})."
        ]
    )
    if best.name == NO_TWIN and not judgement.doubts:
        lines = [
            f"Trust none of them: the command alone predicts better, within {number(mean.value, 3, 'mm')} ({motions})."
        ]
    lines.append(f"The others: {rest}.")
    close = [score.name for score, _ in others if (apart := gap(best, score)) is None or not above_zero(apart)]
    if close:
        names = listed([f"“{name}”" for name in close], "and")
        lines.append(f"{names} {'is' if len(close) == 1 else 'are'} not measurably worse in these motions.")
    return lines


def _contact(judgement: Judgement, found: tuple[Score, ...]) -> list[str]:
    known = [(score, mean) for score in found if (mean := score.mean("contact")) is not None]
    if not known:
        return ["The arm touches nothing in these motions: how they predict contact is not known."]
    best, mean = min(known, key=lambda pair: pair[1].value)
    seconds = sum(motion.contact_seconds for motion in judgement.motions)
    return [
        f"On the table ({seconds:.0f} s) “{best.name}” is closest, within {number(mean.value, 3, 'mm')}"
        f"{_interval(mean)}."
    ]


def _interval(estimate: Estimate) -> str:
    text = interval(estimate.low, estimate.high, 3)
    return f", 95 %: {text}" if text else ""
