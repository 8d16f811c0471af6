"""Result of all checks of an arm: charts of its quantities, jumped zeros, and when a tolerance is reached.

The first checks give mean, scatter and temperature effect; an EWMA (Roberts 1959) the state, a two-sided CUSUM (Page
1954) the alarm.

Wear is a Brownian motion with drift, its first-passage time inverse Gaussian (Folks and Chhikara, J. R. Stat. Soc. B
40, 1978).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Literal

import numpy as np

from rejoint.arms import Array
from rejoint.diagnosis.monitoring.measures import CheckMeasures
from rejoint.diagnosis.regression import fit_believed
from rejoint.system.records import entity, value_type

FEWEST = 5
"""Checks that a baseline needs; shared facts on monitoring: 5 to 8"""
MOST = 8
"""Most checks in a baseline"""
WEIGHT = 0.25
"""Of the newest check in the EWMA; shared facts on monitoring"""
DRIFTING = 2.7 * (WEIGHT / (2.0 - WEIGHT)) ** 0.5
"""EWMA of a drift: 2.7 of its own standard deviations"""
SLACK = 1.25
"""Slack of the CUSUM in standard deviations; chosen"""
ALARM = 6.0
"""CUSUM of an alarm; shared facts on monitoring; 0.5 % false alarms in two years"""
CUT = 4.0
"""Largest distance that counts, in standard deviations; one such check is a drift"""
PRIOR_CHECKS = 6.0
"""Checks that the prior scatter counts for; chosen"""

State = Literal["learning", "steady", "drifting", "alarm"]
"""Too few checks; as at the beginning; moving away; surely changed"""


@entity
class Chart:
    """One quantity since its baseline began; T checks, the newest last."""

    cusum: Array
    """(T,) the larger side, positive where the quantity grows"""
    usual: float
    """mean of the baseline, at its own temperature"""
    change: float
    """newest value, at the baseline's temperature, less `usual`"""
    state: State
    since: int | None
    """index of the last check before the change, by the CUSUM"""


def chart(value: Array, temperature: Array, *, scatter: float, per_degree: float) -> Chart:
    """Compute the chart of ``value`` (T,) at ``temperature`` (T,) [deg C], NaN where unknown.

    Prior: ``scatter``, sigma of one check; ``per_degree``, effect of a degree.
    """
    count, warm = len(value), np.nan_to_num(temperature - temperature[0])
    cusum, change = np.zeros(count), 0.0
    sides, sums, began, smooth = np.array([1.0, -1.0]), np.zeros(2), np.full(2, FEWEST - 1), 0.0
    usual, base = float(np.mean(value)), FEWEST
    for t in range(FEWEST, count):
        usual, slope, deviation = _norm(value[: t + 1], warm[: t + 1], base, scatter, per_degree)
        change = float(value[t] - usual - slope)
        step = np.clip(change / deviation, -CUT, CUT)
        base += base == t < MOST and abs(step) < CUT  # what is odd, and what follows, is no part of it
        smooth = WEIGHT * step + (1.0 - WEIGHT) * smooth
        sums = np.maximum(sums + sides * step - SLACK, 0.0)
        began = np.where(sums > 0.0, began, t)
        larger = sums.argmax()
        cusum[t], since = sides[larger] * sums[larger], began[larger]
    state: State = "steady"
    if count <= FEWEST:
        state = "learning"
    elif abs(cusum[-1]) >= ALARM:
        state = "alarm"
    elif abs(smooth) > DRIFTING or abs(step) >= CUT:
        state = "drifting"
    return Chart(
        cusum=cusum,
        usual=usual,
        change=change,
        state=state,
        since=since if state in ("drifting", "alarm") else None,
    )


def _norm(value: Array, warm: Array, count: int, scatter: float, per_degree: float) -> tuple[float, float, float]:
    """Mean of the first ``count`` checks, temperature effect on the last, and sigma."""
    known, middle = warm[:count].mean(), float(value[:count].mean())
    variance = scatter**2
    for _ in range(3):  # slope and scatter depend on each other a little
        slope, doubt = _slope(value, warm, variance, per_degree)
        steps = np.diff(value[:count] - slope * warm[:count])
        variance = (PRIOR_CHECKS * scatter**2 + 0.5 * float(steps @ steps)) / (PRIOR_CHECKS + count - 1)
    away = warm[-1] - known
    return middle, slope * away, (variance * (1.0 + 1.0 / count) + away**2 * doubt) ** 0.5


