"""From outcomes to rows, pairs and failures.

Intervals resample whole arms. Times to stay within a distance may be infinite, so they are compared by the median ratio
of each target.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.result import Protocol
from rejoint.control.guard import reason_names
from rejoint.research.evaluation.contestants import Contestant
from rejoint.research.evaluation.family import ArmFamily
from rejoint.research.evaluation.outcome import Outcome
from rejoint.research.evaluation.trials import TrialSettings
from rejoint.system.shell import __version__
from rejoint.system.statistics import (
    CONFIDENCE,
    FEWEST_CLUSTERS,
    Estimate,
    Labels,
    bootstrap_mean,
    clustered_share,
    paired_difference,
)

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
    first, second = (np.where(np.isnan(times), np.inf, np.maximum(times, 1e-3)) for times in (first, second))
    both = np.isinf(first) & np.isinf(second)
    finite = np.where(np.isinf(first) | np.isinf(second), 1.0, first / np.where(np.isinf(second), 1.0, second))
    return np.where(
        both, 1.0, np.where(np.isinf(first), NEVER_RATIO, np.where(np.isinf(second), 1 / NEVER_RATIO, finite))
    )


FAR = 0.005
"""[m] settled encoder error from which a hold counts as failed"""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """One hold that failed."""

    variant: str
    controller: str
    arm: int
    """wear seed"""
    target: int
    """its number, from 0"""
    point_mm: tuple[float, float, float]
    settled_mm: float | None
    """encoder error; None where the guard stopped the arm"""
    true_mm: float | None
    what: str
    """whether the guard stopped it"""


def list_failures(variant: str, controller: str, outcome: Outcome) -> tuple[Failure, ...]:
    """List the holds that ended beyond `FAR`, or by the guard."""
    found = []
    for b, k in np.argwhere(~(outcome.settled <= FAR)):
        x, y, z = (round(float(value) * 1e3, 1) for value in outcome.target[b, k])
        stopped = not np.isfinite(outcome.settled[b, k])
        names = ", ".join(reason_names(int(outcome.tripped[b]))) or "unknown"
        found.append(
            Failure(
                variant=variant,
                controller=controller,
                arm=int(outcome.wear_seed[b]),
                target=int(k),
                point_mm=(x, y, z),
                settled_mm=_mm(outcome.settled[b, k]),
                true_mm=_mm(outcome.settled_true[b, k]),
                what=f"stopped by the guard ({names})" if stopped else "farther off than 5 mm",
            )
        )
    return tuple(found)


def _mm(value: float) -> float | None:
    return round(1e3 * float(value), 3) if np.isfinite(value) else None


@dataclass(frozen=True, kw_only=True)
class Within:
    """Coming and staying within a distance."""

    distance: float
    """[m]"""
    share: Estimate
    """of the holds"""
    median: float | None
    """[s] over all holds; None where fewer than half ever stay"""


@dataclass(frozen=True, kw_only=True)
class VariantRow:
    """One controller, or several seeds of a learner together, on one variant."""

    variant: str
    controller: str
    seeds: int
    """trainings that are put together"""
    settled: Estimate | None
    """[m] encoder error in the last second; None, as the four below, if the guard stopped every hold"""
    settled_p95: float | None
    """[m]"""
    settled_true: Estimate | None
    """[m]"""
    true_p95: float | None
    """[m]"""
    oscillation: float | None
    """[m] mean"""
    outside: Estimate
    """share of holds beyond 5 mm or stopped"""
    within: tuple[Within, ...]
    success: Estimate | None
    """share of targets reached by Park et al. 2024's protocol; None if not run"""
    cycle_time: Estimate | None
    """[s] for ten targets of that protocol"""
    crossing_error: Estimate | None
    """[m]"""


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
    failures: tuple[Failure, ...]

    def row(self, variant: str, controller: str) -> VariantRow:
        """Return one row."""
        return next(row for row in self.rows if (row.variant, row.controller) == (variant, controller))


Outcomes = Mapping[tuple[str, str], Outcome]
"""By variant and contestant"""


def summarise(
    arm: Arm, settings: TrialSettings, contestants: Sequence[Contestant], meanings: dict[str, str], outcomes: Outcomes
) -> Evaluation:
    """Compute every number of an evaluation; ``meanings`` says what its variants are."""
    family, protocol, variants = settings.family, settings.protocol, tuple(meanings)
    groups = group(contestants)
    pooled = {(v, g): [outcomes[v, name] for name in names] for v in variants for g, names in groups.items()}
    rows = tuple(make_row(v, g, pooled[v, g], protocol) for v in variants for g in groups)
    learned = {one.group for one in contestants if one.learned}
    best = {v: _best([row for row in rows if row.variant == v and row.controller not in learned]) for v in variants}
    pairs = [
        make_pair(v, (g, pooled[v, g]), (rival, pooled[v, rival]))
        for v in variants
        for g in groups
        for rival in groups
        if g in learned and rival != g
    ]
    failures = [
        failure
        for v in variants
        for one in contestants
        for failure in list_failures(v, one.name, outcomes[v, one.name])
    ]
    return Evaluation(
        arm=arm.name,
        software=__version__,
        family=family,
        protocol=protocol,
        variants=variants,
        meanings=meanings,
        controllers=tuple(groups),
        rows=rows,
        best={v: name for v, name in best.items() if name},
        pairs=tuple(pairs),
        failures=tuple(failures),
    )


