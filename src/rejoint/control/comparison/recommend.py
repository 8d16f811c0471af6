"""The simplest controller that no other beats significantly.

Criteria in order: targets reached, settled encoder error, time to stay within the narrowest distance, then the wider
ones. A 95 % interval that contains zero is a tie. Eliminated controllers are out, unless all are.
"""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.result import Comparison, ControllerRow
from rejoint.control.controllers.catalogue import CONTROLLERS
from rejoint.control.servogains import inner_name
from rejoint.system.records import Readable, entity, value_type
from rejoint.system.statistics import FEWEST_CLUSTERS, Estimate, above_zero, cluster, paired_difference

SOONER = 0.2
"""[s] relevant difference (chosen)"""
NO_INTERVAL = "too few trials for an interval"


@value_type
class Recommendation(Readable):
    """The recommended controller."""

    controller: str
    why: tuple[str, ...]
    """the most important first"""
    tied: tuple[str, ...] = ()
    """less simple controllers"""


@entity
class _Criterion:
    name: str
    results: dict[str, Array]
    """(N,) per target by controller; smaller is better; NaN: missing"""
    unit: str
    """format of a value"""
    factor: float = 1.0
    """to that unit"""
    plain: float = np.inf
    """significant difference without an interval"""
    matters: float = 0.0
    """smallest relevant difference"""

    def mean(self, row: ControllerRow) -> float:
        """Over all targets; infinite where one is missing."""
        values = self.results[row.controller]
        return float(values.mean()) if np.isfinite(values).all() else np.inf


def recommend(comparison: Comparison) -> Recommendation:
    """Recommend a controller of ``comparison``."""
    left = [row for row in comparison.rows if not row.out]
    decided = [failure(row) for row in comparison.rows if row.out]
    all_stopped = [] if left else ["Every controller was stopped; this one got farthest."]
    left = left or list(comparison.rows)
    for criterion in _criteria(comparison):
        best = min(left, key=lambda row: (criterion.mean(row), _by_complexity(row)))
        tied = [row for row in left if _tie(criterion, best, row, comparison.shape)]
        decided += [_beaten(criterion, best, row) for row in left if row not in tied]
        left = tied
    chosen = min(left, key=_by_complexity)
    others = tuple(row.controller for row in left if row is not chosen)
    why = [*all_stopped, achieves(chosen, comparison), *_tied(chosen.controller, others, comparison)]
    why += (*reversed(decided), *comparison.left_out)
    why += [f"Error of the tool itself, with play and bending behind the encoders: {chosen.true_error}."]
    if inner_name(chosen.controller) != chosen.controller:
        why.append(
            f"{chosen.controller} needs other gains in the servos: each drive sets them and takes them back. "
            "An SO-101 keeps them after `rejoint gains --keep`."
        )
    return Recommendation(controller=chosen.controller, why=tuple(why), tied=others)


def difference(comparison: Comparison, first: str, second: str) -> Estimate | None:
    """Mean settled error of ``first`` minus that of ``second``, with interval; None: no common result."""
    a, b = (comparison.array("settled", one).ravel() for one in (first, second))
    return paired_difference(a, b, cluster(comparison.shape)[1])


def _criteria(comparison: Comparison) -> Iterator[_Criterion]:
    protocol = comparison.protocol
    order = np.argsort(protocol.within).tolist()

    def results(metric: str, missing: float = np.nan) -> dict[str, Array]:
        names = comparison.controllers
        return {name: np.nan_to_num(comparison.array(metric, name).ravel(), nan=missing) for name in names}

    yield _Criterion(
        name="of the targets missed",
        results={name: 1.0 - crossed for name, crossed in results("crossed", 0.0).items()},
        unit="{:.0f} %",
        factor=100.0,
        plain=0.0,
    )
    yield _Criterion(
        name="settled error", results=results("settled"), unit="{:.2f} mm", factor=1e3, plain=min(protocol.within)
    )
    if comparison.orientations:
        rows = np.broadcast_to(np.array(comparison.orientations)[:, None] != "", comparison.shape).ravel()
        yield _Criterion(
            name="of orientation",
            results={name: np.where(rows, turned, 0.0) for name, turned in results("turned").items()},
            unit="{:.2f} deg",
            factor=np.degrees(1.0),
            plain=np.radians(1.0),
        )
    for within in order:
        yield _Criterion(
            name=f"on average to stay within {1e3 * protocol.within[within]:g} mm (a miss as {protocol.hold:g} s)",
            results=results(protocol.stay_names[within], protocol.hold),
            unit="{:.2f} s",
            matters=0.0 if within == order[0] else SOONER,
        )


def _tie(criterion: _Criterion, best: ControllerRow, row: ControllerRow, shape: tuple[int, int, int]) -> bool:
    ours, theirs = criterion.results[best.controller], criterion.results[row.controller]
    lost = int(np.isnan(theirs).sum()) - int(np.isnan(ours).sum())
    if lost:  # holds that the guard cut short: no number stands for them
        return lost < 0
    estimate = paired_difference(theirs, ours, cluster(shape)[1])
    if estimate is None:
        return True
    if estimate.low is None:
        return estimate.value <= criterion.plain
    return not above_zero(estimate) or estimate.value <= criterion.matters


def _beaten(criterion: _Criterion, best: ControllerRow, row: ControllerRow) -> str:
    ours, theirs = (criterion.factor * criterion.mean(one) for one in (best, row))
    short = f"{row.controller}: holds cut short, so that no {criterion.name} is known."
    if np.isfinite(theirs):
        against = criterion.unit.format(ours) if np.isfinite(ours) else "fewer holds"
        short = f"{row.controller}: {criterion.unit.format(theirs)} {criterion.name}, against {against} of "
        short += f"{best.controller}."
    return f"{short} {failure(row)}" if row.failures else short


def _tied(chosen: str, others: tuple[str, ...], comparison: Comparison) -> list[str]:
    if not others:
        return []
    few = len(np.unique(cluster(comparison.shape)[1])) < FEWEST_CLUSTERS
    why = "too few trials to tell them apart" if few else "no measurable difference"
    listed = f"{', '.join((chosen, *others[:-1]))} and {others[-1]}"
    return [f"A tie of {listed}: {why}. {chosen} is recommended because it is simpler."]


def achieves(row: ControllerRow, comparison: Comparison) -> str:
    """Say how many targets a controller reaches, and where it settles."""
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


def _by_complexity(row: ControllerRow) -> tuple[float, str]:
    name = inner_name(row.controller)
    known = CONTROLLERS.index(name) if name in CONTROLLERS else len(CONTROLLERS)
    return known + 0.5 * (name != row.controller), row.controller


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
        reasons = dict.fromkeys(MEANINGS.get(why, why) for why, _ in Counter(row.ended).most_common())
        return f"{name}: {row.failures} run{'s' * (row.failures > 1)} ended early, because {', or '.join(reasons)}."
    if row.reached == 0.0:
        off = "" if row.settled is None else f"; it comes to rest {1e3 * row.settled.mean.value:.1f} mm off"
        return f"{name} reached none of its targets in time{off}."
    return ""
