"""What outside measurements bring: fresh arms are measured, calibrated, and sent to fresh targets.

All arms of a condition are one batch. Calibrations from the first 1, 3, ... measurements drive to the same targets:
in the target region, and anywhere that the worn arms reach and hold by their twins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.control.comparison.result import Columns
from rejoint.control.start import play
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.postures import Suggestion, suggest
from rejoint.pages.words import MM, measured, number
from rejoint.system.progress import Progress, part
from rejoint.system.shell import __version__
from rejoint.system.statistics import Estimate, Spread, clustered_share, spread, wilson
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.research.evaluation.evaluate import Contestant
from rejoint_lab.research.evaluation.family import FAMILY_SIZE, ArmFamily, Variant, open_family, targets_anywhere
from rejoint_lab.research.evaluation.trials import TrialArms, TrialSettings, own_twins, try_on

POINTS = (1, 3, 5, 10, 20)
"""Numbers of measurements from which arms are calibrated"""
SIGMA = 5e-4
"""[m] noise of each measured coordinate (chosen: a vernier ruler)"""
WRONG = (5e-3, 10e-3)
"""[m] error of a wrong point (chosen)"""
WRONG_AMONG = 10
"""Measurements among which one is wrong"""
SPEED, WAIT = 0.5, 1.5
"""[rad/s] and [s]: speed to a posture, and wait before measuring (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """What was measured on A arms at P postures."""

    position: Array
    """(A, P, n) [rad] encoders"""
    approach: Array
    """(A, P, n) [rad] encoders before the last motion"""
    point: Array
    """(A, P, 3) [m] with noise"""
    posture: NDArray[np.int64]
    """(P,) numbers of the postures"""

    def first(self, arm: int, count: int) -> Measurements:
        """Return the first measurements of one arm."""
        return Measurements(
            position=self.position[arm, :count],
            approach=self.approach[arm, :count],
            point=self.point[arm, :count],
            sigma=np.full(count, SIGMA),
            posture=self.posture[:count],
        )

    def fitted(self, arm: Arm, count: int) -> list[Calibration]:
        """Calibrations of all arms from their first measurements; none for 0."""
        return [fit(arm, self.first(i, count)) for i in range(len(self.point))] if count else []


@dataclass(frozen=True, kw_only=True)
class CalibratedRow:
    """Arms of one condition, calibrated from so many points."""

    condition: str
    where: str
    """name of the part of the workspace"""
    points: int
    """0: not calibrated"""
    settled_true: Spread | None
    """[m] at fresh targets"""
    expected: float | None = None
    """[m] the same by the calibrations themselves"""
    inside: Estimate | None = None
    """share of targets whose true error was in the calibration's interval"""
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
    named: dict[str, Estimate] = field(default_factory=dict)
    """by condition: share of arms whose wrong point was named first"""
    accused: dict[str, Estimate] = field(default_factory=dict)
    """by condition: share of arms with a right point named"""


def evaluate_calibrations(
    arm: Arm,
    conditions: Sequence[Variant],
    contestant: Contestant,
    settings: TrialSettings,
    folder: Path,
    on_progress: Progress,
) -> CalibrationEvaluation:
    """Try calibrations under all conditions; twins of the worn arms are kept in ``folder``."""
    on_progress(0.0, "twins, for targets anywhere")
    family = settings.family
    box = draw_targets(arm, sets=family.arms, count=family.targets, seed=FAMILY_SIZE * (family.seed + 1) + 1)
    anywhere = targets_anywhere(arm, family, own_twins(arm, family.wear_seeds, folder, family.seed))
    suggestion = suggest(arm, max(POINTS), visits=2, sigma=SIGMA)
    result = CalibrationEvaluation(
        arm=arm.name,
        software=__version__,
        controller=contestant.name,
        family=family,
        meanings={one.name: one.meaning for one in conditions},
        rows=(),
    )
    for i, condition in enumerate(conditions):
        ahead = part(on_progress, i / len(conditions), (i + 1) / len(conditions), f"{condition.name}: ")
        opened = partial(open_family, arm, condition, family, settings.threads)
        ahead(0.0, "measuring")
        points = measure(opened(), suggestion, family.seed)
        calibrations = {count: points.fitted(arm, count) for count in (0, *POINTS)}
        rows = []
        for k, (where, (targets, ways)) in enumerate({"target region": (box, None), "anywhere": anywhere}.items()):
            tried = dict[int, Columns]()
            arms = TrialArms(open=opened, targets=targets, ways=ways, wear_seeds=family.wear_seeds)
            for j, (count, found) in enumerate(calibrations.items()):
                ahead((1 + j + k * len(calibrations)) / (1 + 2 * len(calibrations)), f"{where}, {count} points")
                corrected = replace(arms, calibrations=found)
                tried[count] = try_on(arm, corrected, contestant.on(()), settings)
                rows.append(make_row(condition.name, where, count, found, tried))
        named, accused = (
            {condition.name: wilson(float(hits.sum()), family.arms)} for hits in find_wrong(arm, points, family)
        )
        result = replace(
            result, rows=(*result.rows, *rows), named=result.named | named, accused=result.accused | accused
        )
    return result


def make_row(
    condition: str, where: str, points: int, found: Sequence[Calibration], tried: dict[int, Columns]
) -> CalibratedRow:
    """Sum up trials with so many ``points``, of those by number of points; intervals resample arms."""
    error, before = (tried[count]["settled_true"] for count in (points, 0))
    arms = np.repeat(np.arange(len(error)), error.shape[1])
    row = CalibratedRow(condition=condition, where=where, points=points, settled_true=spread(error.ravel(), arms))
    if not points:
        return row
    modelled = tried[points]["modelled"][np.isfinite(tried[points]["modelled"])]  # no model, no expectation
    return replace(
        row,
        expected=float(modelled.mean()) if len(modelled) else None,
        inside=clustered_share(inside(tried[points]).ravel(), arms),
        used=float(np.mean([one.used for one in found])),
        harm=float(np.nanmax(np.nanmean(error, axis=1) - np.nanmean(before, axis=1))),
    )


def inside(found: Columns) -> Array:
    """1 where a true error lies in the interval of the calibration, else 0; NaN where a hold was cut short."""
    error = found["settled_true"]
    hit = (error >= found["modelled_low"]) & (error <= found["modelled_high"])
    return np.where(np.isfinite(error), hit, np.nan)


def measure(robot: EmulatedRobot, suggestion: Suggestion, seed: int) -> Measured:
    """Bring all arms to the postures and measure their tools with noise."""
    rng = np.random.default_rng([seed, 3])
    sent, found = robot.read().position, []
    for place, start in zip(suggestion.postures, suggestion.approach, strict=True):
        for goal in (start, place):
            came, sent = robot.read().position, _go(robot, sent, goal)
        last = [robot.step(sent).position for _ in range(8)]
        point = robot.true_tcp() + rng.normal(0.0, SIGMA, (robot.count, 3))
        found.append((np.mean(last, axis=0), came, point))
    position, approach, point = (np.stack(parts, axis=1) for parts in zip(*found, strict=True))
    return Measured(position=position, approach=approach, point=point, posture=suggestion.posture)


def find_wrong(arm: Arm, measured: Measured, family: ArmFamily) -> NDArray[np.bool_]:
    """Tell for each arm whether a wrong point is named, and whether a right one is, (2, A)."""
    named, accused = found = np.zeros((2, family.arms), dtype=bool)
    for i in range(family.arms):
        rng = np.random.default_rng([family.wear_seed(i), 4])
        right = measured.first(i, WRONG_AMONG)
        row, away = int(rng.integers(WRONG_AMONG)), rng.normal(size=3)
        point = right.point.copy()
        point[row] += away * rng.uniform(*WRONG) / np.linalg.norm(away)
        accused[i] = len(fit(arm, right).suspects) > 0
        named[i] = fit(arm, replace(right, point=point)).suspects[:1] == (row,)
    return found


def _go(robot: EmulatedRobot, sent: Array, goal: Array) -> Array:
    """Bring all arms to ``goal`` (n,) [rad] and wait; returns the last command (B, n)."""
    way = goal - sent
    duration = float(np.abs(way).max()) / SPEED
    recording = play(robot, lambda time: sent + np.minimum(time / duration, 1.0)[:, None] * way, duration + WAIT)
    return recording.command[-1]


HEADERS = (
    "where",
    "points",
    "true error, mm",
    "95 % below, mm",
    "expected, mm",
    "in the interval, %",
    "corrected arms, %",
    "worst arm, mm farther off",
)


def tables(result: CalibrationEvaluation) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, headers and rows of each table."""
    found = []
    for name, meaning in result.meanings.items():
        cells = [_cells(row) for row in result.rows if row.condition == name]
        found.append((f"{meaning}: {result.family.arms}, {result.controller}", list(HEADERS), cells))
    wrong = [
        [name, *(str(measured(shares[name], 100, 3)) for shares in (result.named, result.accused))]
        for name in result.meanings
    ]
    headers = ["condition", "wrong point named, % of arms", "right point named, % of arms"]
    return [*found, ("One wrong point among ten, 5 to 10 mm off", headers, wrong)]


def _cells(row: CalibratedRow) -> list[str]:
    error = row.settled_true
    cells = [
        row.where,
        str(row.points or "none"),
        str(measured(error, MM, 3)),
        number(None if error is None else error.p95 * MM, 3),
    ]
    if row.expected is None or row.used is None or row.harm is None:
        return [*cells, "", "", "", ""]
    shares = str(measured(row.inside, 100, 3)), number(100 * row.used, 3)
    return [*cells, number(row.expected * MM, 3), *shares, f"{row.harm * MM:+.2f}"]