def group(contestants: Sequence[Contestant]) -> dict[str, list[str]]:
    """Names of the contestants that belong together: the seeds of one learner."""
    groups: dict[str, list[str]] = {}
    for one in contestants:
        groups.setdefault(one.group, []).append(one.name)
    return groups


def make_row(variant: str, controller: str, outcomes: Sequence[Outcome], protocol: Protocol) -> VariantRow:
    """Join the outcomes of some seeds on the same arms."""
    arms = _arms(outcomes)
    settled, true = _joined(outcomes, "settled"), _joined(outcomes, "settled_true")
    stay = _joined(outcomes, "stay")
    crossed = _joined(outcomes, "crossed")
    times = np.concatenate([_ten_targets(outcome) for outcome in outcomes])
    some = bool(np.isfinite(crossed).any())
    crossing_arms = _arms(outcomes, "crossed")
    return VariantRow(
        variant=variant,
        controller=controller,
        seeds=len(outcomes),
        settled=_mean(settled, arms),
        settled_p95=_p95(settled),
        settled_true=_mean(true, arms),
        true_p95=_p95(true),
        oscillation=_plain_mean(_joined(outcomes, "oscillation")),
        outside=clustered_share((~(settled <= FAR)).astype(float), arms),
        within=tuple(_within(d, stay[..., w], arms) for w, d in enumerate(protocol.within)),
        success=clustered_share(crossed, crossing_arms) if some else None,
        cycle_time=_mean(times, _per_arm(outcomes)),
        crossing_error=_mean(_joined(outcomes, "crossing_error"), crossing_arms),
    )


def make_pair(variant: str, mine: tuple[str, Sequence[Outcome]], other: tuple[str, Sequence[Outcome]]) -> Pair:
    """Compare two groups: each seed with each, on the same arm and target."""
    name, rival = mine[0], other[0]
    both = [(first, second) for first in mine[1] for second in other[1]]

    def matched(field: str) -> tuple[Array, Array]:
        # Arms stay the first axis, so that a resampled arm brings all its seeds along.
        firsts, seconds = zip(*((getattr(a, field), getattr(b, field)) for a, b in both), strict=True)
        return np.concatenate(firsts, axis=1), np.concatenate(seconds, axis=1)

    stays = matched("stay")
    return Pair(
        variant=variant,
        controller=name,
        rival=rival,
        settled=difference(*matched("settled")),
        settled_true=difference(*matched("settled_true")),
        stay_ratio=tuple(time_ratio(stays[0][..., w], stays[1][..., w]) for w in range(stays[0].shape[-1])),
        cycle_time=difference(*_cycle_times(both)),
    )


def _cycle_times(both: Sequence[tuple[Outcome, Outcome]]) -> tuple[Array, Array]:
    times = [[_ten_targets(one)[:, None] for one in pair] for pair in both]
    return np.concatenate([first for first, _ in times], axis=1), np.concatenate(
        [second for _, second in times], axis=1
    )


def _ten_targets(outcome: Outcome) -> Array:
    """Time (A,) [s] for ten targets of Park et al. 2024's protocol."""
    times: Array = 10.0 * outcome.crossing_time.mean(axis=1)
    return times


def _best(rows: Sequence[VariantRow]) -> str:
    """Rival that is soonest within the narrowest distance, else the nearest."""
    if not rows:
        return ""
    far = Estimate(value=np.inf, low=np.inf, high=np.inf)
    return min(rows, key=lambda row: (row.within[-1].median or np.inf, (row.settled or far).value)).controller


def _within(distance: float, stay: Array, arms: Labels) -> Within:
    finite = np.isfinite(stay)
    median = float(np.median(np.where(finite, stay, np.inf)))
    share = clustered_share(finite.astype(float), arms)
    return Within(distance=distance, share=share, median=median if np.isfinite(median) else None)


def _mean(values: Array, arms: Labels) -> Estimate | None:
    return bootstrap_mean(values.ravel(), arms.ravel()) if np.isfinite(values).any() else None


def _plain_mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None


def _p95(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.quantile(known, 0.95)) if len(known) else None


def _joined(outcomes: Sequence[Outcome], field: str) -> Array:
    """One field over seeds, arms and targets; trailing axes stay."""
    return np.concatenate([getattr(o, field).reshape(-1, *getattr(o, field).shape[2:]) for o in outcomes])


def _arms(outcomes: Sequence[Outcome], field: str = "settled") -> Labels:
    return np.concatenate([np.repeat(np.arange(len(o.wear_seed)), getattr(o, field).shape[1]) for o in outcomes])


def _per_arm(outcomes: Sequence[Outcome]) -> Labels:
    return np.concatenate([np.arange(len(o.wear_seed)) for o in outcomes])
