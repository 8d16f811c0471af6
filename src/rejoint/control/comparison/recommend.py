"""The simplest controller that no other beats significantly.

Criteria in order: targets reached, settled encoder error, time to stay within the narrowest distance, then the wider
ones. A 95 % interval that contains zero is a tie. Eliminated controllers are out, unless all are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.control.catalogue import CONTROLLERS
from rejoint.control.comparison.result import Comparison, ControllerRow
from rejoint.control.servogains import inner_name
from rejoint.system.statistics import FEWEST_CLUSTERS, Estimate, above_zero, cluster, paired_difference

SOONER = 0.2
"""[s] relevant difference (chosen)"""
NO_INTERVAL = "too few trials for an interval"


@dataclass(frozen=True, kw_only=True)
class Recommendation:
    """The recommended controller."""

    controller: str
    why: tuple[str, ...]
    """the most important first"""
    tied: tuple[str, ...] = ()
    """less simple controllers"""


@dataclass(frozen=True, kw_only=True)
class _Criterion:
    name: str
    results: Callable[[str], Array]
    """(N,) per target; smaller is better"""
    missing: float
    """value of a missing result"""
    show: Callable[[float], str]
    plain: float
    """significant difference without an interval"""
    matters: float = 0.0
    """smallest relevant difference"""


def recommend(comparison: Comparison) -> Recommendation:
    """Recommend a controller of ``comparison``."""
    left = [row for row in comparison.rows if not row.out] or list(comparison.rows)
    decided = [failure(row) for row in comparison.rows if row.out]
    all_stopped = (
        ["Every controller was stopped; this one got farthest."] if len(decided) == len(comparison.rows) else []
    )
    for criterion in _criteria(comparison):
        best = min(left, key=lambda row: (_mean(criterion, row), _by_complexity(row)))
        tied = [row for row in left if _tie(criterion, best, row, comparison.shape)]
        decided += [_beaten(criterion, best, row) for row in left if row not in tied]
        left = tied
    chosen = min(left, key=_by_complexity)
    others = [row for row in left if row is not chosen]
    why = [*all_stopped, _achieves(chosen, comparison), *_tied(chosen, others, comparison)]
    why += (*reversed(decided), *comparison.left_out)
    names = tuple(row.controller for row in others)
    return Recommendation(controller=chosen.controller, why=(*why, *_hidden(chosen), *_geared(chosen)), tied=names)


def difference(comparison: Comparison, first: str, second: str, name: str = "settled") -> Estimate | None:
    """Mean of ``first`` minus ``second`` in a metric, with interval; None: no common result."""
    a, b = (comparison.array(name, one).ravel() for one in (first, second))
    return paired_difference(a, b, cluster(comparison.shape)[1])


def _criteria(comparison: Comparison) -> tuple[_Criterion, ...]:
    protocol = comparison.protocol
    narrow, *wider = map(int, np.argsort(protocol.within))
    return (
        _Criterion(
            name="of the targets missed",
            results=lambda name: 1.0 - comparison.array("crossed", name).ravel(),
            missing=1.0,
            show=lambda share: f"{100 * share:.0f} %",
            plain=0.0,
        ),
        _Criterion(
            name="settled error",
            results=lambda name: comparison.array("settled", name).ravel(),
            missing=np.inf,
            show=lambda metres: f"{1e3 * metres:.2f} mm",
            plain=protocol.within[narrow],
        ),
        *_turned(comparison),
        _stays(comparison, narrow, matters=0.0),
        *(_stays(comparison, within, matters=SOONER) for within in wider),
    )


def _stays(comparison: Comparison, within: int, matters: float) -> _Criterion:
    protocol = comparison.protocol
    return _Criterion(
        name=f"to stay within {1e3 * protocol.within[within]:g} mm",
        results=lambda name: comparison.array(protocol.stay_names[within], name).ravel(),
        missing=protocol.hold,
        show=lambda seconds: f"{seconds:.2f} s",
        plain=np.inf,
        matters=matters,
    )


def _turned(comparison: Comparison) -> tuple[_Criterion, ...]:
    if not comparison.orientations:
        return ()
    asked = np.array([word != "" for words in comparison.orientations for word in words])
    sets, repetitions, count = comparison.shape
    rows = np.broadcast_to(asked.reshape(sets, 1, count), (sets, repetitions, count))

    def results(name: str) -> Array:
        return np.where(rows, comparison.array("turned", name), 0.0).ravel()

    return (
        _Criterion(
            name="of orientation",
            results=results,
            missing=np.inf,
            show=lambda angle: f"{np.degrees(angle):.2f} deg",
            plain=float(np.radians(1.0)),
        ),
    )


def _mean(criterion: _Criterion, row: ControllerRow) -> float:
    results = criterion.results(row.controller)
    return float(np.where(np.isfinite(results), results, criterion.missing).mean())


def _tie(criterion: _Criterion, best: ControllerRow, row: ControllerRow, shape: tuple[int, int, int]) -> bool:
    ours, theirs = criterion.results(best.controller), criterion.results(row.controller)
    if not np.isfinite(criterion.missing):
        lost = int(np.isnan(theirs).sum()) - int(np.isnan(ours).sum())
        if lost:  # holds that the guard cut short: no number stands for them
            return lost < 0
    else:
        ours, theirs = (np.where(np.isfinite(part), part, criterion.missing) for part in (ours, theirs))
    estimate = paired_difference(theirs, ours, cluster(shape)[1])
    if estimate is not None and estimate.low is None:
        return estimate.value <= criterion.plain
    return estimate is None or not above_zero(estimate) or estimate.value <= criterion.matters


def _beaten(criterion: _Criterion, best: ControllerRow, row: ControllerRow) -> str:
    worse, better = _mean(criterion, row), _mean(criterion, best)
    short = f"{row.controller}: holds cut short, so that no {criterion.name} is known."
    if np.isfinite(worse):
        against = criterion.show(better) if np.isfinite(better) else "fewer holds"
        short = f"{row.controller}: {criterion.show(worse)} {criterion.name}, against {against} of {best.controller}."
    return f"{short} {failure(row)}" if row.failures else short


def _tied(chosen: ControllerRow, others: list[ControllerRow], comparison: Comparison) -> list[str]:
    if not others:
        return []
    name, names = chosen.controller, _listed([chosen.controller, *(row.controller for row in others)])
    few = "too few trials to tell them apart" if _uncertain(comparison) else "no measurable difference"
    lines, better = [f"A tie of {names}: {few}. {name} is recommended because it is simpler."], []
    for criterion in _criteria(comparison):
        best = min(others, key=lambda row: _mean(criterion, row))
        ours, theirs = _mean(criterion, chosen), _mean(criterion, best)
        if theirs < ours and criterion.show(theirs) != criterion.show(ours):
            against = criterion.show(ours) if np.isfinite(ours) else "holds cut short"
            better.append(
                f"{best.controller} {criterion.show(theirs)} {criterion.name}, against {against} "
                f"({_needed(criterion, chosen, best, comparison)} would decide)"
            )
    return [*lines, f"Better in the mean, which may be chance: {'; '.join(better)}."] if better else lines


def _needed(criterion: _Criterion, chosen: ControllerRow, better: ControllerRow, comparison: Comparison) -> str:
    ours, theirs = criterion.results(chosen.controller), criterion.results(better.controller)
    found = paired_difference(ours, theirs, cluster(comparison.shape)[1])
    if found is None or found.low is None or found.value <= 0.0:
        return "more target sets or repetitions"
    trials = comparison.shape[0] * comparison.shape[1]
    needed = max(int(np.ceil(trials * ((found.value - found.low) / found.value) ** 2)), trials + 1)
    return f"about {needed} trials of each instead of {trials}"


def _achieves(row: ControllerRow, comparison: Comparison) -> str:
    text = f"{row.controller} reaches {100 * row.reached:.0f} % of the targets"
    if row.cycle_time is not None:
        text += f" ({row.cycle_time.mean.value:.1f} s for {len(comparison.targets[0])})"
    if row.settled is not None:
        mean = row.settled.mean
        likely = NO_INTERVAL
        if mean.low is not None and mean.high is not None and mean.low < mean.high:
            likely = f"{1e3 * mean.low:.2f} to {1e3 * mean.high:.2f}"
        text += f" and settles at {1e3 * mean.value:.2f} mm ({likely}) by its encoders"
    return text + "."


def _uncertain(comparison: Comparison) -> bool:
    _, labels = cluster(comparison.shape)
    return len(comparison.rows) > 1 and len(np.unique(labels)) < FEWEST_CLUSTERS


def _hidden(row: ControllerRow) -> tuple[str, ...]:
    true = row.true_error
    if true.value is None:
        return (f"Error of the tool itself: {true}. Play and bending behind the encoders come on top.",)
    if true.how == "known":
        return (f"The tool itself is {1e3 * true.value:.1f} mm off: play and bending behind the encoders remain.",)
    return (f"The tool itself is off by {true}: what is left of play and bending behind the encoders.",)


def _geared(row: ControllerRow) -> tuple[str, ...]:
    if inner_name(row.controller) == row.controller:
        return ()
    return (
        f"{row.controller} needs other gains in the servos: each drive sets them and takes them back. "
        "`rejoint gains --keep` has the servos keep them.",
    )


def complexity(controller: str) -> tuple[float, str]:
    """Rank: the simplest first, unknown ones last."""
    name = inner_name(controller)
    known = CONTROLLERS.index(name) if name in CONTROLLERS else len(CONTROLLERS)
    return known + 0.5 * (name != controller), controller


def _by_complexity(row: ControllerRow) -> tuple[float, str]:
    return complexity(row.controller)


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


MEANINGS = {
    "not finite": "a command or a measured position was not a number",
    "stale": "the arm's answers were too old",
    "out of range": "a measured position lay far outside the joint limits",
    "temperature": "a servo was too hot",
    "servo fault": "a servo reported a fault",
    "not following": "a joint's reading stood still and was not believed",
}
"""Meanings of guard trips"""


def failure(row: ControllerRow) -> str:
    """Describe a failure, or empty."""
    name = row.controller
    if row.out:
        return f"{name} {row.out}: what was left of its trials was not driven, and counts neither for nor against it."
    if row.failures:
        return f"{name}: {row.failures} run{'s' * (row.failures > 1)} ended early, because {_why(row)}."
    if row.reached == 0.0:
        off = "" if row.settled is None else f"; it comes to rest {1e3 * row.settled.mean.value:.1f} mm off"
        return f"{name} reached none of its targets in time{off}."
    return ""


def _why(row: ControllerRow) -> str:
    names = [name for name, _ in Counter(end.why for end in row.ended).most_common()]
    return ", or ".join(MEANINGS.get(name, name) for name in names)