def _slope(value: Array, warm: Array, variance: float, per_degree: float) -> tuple[float, float]:
    order = np.arange(len(value), dtype=float)
    design = np.stack([np.ones(len(value)), order - order.mean(), warm - warm.mean()], axis=1)
    sigma = variance**0.5
    best, spread = fit_believed(design / sigma, value / sigma, np.diag([0.0, 0.0, max(per_degree, 1e-9) ** -2]))
    return best[2], spread[2, 2]


SURE = 5.0
"""Standard deviations of a jumped zero; chosen, see `python -m benchmarks years`"""
SHARE = 1.0 / 3.0
"""Largest change of all else, over the jump; chosen"""
STAYED = 0.5
"""Share of the jump that must remain; chosen"""
BEFORE = 3
"""Checks whose median is the old zero; chosen"""
UNTOLD = 10.0
"""[K] difference where no temperature is known; chosen"""
DRAWS = 4000
"""chosen: an 80 % interval repeats within a few per cent"""
SHARES = (0.1, 0.5, 0.9)
"""Quantiles"""
_SEEN = 0.9
"""Share of drifts that must reach the tolerance; chosen"""
_UNEVEN = 0.36
"""Random share of wear over the whole span; chosen: `python -m benchmarks years`"""
_POINTS = 200
"""Newest checks that count; chosen: the work is cubic"""


def remaining(
    use: Array, error: Array, warm: Array, tolerance: float, *, scatter: float, per_degree: float
) -> Array | None:
    """Estimate the use left until an arm's ``error`` (T,) [mm] reaches ``tolerance`` [mm]: its quantiles `SHARES`.

    ``use`` (T,) grows; ``warm`` (T,) [K] is relative. None for too few checks or no wear.
    """
    use, error, warm = use[-_POINTS:], error[-_POINTS:], warm[-_POINTS:]
    if len(use) < FEWEST + 1 or use[-1] <= use[0]:
        return None
    span = use[-1] - use[0]
    x = (use - use[-1]) / span  # in spans, and 0 now: the line's height there is the present error
    warmer = np.nan_to_num(warm - np.nanmean(warm)) if np.isfinite(warm).any() else np.zeros(len(x))
    design = np.stack([np.ones(len(x)), x, warmer], axis=1)
    believed = np.diag([0.0, 0.0, 1.0 / max(per_degree, 1e-9) ** 2])
    common = np.minimum.outer(-x, -x)  # covariance of a Brownian motion, backwards from now
    diffusion = _UNEVEN * max(np.abs(np.polyfit(x, error, 1)[0]), scatter)
    root = np.linalg.cholesky(diffusion**2 * common + scatter**2 * np.eye(len(x)))
    white: Array = np.linalg.solve(root, np.column_stack([design, error]))
    best, spread = fit_believed(white[:, :-1], white[:, -1], believed)
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(best, spread, DRAWS)
    way, drift = tolerance - drawn[:, 0], drawn[:, 1]
    if (drift > 0.0).mean() < _SEEN:
        return None
    # Against the drift a motion still passes with a chance of exp(2 drift way / diffusion^2), then as with it.
    chance = np.exp(np.minimum(2.0 * drift * way / diffusion**2, 0.0))
    passes = (way > 0.0) & (rng.uniform(size=DRAWS) < chance)
    far = np.where(passes, way, 1.0)
    times = rng.wald(far / np.maximum(np.abs(drift), 1e-9 * diffusion), far**2 / diffusion**2)
    times = np.where(passes, times, np.where(way <= 0.0, 0.0, np.inf))
    return span * np.quantile(times, SHARES, method="higher")


ZERO_PER_DEGREE = np.radians(0.02)
"""[rad/K] drift of an STS3215's zero; shared facts on monitoring"""
FRICTION_PER_DEGREE = 0.015
"""[1/K] (Bittencourt and Axehill 2012: viscous friction halves in 47 K)"""
LOAD_PER_DEGREE = 0.002
"""[1/K] of sag; chosen"""
SCATTER_MM = {"hysteresis": 0.03, "reversal": 0.05, "sag": 0.07, "deviation": 0.06, "error": 0.10}
"""Sigma of one check of a steady arm; measured: `python -m benchmarks years`"""
SCATTER_SHARE = 0.005
"""The same as a share of the value; measured as above"""


@entity
class PastCheck:
    """One check of an arm."""

    time: datetime
    """UTC, naive"""
    measures: CheckMeasures
    used_h: float | None = None
    """of use so far; None: not counted"""


