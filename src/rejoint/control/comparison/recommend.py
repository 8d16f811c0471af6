"""Which controller the owner should use, and why: the simplest of those that nothing measurably beats.

Controllers are compared result by result on the same targets. The criteria count in this order: targets reached,
settled encoder error, time to come and stay within the narrowest distance, and then within the wider ones, where a
difference is to be one that matters. A difference whose 95 % interval contains zero is a tie, and a tie goes to the
simpler controller. Where there are too few results for an interval, only what an owner would see counts: a target
missed, or more than the narrowest distance. Those that a race leaves undecided count by its leads instead: intervals of
ten targets leave ties that matter. A controller that was driven no further is out, unless all are, and one that a race
found hardly better than the one chosen ties with it. A tie is called one, with what the others did better and how many
trials would decide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.control.catalogue import CONTROLLERS
from rejoint.control.comparison.failure import failure
from rejoint.control.comparison.racing import NO_BETTER, Race, Results, leads
from rejoint.control.comparison.result import Comparison, ControllerRow, Protocol
from rejoint.control.geared import inner_name
from rejoint.system.statistics import FEWEST_CLUSTERS, Estimate, above_zero, cluster, paired_difference

NO_INTERVAL = "too few trials for an interval"
"""What stands where an interval would"""


@dataclass(frozen=True, kw_only=True)
class Recommendation:
    """The controller to use."""

    controller: str
    why: tuple[str, ...]
    """sentences for the owner, the most important first"""
    tied: tuple[str, ...] = ()
    """controllers that cannot be told from it measurably, and are less simple"""


@dataclass(frozen=True, kw_only=True)
class _Criterion:
    name: str
    results: Callable[[ControllerRow], Array]
    """(N,) per target; smaller is better"""
    missing: float
    """what counts where there is no result: the worst"""
    show: Callable[[float], str]
    plain: float
    """difference above which one is worse where there is no interval"""
    matters: float = 0.0
    """smallest difference in the mean that counts"""


def recommend(comparison: Comparison) -> Recommendation:
    """Recommend a controller of ``comparison``."""
    left = [row for row in comparison.rows if not row.out] or list(comparison.rows)
    decided = [failure(row) for row in comparison.rows if row.out]
    all_stopped = (
        ["Every controller was stopped; this one got farthest."] if len(decided) == len(comparison.rows) else []
    )
    led = _led(left, comparison)
    if led is not None:
        left, said = led
        decided += said
    for criterion in _criteria(comparison) if led is None else ():
        best = min(left, key=lambda row: (_mean(criterion, row), _by_complexity(row)))
        tied = [row for row in left if _tie(criterion, best, row)]
        decided += [_beaten(criterion, best, row) for row in left if row not in tied]
        left = tied
    chosen = min(left, key=_by_complexity)
    others = [row for row in left if row is not chosen]
    why = [*all_stopped, _achieves(chosen, comparison), *_tied(chosen, others, comparison)]
    why += (*reversed(decided), *comparison.left_out)
    needless = [row for row in comparison.rows if row.out.startswith(f"{NO_BETTER}{chosen.controller} ")]
    names = tuple(row.controller for row in (*others, *needless))
    return Recommendation(controller=chosen.controller, why=(*why, *_hidden(chosen), *_geared(chosen)), tied=names)


def _led(left: list[ControllerRow], comparison: Comparison) -> tuple[list[ControllerRow], list[str]] | None:
    """Return who stays of those a race left undecided, and what is said of the others; None where that is no question.

    The times to the wider distances decide between those whom the narrower ones leave: where an arm never rests within
    the narrowest, its times say nothing.
    """
    if comparison.race is None or len(left) < 2:
        return None
    found: tuple[list[ControllerRow], list[str]] | None = None
    for within in np.argsort(comparison.protocol.within):
        stays = _unled(left, comparison, comparison.race, int(within))
        if stays is None:
            break
        left, said = stays
        found = left, (said if found is None else found[1] + said)
    return found


def _unled(
    left: list[ControllerRow], comparison: Comparison, race: Race, within: int
) -> tuple[list[ControllerRow], list[str]] | None:
    """Keep the simplest one whom nobody leads, with the less simple ones that it does not lead; None if all are led.

    Times to stay are those within the distance of number ``within``.
    """
    results = {}
    for row in left:
        crossed, settled, stay = (row.outcomes.array(name) for name in ("crossed", "settled", "stay"))
        results[row.controller] = Results(crossed=crossed.ravel(), settled=settled.ravel(), stay=stay[within].ravel())
    found = leads(results, race)
    ranked = sorted(left, key=_by_complexity)
    free = [row for row in ranked if all(row.controller != other for _, other in found)]
    if not free:
        return None
    chosen = free[0]
    tied = [row for row in ranked[ranked.index(chosen) :] if (chosen.controller, row.controller) not in found]
    narrowest = within == int(np.argmin(comparison.protocol.within))
    what = "" if narrowest else f" by the time to stay within {1e3 * comparison.protocol.within[within]:g} mm"
    said = []
    for row in (row for row in ranked if row not in tied):
        (by, _), (better, even, worse) = max(
            (item for item in found.items() if item[0][1] == row.controller),
            key=lambda item: (item[0][0] == chosen.controller, item[1][0] - item[1][2]),
        )
        said.append(
            f"{row.controller}: likely not as good as {by}{what} (worse at {better} of "
            f"{better + even + worse} targets, better at {worse})."
        )
    return tied, said


def difference(comparison: Comparison, first: str, second: str, name: str = "settled") -> Estimate | None:
    """Mean of ``first`` minus ``second`` on the same targets, with interval.

    ``name`` is a field of `Outcomes` with one value per target. None where they share no result.
    """
    a, b = comparison.row(first).outcomes, comparison.row(second).outcomes
    return paired_difference(a.array(name).ravel(), b.array(name).ravel(), cluster(a.shape)[1])


def _criteria(comparison: Comparison) -> tuple[_Criterion, ...]:
    protocol = comparison.protocol
    narrow, *wider = map(int, np.argsort(protocol.within))
    return (
        _Criterion(
            name="of the targets missed", results=lambda row: 1.0 - row.outcomes.array("crossed").ravel(), missing=1.0,
            show=lambda share: f"{100 * share:.0f} %", plain=0.0,
        ),
        _Criterion(
            name="settled error", results=lambda row: row.outcomes.array("settled").ravel(), missing=np.inf,
            show=lambda metres: f"{1e3 * metres:.2f} mm", plain=protocol.within[narrow],
        ),
        *_turned(comparison),
        _stays(protocol, narrow, matters=0.0),
        *(_stays(protocol, within, matters=Race.sooner) for within in wider),
    )  # fmt: skip


def _stays(protocol: Protocol, within: int, matters: float) -> _Criterion:
    return _Criterion(
        name=f"to stay within {1e3 * protocol.within[within]:g} mm",
        results=lambda row: row.outcomes.array("stay")[within].ravel(), missing=protocol.hold,
        show=lambda seconds: f"{seconds:.2f} s", plain=np.inf, matters=matters,
    )  # fmt: skip


def _turned(comparison: Comparison) -> tuple[_Criterion, ...]:
    """Return the criterion of orientation; nothing where targets have none. Points among poses do not count."""
    if not comparison.orientations:
        return ()
    asked = np.array([word != "" for words in comparison.orientations for word in words])
    sets, repetitions, count = comparison.rows[0].outcomes.shape
    rows = np.broadcast_to(asked.reshape(sets, 1, count), (sets, repetitions, count))

    def results(row: ControllerRow) -> Array:
        own = row.outcomes
        return np.where(rows, own.array("turned"), 0.0).ravel() if own.turned else np.full(rows.size, np.nan)

    return (
        _Criterion(
            name="of orientation", results=results, missing=np.inf,
            show=lambda angle: f"{np.degrees(angle):.2f} deg", plain=float(np.radians(1.0)),
        ),
    )  # fmt: skip


def _mean(criterion: _Criterion, row: ControllerRow) -> float:
    results = criterion.results(row)
    return float(np.where(np.isfinite(results), results, criterion.missing).mean())


def _tie(criterion: _Criterion, best: ControllerRow, row: ControllerRow) -> bool:
    ours, theirs = criterion.results(best), criterion.results(row)
    if not np.isfinite(criterion.missing):
        lost = int(np.isnan(theirs).sum()) - int(np.isnan(ours).sum())
        if lost:  # holds that the guard cut short: no number stands for them
            return lost < 0
    else:
        ours, theirs = (np.where(np.isfinite(part), part, criterion.missing) for part in (ours, theirs))
    estimate = paired_difference(theirs, ours, cluster(row.outcomes.shape)[1])
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
    """Say that it is a tie, who did better in the mean, and how many trials would decide; nothing without a tie."""
    if not others:
        return []
    name, names = chosen.controller, _listed([chosen.controller, *(row.controller for row in others)])
    few = "too few trials to tell them apart" if _uncertain(chosen, comparison) else "no measurable difference"
    if comparison.race is not None:
        few = "none leads a simpler one by as much as matters"
    lines, better = [f"A tie of {names}: {few}. {name} is recommended because it is simpler."], []
    for criterion in _criteria(comparison):
        best = min(others, key=lambda row: _mean(criterion, row))
        ours, theirs = _mean(criterion, chosen), _mean(criterion, best)
        if theirs < ours and criterion.show(theirs) != criterion.show(ours):
            against = criterion.show(ours) if np.isfinite(ours) else "holds cut short"
            better.append(
                f"{best.controller} {criterion.show(theirs)} {criterion.name}, against {against} "
                f"({_needed(criterion, chosen, best)} would decide)"
            )
    return [*lines, f"Better in the mean, which may be chance: {'; '.join(better)}."] if better else lines


def _needed(criterion: _Criterion, chosen: ControllerRow, better: ControllerRow) -> str:
    """Say how many trials would tell a difference in the mean from chance, if it is none: intervals go with 1/sqrt."""
    sets, repetitions, _ = chosen.outcomes.shape
    found = paired_difference(criterion.results(chosen), criterion.results(better), cluster(chosen.outcomes.shape)[1])
    if found is None or found.low is None or found.value <= 0.0:
        return "more target sets or repetitions"
    trials = sets * repetitions
    needed = max(int(np.ceil(trials * ((found.value - found.low) / found.value) ** 2)), trials + 1)
    return f"about {needed} trials of each instead of {trials}"


def _achieves(row: ControllerRow, comparison: Comparison) -> str:
    text = f"{row.controller} reaches {100 * row.crossing.success.value:.0f} % of the targets"
    if row.crossing.cycle_time is not None:
        text += f" ({row.crossing.cycle_time.mean.value:.1f} s for {len(comparison.targets[0])})"
    if row.hold.settled is not None:
        mean = row.hold.settled.mean
        likely = NO_INTERVAL
        if mean.low is not None and mean.high is not None and mean.low < mean.high:
            likely = f"{1e3 * mean.low:.2f} to {1e3 * mean.high:.2f}"
        text += f" and settles at {1e3 * mean.value:.2f} mm ({likely}) by its encoders"
    return text + "."


def _uncertain(row: ControllerRow, comparison: Comparison) -> bool:
    """Tell whether there are too few results for any interval."""
    _, labels = cluster(row.outcomes.shape)
    return len(comparison.rows) > 1 and len(np.unique(labels)) < FEWEST_CLUSTERS


def _hidden(row: ControllerRow) -> tuple[str, ...]:
    """Say what the encoders do not see."""
    true = row.hold.true_error
    if true.value is None:
        return (f"Error of the tool itself: {true}. Play and bending behind the encoders come on top.",)
    if true.how == "known":
        return (f"The tool itself is {1e3 * true.value:.1f} mm off: play and bending behind the encoders remain.",)
    return (f"The tool itself is off by {true}: what is left of play and bending behind the encoders.",)


def _geared(row: ControllerRow) -> tuple[str, ...]:
    """Say what becomes of the servos' gains, where the controller has its own."""
    if inner_name(row.controller) == row.controller:
        return ()
    return (
        f"{row.controller} needs other gains in the servos: each drive sets them and takes them back. "
        "`rejoint gains --keep` has the servos keep them.",
    )


def complexity(controller: str) -> tuple[float, str]:
    """Rank a name from the simplest controller on; unknown ones count as the most demanding.

    One under other gains of the servos comes right after the same one under those that are there.
    """
    name = inner_name(controller)
    known = CONTROLLERS.index(name) if name in CONTROLLERS else len(CONTROLLERS)
    return known + 0.5 * (name != controller), controller


def _by_complexity(row: ControllerRow) -> tuple[float, str]:
    return complexity(row.controller)


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
