"""From outcomes to rows and pairs: intervals resample whole arms, times that may be infinite are compared by ratio."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.result import Columns, ControllerRow, Protocol, cycle_times
from rejoint.control.comparison.result import summarise as summarise_trials
from rejoint.system.shell import __version__
from rejoint.system.statistics import (
    CONFIDENCE,
    FEWEST_CLUSTERS,
    Estimate,
    Labels,
    clustered_share,
    paired_difference,
)
from rejoint_lab.research.evaluation.contestants import Contestant
from rejoint_lab.research.evaluation.family import ArmFamily
from rejoint_lab.research.evaluation.trials import TrialSettings

NEVER_RATIO = 100.0
"""Ratio where only one of two ever stays (chosen)"""

RESAMPLES = 1000
"""chosen: ends of the interval repeat within 3 % of its width"""


def difference(first: Array, second: Array, *, seed: int = 0) -> Estimate | None:
    """Mean of ``first - second`` (A, K) over what both have."""
    arms = np.repeat(np.arange(first.shape[0]), first.shape[1])
    return paired_difference(first.ravel(), second.ravel(), arms, seed=seed)


def time_ratio(first: Array, second: Array, *, seed: int = 0) -> Estimate:
    """Median of ``first / second`` (A, K) for times that may be infinite or NaN (stopped).

    Without interval for few arms.
    """
    ratio = ratios(first, second)  # (A, K)
    median = float(np.median(ratio))
    if len(ratio) < FEWEST_CLUSTERS:
        return Estimate(value=median, low=None, high=None)
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, len(ratio), (RESAMPLES, len(ratio)))
    medians = np.median(ratio[picks].reshape(RESAMPLES, -1), axis=1)
    low, high = np.quantile(medians, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="nearest")
    return Estimate(value=median, low=min(float(low), median), high=max(float(high), median))


def ratios(first: Array, second: Array) -> Array:
    """``first / second`` for times; 1 for never over never."""
    (first, late), (second, later) = ((np.maximum(times, 1e-3), ~np.isfinite(times)) for times in (first, second))
    cases = (late & later, late, later)
    return np.select(cases, (1.0, NEVER_RATIO, 1 / NEVER_RATIO), first / np.where(later, 1.0, second))


FAR = 0.005
"""[m] settled encoder error beyond which a hold counts as failed"""


@dataclass(frozen=True, kw_only=True)
class VariantRow(ControllerRow):
    """One controller, or several seeds of a learner together, on one variant."""

    variant: str
    seeds: int
    """trainings that are put together"""
    outside: Estimate | None
    """share of holds beyond 5 mm or stopped"""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A controller against another, target by target on the same arms."""

    variant: str
    controller: str
    rival: str
    settled: Estimate | None
    """[m] mean difference, negative where the controller is better"""
    settled_true: Estimate | None
    """[m]"""
    stay_ratio: tuple[Estimate, ...]
    """median ratio of the times to stay within each distance"""
    cycle_time: Estimate | None
    """[s] mean difference for ten targets of the crossing protocol"""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Everything."""

    arm: str
    software: str
    family: ArmFamily
    protocol: Protocol
    variants: tuple[str, ...]
    meanings: dict[str, str]
    """of the variants, in words"""
    controllers: tuple[str, ...]
    rows: tuple[VariantRow, ...]
    best: dict[str, str]
    """per variant, the rival that is soonest within the narrowest distance"""
    pairs: tuple[Pair, ...]

    def on(self, variant: str) -> tuple[VariantRow, ...]:
        """Rows of a variant."""
        return tuple(row for row in self.rows if row.variant == variant)


Outcomes = Mapping[tuple[str, str], Columns]
"""Results (T, K) of T trials by variant and contestant, see `try_on`"""


def pool(
    contestants: Sequence[Contestant], variants: Iterable[str], outcomes: Outcomes
) -> dict[tuple[str, str], Columns]:
    """Put the seeds of a learner together: results (T, seeds, K) by variant and group."""
    groups: dict[str, list[str]] = {}
    for one in contestants:
        groups.setdefault(one.group, []).append(one.name)
    return {
        (variant, group): {
            key: np.stack([outcomes[variant, name][key] for name in names], axis=1)
            for key in outcomes[variant, names[0]]
        }
        for variant in variants
        for group, names in groups.items()
    }


def summarise(
    arm: Arm, settings: TrialSettings, contestants: Sequence[Contestant], meanings: dict[str, str], outcomes: Outcomes
) -> Evaluation:
    """Compute every number of an evaluation; ``meanings`` says what its variants are."""
    family, protocol, variants = settings.family, settings.protocol, tuple(meanings)
    pooled = pool(contestants, variants, outcomes)
    groups = tuple(dict.fromkeys(group for _, group in pooled))
    rows = tuple(make_row(*key, found, protocol) for key, found in pooled.items())
    learned = {one.group for one in contestants if one.learned}
    best = {v: _best([row for row in rows if row.variant == v and row.controller not in learned]) for v in variants}
    pairs = [
        make_pair(v, (g, pooled[v, g]), (rival, pooled[v, rival]), protocol)
        for v in variants
        for g in groups
        for rival in groups
        if g in learned and rival != g
    ]
    return Evaluation(
        arm=arm.name,
        software=__version__,
        family=family,
        protocol=protocol,
        variants=variants,
        meanings=meanings,
        controllers=groups,
        rows=rows,
        best={v: name for v, name in best.items() if name},
        pairs=tuple(pairs),
    )


def make_row(variant: str, controller: str, found: Columns, protocol: Protocol) -> VariantRow:
    """Summarise the results (T, seeds, K) of a controller."""
    arms = np.repeat(_arms(found), found["settled"][0].size)
    row, held = summarise_trials(controller, found, arms, protocol), found["held"] == 1.0
    outside = np.where(held, ~(found["settled"] <= FAR), np.nan).ravel()
    return VariantRow(
        **vars(row),
        variant=variant,
        seeds=held.shape[1],
        outside=clustered_share(outside, arms) if held.any() else None,
    )


def make_pair(variant: str, mine: tuple[str, Columns], other: tuple[str, Columns], protocol: Protocol) -> Pair:
    """Compare two groups: each seed with each, on the same arm and target."""
    count = len(np.unique(_arms(mine[1])))

    def matched(find: Callable[[Columns], Array]) -> tuple[Array, Array]:
        # Arms stay the first axis, so that a resampled arm brings all its seeds along.
        both = np.broadcast_arrays(find(mine[1])[:, :, None], find(other[1])[:, None])
        first, second = (one.reshape(count, -1) for one in both)
        return first, second

    def stays(name: str) -> Callable[[Columns], Array]:
        return lambda found: np.where(found[name] >= protocol.hold, np.inf, found[name])[..., : _held(found)]

    return Pair(
        variant=variant,
        controller=mine[0],
        rival=other[0],
        settled=difference(*matched(lambda found: found["settled"])),
        settled_true=difference(*matched(lambda found: found["settled_true"])),
        stay_ratio=tuple(time_ratio(*matched(stays(name))) for name in protocol.stay_names),
        cycle_time=difference(*matched(lambda found: cycle_times(found)[..., None])),
    )


def _arms(found: Columns) -> Labels:
    """Return the number (T,) of each trial's arm."""
    return np.unique(found["arm"][:, 0, 0], return_inverse=True)[1]


def _held(found: Columns) -> int:
    """Count the targets that arms were held at."""
    return int((found["held"][0, 0] == 1.0).sum())


def _best(rows: Sequence[VariantRow]) -> str:
    """Rival that is soonest within the narrowest distance, else the nearest."""

    def late(row: VariantRow) -> tuple[float, float]:
        return row.stays[-1].median or np.inf, np.inf if row.settled is None else row.settled.mean.value

    return min(rows, key=late).controller if rows else ""