@value_type
class Change:
    """Change of one quantity of a joint, or of the tool."""

    joint: str
    """empty for the tool"""
    quantity: str
    """hysteresis, reversal, sag, deviation or error"""
    state: State
    usual_mm: float
    """baseline"""
    now_mm: float
    """at the baseline's temperature"""
    since: datetime | None
    """last check before it, if any"""
    cusum: float
    """signed, in standard deviations"""

    @property
    def moved_mm(self) -> float:
        """How far it is from the baseline."""
        return abs(self.now_mm - self.usual_mm)

    @property
    def better(self) -> bool:
        """Whether the quantity fell, or turned round: wear never does that."""
        return self.now_mm * (1.0 if self.usual_mm >= 0.0 else -1.0) < abs(self.usual_mm)


@value_type
class MovedZero:
    """A joint's zero that moved: a collision or a new homing."""

    joint: str
    degrees: float
    """signed"""
    after: datetime
    """last check before"""
    before: datetime
    """first check after"""


@value_type
class Due:
    """When the error reaches the tolerance: 10, 50 and 90 % quantiles."""

    early: datetime
    middle: datetime | None
    late: datetime | None
    """None: perhaps never, or after a century"""


@value_type
class Outlook:
    """State of an arm by its checks."""

    state: State
    checks: int
    since: datetime
    """first check"""
    newest: datetime
    """last check"""
    changes: tuple[Change, ...]
    """worst state first, then the largest; the tool last"""
    error_mm: float
    """in the five poses by encoders, without a controller"""
    tolerance_mm: float | None
    due: Due | None
    """None: unknown, no wear, or moved zeros"""
    moved: tuple[MovedZero, ...] = ()
    """largest first"""
    controlled_mm: float | None = None
    """largest with the repair's controller, if any"""

    @property
    def counts_mm(self) -> float:
        """[mm] error to compare with the tolerance."""
        return self.error_mm if self.controlled_mm is None else self.controlled_mm

    @property
    def later(self) -> bool:
        """Whether all joints are only later: a slower connection."""
        return all(
            one.state == "steady" if one.quantity != "hysteresis" else one.state != "steady" and not one.better
            for one in self.changes
        )

    @property
    def over(self) -> bool:
        """Whether the tolerance is reached."""
        return self.tolerance_mm is not None and self.counts_mm >= self.tolerance_mm


def outlook(visits: Sequence[PastCheck], tolerance_mm: float | None = None, *, left_mm: float | None = None) -> Outlook:
    """Judge an arm by its checks since the baseline began, oldest first.

    ``left_mm``: error with the repair's controller; it grows as that of the bare arm.
    """
    changes = _ranked([_change(visits, *one) for one in _quantities(visits)])
    zeros = (_moved_zero(visits, j) for j in range(len(visits[0].measures.joints)))
    moved = tuple(sorted(filter(None, zeros), key=lambda one: -abs(one.degrees)))
    state: State = "drifting" if moved and changes[0].state == "steady" else changes[0].state
    bare = _series(visits, "error_mm")
    counts = bare if left_mm is None else left_mm + bare - bare[:FEWEST].mean()
    found = Outlook(
        state=state,
        checks=len(visits),
        since=visits[0].time,
        newest=visits[-1].time,
        changes=changes,
        error_mm=float(bare[-1]),
        tolerance_mm=tolerance_mm,
        due=None,
        moved=moved,
        controlled_mm=None if left_mm is None else max(float(counts[-1]), left_mm),
    )
    if tolerance_mm is None or found.over or moved:
        return found
    return replace(found, due=_due(visits, counts, tolerance_mm))


def error_per_degree(measures: CheckMeasures) -> float:
    """[mm/K] of the tool error through the joints' zeros."""
    return float(ZERO_PER_DEGREE * np.sqrt(sum(row.lever_mm**2 for row in measures.joints)))


def _series(visits: Sequence[PastCheck], name: str, joint: int | None = None) -> Array:
    """Values (T,) of the tool or of a joint; NaN where unknown."""
    rows = [visit.measures if joint is None else visit.measures.joints[joint] for visit in visits]
    return np.array([getattr(row, name) for row in rows], dtype=float)


