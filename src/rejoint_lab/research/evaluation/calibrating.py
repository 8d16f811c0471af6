"""What outside measurements bring: fresh arms are measured, calibrated, and sent to fresh targets.

Calibrations from the first 1, 3, ... measurements take part like controllers, at the same targets: in the target
region, and anywhere that the worn arms reach and hold by their twins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.result import Columns
from rejoint.control.start import play
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.postures import Suggestion, suggest
from rejoint.system.progress import Progress
from rejoint.system.statistics import Estimate, wilson
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.research.evaluation.evaluate import Contestant, Evaluation, Trials, conclude
from rejoint_lab.research.evaluation.family import (
    FAMILY_SIZE,
    ArmFamily,
    OnTargets,
    TrialArms,
    Variant,
    open_family,
    own_twins,
    targets_anywhere,
    try_on,
)

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


@dataclass(frozen=True, kw_only=True)
class Accused:
    """Whether a wrong point among ten, 5 to 10 mm off, is found."""

    condition: str
    wrong: Estimate
    """share of arms whose wrong point was named first"""
    right: Estimate
    """share of arms with a right point named"""


def evaluate_calibrations(
    arm: Arm,
    conditions: Sequence[Variant],
    contestant: Contestant,
    family: ArmFamily,
    folder: Path,
    on_progress: Progress,
) -> tuple[Evaluation, list[Accused]]:
    """Try calibrations under all conditions; twins of the worn arms are kept in ``folder``."""
    on_progress(0.0, "twins, for targets anywhere")
    box = draw_targets(arm, sets=family.arms, count=family.targets, seed=FAMILY_SIZE * (family.seed + 1) + 1)
    places = {
        "target region": (box, None),
        "anywhere": targets_anywhere(arm, family, own_twins(arm, family.wear_seeds, folder, family.seed)),
    }
    suggestion = suggest(arm, max(POINTS), visits=2, sigma=SIGMA)
    counts = {"not calibrated": 0} | {f"{count} points": count for count in POINTS}

    @cache
    def measured(condition: Variant) -> list[Measurements]:
        return measure(open_family(arm, condition, family), suggestion, family.seed)

    @cache
    def calibrated(condition: Variant, count: int) -> list[Calibration]:
        return fitted(arm, measured(condition), count) if count else []

    def drive(condition: Variant, where: str, count: int, on_targets: OnTargets) -> Columns:
        (targets, ways), found = places[where], calibrated(condition, count)
        opened = partial(open_family, arm, condition, family)
        arms = TrialArms(open=opened, targets=targets, ways=ways, wear_seeds=family.wear_seeds, calibrations=found)
        return try_on(arm, arms, lambda arm: contestant.make(arm, ()), family, on_targets)

    trials = {
        (f"{condition.name}, {where}", name): Trials(
            f"{condition!r}, {contestant.identity}", partial(drive, condition, where, count)
        )
        for condition in conditions
        for where in places
        for name, count in counts.items()
    }
    meanings = {f"{one.name}, {where}": f"{one.meaning}, {where}" for one in conditions for where in places}
    calibrations = [name for name, count in counts.items() if count]
    result = conclude(arm, meanings, trials, calibrations, family, folder / "calibration.json", on_progress)
    return result, [find_wrong(arm, one.name, measured(one), family) for one in conditions]


def measure(robot: EmulatedRobot, suggestion: Suggestion, seed: int) -> list[Measurements]:
    """Bring all arms to the postures and measure their tools with noise; measurements of each arm."""
    rng = np.random.default_rng([seed, 3])
    sent, found = robot.read().position, []
    for place, start in zip(suggestion.postures, suggestion.approach, strict=True):
        for goal in (start, place):
            came, sent = robot.read().position, _go(robot, sent, goal)
        last = [robot.step(sent).position for _ in range(8)]
        point = robot.true_tcp() + rng.normal(0.0, SIGMA, (robot.count, 3))
        found.append((np.mean(last, axis=0), came, point))
    sigma, posture = np.full(len(found), SIGMA), suggestion.posture
    each = zip(*(np.stack(parts, axis=1) for parts in zip(*found, strict=True)), strict=True)
    return [
        Measurements(position=position, approach=approach, point=point, sigma=sigma, posture=posture)
        for position, approach, point in each
    ]


def fitted(arm: Arm, measured: Sequence[Measurements], count: int) -> list[Calibration]:
    """Calibrations of all arms from their first measurements."""
    return [fit(arm, one.rows(np.arange(count))) for one in measured]


def find_wrong(arm: Arm, condition: str, measured: Sequence[Measurements], family: ArmFamily) -> Accused:
    """Put a wrong point among the first ten of each arm, and fit with and without it."""
    named = accused = 0
    for seed, one in zip(family.wear_seeds, measured, strict=True):
        rng, right = np.random.default_rng([seed, 4]), one.rows(np.arange(WRONG_AMONG))
        row, away = int(rng.integers(WRONG_AMONG)), rng.normal(size=3)
        point = right.point.copy()
        point[row] += away * rng.uniform(*WRONG) / np.linalg.norm(away)
        accused += bool(fit(arm, right).suspects)
        named += fit(arm, replace(right, point=point)).suspects[:1] == (row,)
    return Accused(condition=condition, wrong=wilson(named, family.arms), right=wilson(accused, family.arms))


def _go(robot: EmulatedRobot, sent: Array, goal: Array) -> Array:
    """Bring all arms to ``goal`` (n,) [rad] and wait; returns the last command (B, n)."""
    way = goal - sent
    duration = float(np.abs(way).max()) / SPEED
    recording = play(robot, lambda time: sent + np.minimum(time / duration, 1.0)[:, None] * way, duration + WAIT)
    return recording.command[-1]
