"""Which fit to trust, in words and numbers: from predictions of motion that no fit has seen. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.pages.report.numerals import interval, number
from rejoint.pages.report.words import listed, plural
from rejoint.system.statistics import Estimate, above_zero, bootstrap_mean
from rejoint.twin.judgement import NO_TWIN, Error, Judgement

MM = 1e3

FEWEST = 3
"""Motions below which no interval is given (chosen: two say nothing about a third)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """One prediction over all motions."""

    name: str
    free_mm: Array
    """(K,) of each motion; NaN where it has no free space"""
    contact_mm: Array
    """(K,) likewise"""

    def mean(self, where: str) -> Estimate | None:
        """Mean over the motions with its 95 % interval over motions; None if no motion has such rows."""
        values: Array = getattr(self, f"{where}_mm")
        known = values[np.isfinite(values)]
        if not len(known):
            return None
        return bootstrap_mean(known, np.arange(len(known)), fewest=FEWEST)


def scores(judgement: Judgement) -> tuple[Score, ...]:
    """Collect the errors of every prediction, motion by motion."""

    def value(error: Error | None) -> float:
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
    """Say which prediction to trust, how far, and where not; the first sentence is the answer."""
    found = scores(judgement)
    lines = [*_free(judgement, found), *_contact(judgement, found)]
    own = judgement.repeatability
    if own is not None:
        lines.append(
            f"The arm itself repeats a motion within {number(own.tcp * MM, 2, 'mm')} (from {own.lowest * MM:.2f} to "
            f"{own.highest * MM:.2f} in {plural(len(own.motions), 'motion')} that repeat): no twin can be asked for "
            "less."
        )
    else:
        lines.append("How closely the arm repeats itself is not known: none of these motions repeats.")
    lines.append("All this is by the arm's own encoders: play and flex behind them show in no log.")
    return tuple(lines)


def gap(one: Score, other: Score) -> Estimate | None:
    """Mean of how much larger ``other``'s error in free space is, motion by motion [mm], with its interval."""
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
    worst = int(np.nanargmax(best.free_mm))
    lines.append(
        f"It is worst in {judgement.motions[worst].motion} ({number(best.free_mm[worst], 2, 'mm')}), and within "
        f"{number(float(np.nanmedian(best.free_mm)), 2, 'mm')} in half of the motions."
    )
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