def _quantities(visits: Sequence[PastCheck]) -> Iterator[tuple[str, str, Array, Array, float]]:
    """Joint, quantity, values (T,) [mm], temperature (T,), and mm/K."""
    first = visits[0].measures
    for j, row in enumerate(first.joints):
        # Where a joint comes to rest lies within the band of its friction, and may go with the whole of it.
        band = FRICTION_PER_DEGREE * _typical(_series(visits, "hysteresis_mm", j))
        for name, share, least in (
            ("hysteresis", FRICTION_PER_DEGREE, 0.0),
            ("reversal", 0.0, band),
            ("sag", LOAD_PER_DEGREE, 0.0),
            ("deviation", LOAD_PER_DEGREE, ZERO_PER_DEGREE * row.lever_mm),
        ):
            value = _series(visits, f"{name}_mm", j)
            if np.isfinite(value).all():
                yield row.joint, name, value, _series(visits, "temperature_c", j), least + share * _typical(value)
    yield "", "error", _series(visits, "error_mm"), _series(visits, "temperature_c"), error_per_degree(first)


def _ranked(drawn: Sequence[Change]) -> tuple[Change, ...]:
    order = ("alarm", "drifting", "steady", "learning")

    def rank(one: Change) -> tuple[object, ...]:
        alike = [other for other in drawn if (other.state, other.joint, other.better) == (one.state, one.joint, False)]
        most = max((other.moved_mm for other in alike), default=0.0)
        return order.index(one.state), one.better, not one.joint, -most, one.quantity == "deviation", -one.moved_mm

    return tuple(sorted(drawn, key=rank))


def _moved_zero(visits: Sequence[PastCheck], j: int) -> MovedZero | None:
    """Last jump of a joint's zero, if it stayed and nothing jumped that also changes by wear."""
    row, warm = visits[0].measures.joints[j], _series(visits, "temperature_c", j)
    values = [_series(visits, f"{name}_mm", j) for name in ("deviation", "reversal", "hysteresis", "sag")]
    deviation, *others = [one for one in values if np.isfinite(one).all()]
    scatter, per_degree = _scatter("deviation", deviation), ZERO_PER_DEGREE * row.lever_mm
    for at in range(len(visits) - 1, 0, -1):
        way, warmer = deviation[at] - deviation[at - 1], warm[at] - warm[at - 1]
        doubt = per_degree * (abs(warmer) if np.isfinite(warmer) else UNTOLD)
        band = 0.5 * visits[at].measures.joints[j].hysteresis_mm  # anywhere in it a joint may rest
        if abs(way) < max(SURE * np.hypot(2.0**0.5 * scatter, doubt), band):
            continue
        alone = all(abs(one[at] - one[at - 1]) < SHARE * abs(way) for one in others)
        was = np.median(deviation[max(at - BEFORE, 0) : at])
        if alone and (deviation[-1] - was) / way >= STAYED:
            degrees, (after, before) = float(np.degrees(way / row.lever_mm)), visits[at - 1 : at + 1]
            return MovedZero(joint=row.joint, degrees=degrees, after=after.time, before=before.time)
    return None


def _typical(value: Array) -> float:
    return abs(np.median(value[:FEWEST]))


def _scatter(name: str, value: Array) -> float:
    """[mm] sigma of one check."""
    return max(SCATTER_MM[name], SCATTER_SHARE * _typical(value))


def _change(visits: Sequence[PastCheck], joint: str, name: str, value: Array, warm: Array, per_degree: float) -> Change:
    drawn: Chart = chart(value, warm, scatter=_scatter(name, value), per_degree=per_degree)
    return Change(
        joint=joint,
        quantity=name,
        state=drawn.state,
        usual_mm=drawn.usual,
        now_mm=drawn.usual + drawn.change,
        since=None if drawn.since is None else visits[drawn.since].time,
        cusum=float(drawn.cusum[-1]),
    )


def _due(visits: Sequence[PastCheck], error: Array, tolerance: float) -> Due | None:
    days = np.array([(visit.time - visits[0].time) / timedelta(days=1) for visit in visits])
    use = np.array([visit.used_h for visit in visits], dtype=float)
    if not ((np.diff(use) >= 0.0).all() and use[-1] > use[0] and days[-1] > days[0]):
        use = days  # hours are unknown, or somebody has told them wrongly
    left = remaining(
        use,
        error,
        _series(visits, "temperature_c"),
        tolerance,
        scatter=_scatter("error", error),
        per_degree=error_per_degree(visits[0].measures),
    )
    if left is None:
        return None
    days_left = (left * (days[-1] / (use[-1] - use[0]))).tolist()
    early, middle, late = (visits[-1].time + timedelta(days=one) if one < 36500.0 else None for one in days_left)
    return None if early is None else Due(early=early, middle=middle, late=late)


ROUGH = 1.0
"""[mm] beyond ten times the usual scatter; chosen"""
MONTH = timedelta(days=30)
"""Between checks of a steady arm; chosen"""
MEANINGS = {
    "hysteresis": "friction or weakness in slow motion",
    "reversal": "difference between its two directions",
    "sag": "giving way under its weight",
    "deviation": "distance from its commands",
    "error": "tool error",
}


