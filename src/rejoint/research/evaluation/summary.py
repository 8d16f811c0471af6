"""From outcomes to rows, pairs and failures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.result import Protocol
from rejoint.research.evaluation.contestants import Contestant
from rejoint.research.evaluation.failures import FAR, list_failures
from rejoint.research.evaluation.outcome import Outcome
from rejoint.research.evaluation.paired import difference, time_ratio
from rejoint.research.evaluation.result import Evaluation, Pair, VariantRow, Within
from rejoint.research.evaluation.trials import TrialSettings
from rejoint.system.statistics import Estimate, Labels, bootstrap_mean, clustered_share
from rejoint.system.version import __version__

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
        for failure in list_failures(arm, v, one.name, outcomes[v, one.name])
    ]
    return Evaluation(
        arm=arm.name, software=__version__, family=family, protocol=protocol, variants=variants, meanings=meanings,
        controllers=tuple(groups), rows=rows, best={v: name for v, name in best.items() if name},
        pairs=tuple(pairs), failures=tuple(failures),
    )  # fmt: skip


def group(contestants: Sequence[Contestant]) -> dict[str, list[str]]:
    """Names of the contestants that belong together: the seeds of one learner."""
    groups: dict[str, list[str]] = {}
    for one in contestants:
        groups.setdefault(one.group, []).append(one.name)
    return groups


def make_row(variant: str, controller: str, outcomes: Sequence[Outcome], protocol: Protocol) -> VariantRow:
    """Put the outcomes of some seeds on the same arms together; intervals resample arms."""
    arms = _arms(outcomes)
    settled, true = _joined(outcomes, "settled"), _joined(outcomes, "settled_true")
    stay = _joined(outcomes, "stay")
    crossed = _joined(outcomes, "crossed")
    times = np.concatenate([_ten_targets(outcome) for outcome in outcomes])
    some = bool(np.isfinite(crossed).any())
    crossing_arms = _arms(outcomes, "crossed")
    return VariantRow(
        variant=variant, controller=controller, seeds=len(outcomes),
        settled=_mean(settled, arms), settled_p95=_p95(settled),
        settled_true=_mean(true, arms), true_p95=_p95(true),
        oscillation=_plain_mean(_joined(outcomes, "oscillation")),
        outside=clustered_share((~(settled <= FAR)).astype(float), arms),
        within=tuple(_within(d, stay[..., w], arms) for w, d in enumerate(protocol.within)),
        success=clustered_share(crossed, crossing_arms) if some else None,
        cycle_time=_mean(times, _per_arm(outcomes)),
        crossing_error=_mean(_joined(outcomes, "crossing_error"), crossing_arms),
    )  # fmt: skip


def make_pair(variant: str, mine: tuple[str, Sequence[Outcome]], other: tuple[str, Sequence[Outcome]]) -> Pair:
    """Compare two groups; each seed of one meets each seed of the other on the same arm and target."""
    name, rival = mine[0], other[0]
    both = [(first, second) for first in mine[1] for second in other[1]]

    def matched(field: str) -> tuple[Array, Array]:
        # Arms stay the first axis, so that a resampled arm brings all its seeds along.
        firsts, seconds = zip(*((getattr(a, field), getattr(b, field)) for a, b in both), strict=True)
        return np.concatenate(firsts, axis=1), np.concatenate(seconds, axis=1)

    stays = matched("stay")
    return Pair(
        variant=variant, controller=name, rival=rival,
        settled=difference(*matched("settled")), settled_true=difference(*matched("settled_true")),
        stay_ratio=tuple(time_ratio(stays[0][..., w], stays[1][..., w]) for w in range(stays[0].shape[-1])),
        cycle_time=difference(*_cycle_times(both)),
    )  # fmt: skip


def _cycle_times(both: Sequence[tuple[Outcome, Outcome]]) -> tuple[Array, Array]:
    times = [[_ten_targets(one)[:, None] for one in pair] for pair in both]
    return np.concatenate([first for first, _ in times], axis=1), np.concatenate(
        [second for _, second in times], axis=1
    )


def _ten_targets(outcome: Outcome) -> Array:
    """Time (A,) [s] for ten targets of the protocol of Park et al. 2024, however many there were."""
    times: Array = 10.0 * outcome.crossing_time.mean(axis=1)
    return times


def _best(rows: Sequence[VariantRow]) -> str:
    """Rival that is soonest within the narrowest distance; where none ever is, the one that settles nearest."""
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
    """One field of all seeds, flat over seeds, arms and targets; trailing axes stay."""
    return np.concatenate([getattr(o, field).reshape(-1, *getattr(o, field).shape[2:]) for o in outcomes])


def _arms(outcomes: Sequence[Outcome], field: str = "settled") -> Labels:
    return np.concatenate([np.repeat(np.arange(len(o.wear_seed)), getattr(o, field).shape[1]) for o in outcomes])


def _per_arm(outcomes: Sequence[Outcome]) -> Labels:
    return np.concatenate([np.arange(len(o.wear_seed)) for o in outcomes])
