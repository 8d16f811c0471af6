"""What calibrations brought, as numbers and as tables of words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.pages.report.numerals import interval, number
from rejoint.research.evaluation.calibrating import Trials, Tried
from rejoint.research.evaluation.family import ArmFamily
from rejoint.system.statistics import Estimate, bootstrap_mean, clustered_share, wilson

HEADERS = ("points", "true error, mm", "95 % below, mm", "expected, mm", "in the interval, %", "corrected arms, %",
           "worst arm, mm farther off")  # fmt: skip
MM = 1e3


@dataclass(frozen=True, kw_only=True)
class CalibratedRow:
    """Arms of one condition, calibrated from so many points."""

    condition: str
    points: int
    """0: not calibrated"""
    error: Estimate
    """[m] mean true error at fresh targets"""
    p95: float
    """[m]"""
    expected: float | None = None
    """[m] root mean square error by the calibrations themselves"""
    inside: Estimate | None = None
    """share of the targets whose true error lay in the interval of the calibration"""
    used: float | None = None
    """share of the arms that were corrected"""
    harm: float | None = None
    """[m] largest difference of an arm's mean error from that without calibration"""


@dataclass(frozen=True, kw_only=True)
class CalibrationEvaluation:
    """All conditions."""

    arm: str
    software: str
    controller: str
    family: ArmFamily
    meanings: dict[str, str]
    rows: tuple[CalibratedRow, ...]
    named: dict[str, Estimate]
    """by condition: share of the arms in which the wrong point among ten was named first"""
    accused: dict[str, Estimate]
    """by condition: share of the arms in which a right point among ten right ones was named"""


def rows_of(trials: Trials) -> tuple[CalibratedRow, ...]:
    """Sum up one condition; intervals resample arms."""
    name, before = trials.condition.name, trials.before
    first = CalibratedRow(condition=name, points=0, error=_mean(before), p95=_p95(before))
    return (first, *(_row(name, before, tried) for tried in trials.tried))


def shares_of(trials: Trials) -> tuple[Estimate, Estimate]:
    """Return in which share of the arms the wrong point was named, and in which a right one."""
    count = len(trials.named)
    return wilson(float(trials.named.sum()), count), wilson(float((trials.accused > 0).sum()), count)


def tables(result: CalibrationEvaluation) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, headers and rows of a table per condition, and of one of wrong points."""
    found = []
    for name, meaning in result.meanings.items():
        cells = [_cells(row) for row in result.rows if row.condition == name]
        found.append((f"{meaning}: {result.family.arms}, {result.controller}", list(HEADERS), cells))
    wrong = [[name, _percent(result.named[name]), _percent(result.accused[name])] for name in result.meanings]
    headers = ["condition", "wrong point named, % of arms", "right point named, % of arms"]
    return [*found, ("One wrong point among ten, 5 to 10 mm off", headers, wrong)]


def _row(name: str, before: Array, tried: Tried) -> CalibratedRow:
    arms = np.repeat(np.arange(len(tried.error)), tried.error.shape[1])
    known = np.where(np.isfinite(tried.error), tried.inside, np.nan)
    return CalibratedRow(
        condition=name, points=tried.points, error=_mean(tried.error), p95=_p95(tried.error),
        expected=float(np.sqrt(np.nanmean(tried.expected**2))), inside=clustered_share(known.ravel(), arms),
        used=float(tried.used.mean()),
        harm=float(np.nanmax(np.nanmean(tried.error, axis=1) - np.nanmean(before, axis=1))),
    )  # fmt: skip


def _cells(row: CalibratedRow) -> list[str]:
    known = interval(row.error.low, row.error.high, 3, factor=MM)
    error = f"{number(row.error.value * MM, 3)} ({known})" if known else number(row.error.value * MM, 3)
    if row.expected is None or row.inside is None or row.used is None or row.harm is None:
        return ["none", error, number(row.p95 * MM, 3), "", "", "", ""]
    shares = [_percent(row.inside), number(100 * row.used, 3), f"{row.harm * MM:+.2f}"]
    return [str(row.points), error, number(row.p95 * MM, 3), number(row.expected * MM, 3), *shares]


def _percent(share: Estimate) -> str:
    return f"{number(100 * share.value, 3)} ({interval(share.low, share.high, 3, factor=100)})"


def _mean(errors: Array) -> Estimate:
    return bootstrap_mean(errors.ravel(), np.repeat(np.arange(len(errors)), errors.shape[1]))


def _p95(errors: Array) -> float:
    return float(np.nanquantile(errors, 0.95))


def conclude(
    arm: str, software: str, controller: str, family: ArmFamily, trials: Sequence[Trials]
) -> CalibrationEvaluation:
    """Put conditions together."""
    shares = {one.condition.name: shares_of(one) for one in trials}
    return CalibrationEvaluation(
        arm=arm, software=software, controller=controller, family=family,
        meanings={one.condition.name: one.condition.meaning for one in trials},
        rows=tuple(row for one in trials for row in rows_of(one)),
        named={name: named for name, (named, _) in shares.items()},
        accused={name: accused for name, (_, accused) in shares.items()},
    )  # fmt: skip