def say(found: Outlook, repair: str) -> str:
    """Report the arm's state in one line; ``repair``: the command that repairs it."""
    what, do = _advice(found, repair)
    return f"{what}. {_error(found)}. Do: {do}"


def _advice(found: Outlook, repair: str) -> tuple[str, str]:
    worst, since = found.changes[0], _day(found.since)
    named = {one.joint for one in found.moved} or {worst.joint or "the tool"}
    others = {one.joint or "the tool" for one in found.changes if one.state == found.state} - named
    also = f" ({found.state}{'; also ' * bool(others)}{', '.join(sorted(others))})"
    if found.moved:
        return (
            f"{_cause_of(found)}, which is no wear but a bump, a new setting or another load{also}",
            f"if it was so, check it again with --moved --repeat 5; if not, look whether {found.moved[0].joint} has "
            f"slipped, then {repair}",
        )
    if found.state == "learning":
        return (
            f"Check {found.checks} since {since}: {FEWEST} are needed to know what is usual for this arm, and one more "
            "to see a change",
            repair if found.over else "check again; the first ones may follow each other at once",
        )
    if found.state == "steady":
        due = found.due and found.due.early
        later = (
            "nothing; check again in a month (what changed behind the encoders, only measured points show: calibrate)"
        )
        if due and due - found.newest < MONTH:
            later = f"nothing yet; check again by {_day(due)}, and make time for a repair"
        what, moved = f"No change since {since} that the encoders see", found.changes[-1].moved_mm
        if moved > ROUGH:
            what = f"The first checks since {since} differ too much to call {moved:.1f} mm a change"
            later = f"if a load or a place changed between them, check with --moved --repeat 5; else {later}"
        return what, repair if found.over else later
    return f"{_cause_of(found)}{also}", _act(found, worst, repair)


def _cause_of(found: Outlook) -> str:
    """Name what changed most, or return an empty text."""
    if found.moved:
        zeros = (f"{one.joint} by {abs(one.degrees):.1f} deg" for one in found.moved)
        return f"Zeros moved between {_day(found.moved[0].after)} and {_day(found.moved[0].before)}: {', '.join(zeros)}"
    if found.state not in ("drifting", "alarm"):
        return ""
    worst = found.changes[0]
    if found.later:
        return "All joints are later in slow motion, and rest where they did: commands or answers take longer"
    since = "" if worst.since is None else f" since {_day(worst.since)}"
    return f"{worst.joint or 'Tool'}: {MEANINGS[worst.quantity]} {worst.usual_mm:.1f} -> {worst.now_mm:.1f} mm{since}"


def _error(found: Outlook) -> str:
    text = f"Tool error at the five poses {found.error_mm:.1f} mm by the encoders"
    if found.controlled_mm is not None:
        text = f"{text} without a controller, at most {found.controlled_mm:.1f} mm with that of its repair"
    if found.tolerance_mm is None:
        return text
    text, due = f"{text}, tolerance {found.tolerance_mm:.1f} mm", found.due
    if found.over:
        return f"{text}, which is reached"
    if due is None:
        return text if found.state == "learning" or found.moved else f"{text}: no wear seen that leads there"
    ends = f"not before {_day(due.early)}" if due.late is None else f"between {_day(due.early)} and {_day(due.late)}"
    return f"{text}, reached {ends}"


def _act(found: Outlook, worst: Change, repair: str) -> str:
    whose = f"the servo of {worst.joint}" if worst.joint else "the servos"
    if found.later:
        return "look at the connection and the computer (rejoint doctor)" + f", then {repair}" * found.over
    act = f"{repair}; if the tool misses its tolerance then, and nothing blocks or pulls the arm, change {whose}"
    if not found.over and (found.state != "alarm" or (worst.better and worst.quantity != "deviation")):
        act = "check again within a week; no repair yet"
    elif worst.quantity == "deviation":
        act = f"look whether {worst.joint} has slipped or was set again (then check with --moved); else {repair}"
    loaded = {one.joint for one in found.changes if one.state == found.state and one.quantity in ("sag", "deviation")}
    if worst.better or len(loaded - {""}) > 1:  # wear lessens nothing, and comes to one joint at a time
        return (
            f"if the hand carries another load, the base stands otherwise, or {whose} changed, check with --moved "
            f"--repeat 5; if not, {act}"
        )
    return act


def _day(time: datetime) -> str:
    return f"{time:%Y-%m-%d}"
