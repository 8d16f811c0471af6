"""What the checks of an arm say together: how it stands, which joint changed since when, and how long it will do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import numpy as np

from rejoint.arms import Array
from rejoint.diagnosis.monitoring.charts import FEWEST, Chart, State, chart
from rejoint.diagnosis.monitoring.jumps import find_jump
from rejoint.diagnosis.monitoring.measures import CheckMeasures
from rejoint.diagnosis.monitoring.remaining import remaining

ZERO_PER_DEGREE = np.radians(0.02)
"""[rad/K] by which the zero of an STS3215 may move (shared facts on monitoring)"""
FRICTION_PER_DEGREE = 0.015
"""[1/K] by which friction may go with warmth (Bittencourt and Axehill 2012: viscous friction halves in 47 K)"""
LOAD_PER_DEGREE = 0.002
"""[1/K] by which what weight does may go with warmth (chosen: copper loses 0.4 %/K of its conductance, of which a
position servo makes up half)"""
SCATTER_MM = {"hysteresis": 0.03, "reversal": 0.05, "sag": 0.07, "deviation": 0.06, "error": 0.10}
"""[mm] standard deviation of one check of an arm that does not change (measured: `python -m benchmarks years`)"""
SCATTER_SHARE = 0.005
"""The same as a share of the value, which friction that is uneven makes of it (measured as above)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class PastCheck:
    """One check in the history of an arm."""

    time: datetime
    """UTC, without a zone"""
    measures: CheckMeasures
    used_h: float | None = None
    """[h] of use so far; None where nobody counts"""


@dataclass(frozen=True, kw_only=True)
class Change:
    """One quantity of one joint, or of the tool, over the checks."""

    joint: str
    """empty for the tool"""
    quantity: str
    """hysteresis, reversal, sag, deviation or error"""
    state: State
    usual_mm: float
    """at the beginning"""
    now_mm: float
    """at the warmth of the beginning"""
    since: datetime | None
    """of the last check before it began to leave; None where it has not"""
    cusum: float
    """standard deviations that have come together, with sign"""
    away: float = 0.0
    """standard deviations of a check that changes nothing by which the last three lie off, their middle, with sign"""

    @property
    def better(self) -> bool:
        """Whether there is less of it than there was: nothing wears like that."""
        return abs(self.now_mm) < abs(self.usual_mm)


@dataclass(frozen=True, kw_only=True)
class MovedZero:
    """The zero of a joint is not where it was: the arm was bumped, or set anew."""

    joint: str
    degrees: float
    """with the sign of the deviation"""
    after: datetime
    """of the last check before"""
    before: datetime
    """of the first check after"""


@dataclass(frozen=True, kw_only=True)
class Due:
    """When the tolerance will be reached; ten and ninety per cent of the times that are possible lie before."""

    early: datetime
    middle: datetime | None
    late: datetime | None
    """None where it may never be reached, or not in a lifetime"""


@dataclass(frozen=True, kw_only=True)
class Outlook:
    """How an arm stands by its checks since its norm began."""

    state: State
    checks: int
    since: datetime
    """of the first of them"""
    newest: datetime
    """of the last of them"""
    changes: tuple[Change, ...]
    """the worst state first, and in it the joint that changed most; what is of the tool comes last"""
    error_mm: float
    """of the tool in the five poses, newest, without a controller"""
    error_known: bool
    """whether that is where the tool really is; else it is by the encoders"""
    tolerance_mm: float | None
    due: Due | None
    """None where nothing can be said, no wear shows, or zeros have moved"""
    moved: tuple[MovedZero, ...] = ()
    """joints whose zeros have moved since the norm began, the furthest first"""
    controlled_mm: float | None = None
    """of the tool with the controller of the repair that the norm began after, at most: what the repair left, and by
    how much the bare arm is worse than in its first checks since; None where there was no repair"""

    @property
    def counts_mm(self) -> float:
        """[mm] error that the tolerance is compared with: with the controller where the arm was repaired."""
        return self.error_mm if self.controlled_mm is None else self.controlled_mm

    @property
    def over(self) -> bool:
        """Whether the tolerance is reached already."""
        return self.tolerance_mm is not None and self.counts_mm >= self.tolerance_mm


def outlook(visits: Sequence[PastCheck], tolerance_mm: float | None = None, *, left_mm: float | None = None) -> Outlook:
    """Judge an arm by its checks since the norm began, the oldest first; there is at least one.

    ``left_mm`` is the tool error that the controller of the last repair left, where there was one: the owner drives the
    arm with it, so that is what comes near to ``tolerance_mm``, by as much as the bare arm becomes worse.
    """
    warm = np.array([_nan(visit.measures.temperature_c) for visit in visits])
    drawn = [_change(visits, *one) for one in _quantities(visits, warm)]
    changes = _ranked(drawn)
    moved = _moved(visits)
    state: State = "drifting" if moved and changes[0].state == "steady" else changes[0].state
    known = all(visit.measures.true_error_mm is not None for visit in visits)
    error = [visit.measures.true_error_mm if known else visit.measures.error_mm for visit in visits]
    bare = np.array(error, dtype=float)
    counts = bare if left_mm is None else left_mm + bare - bare[:FEWEST].mean()
    found = Outlook(
        state=state, checks=len(visits), since=visits[0].time, newest=visits[-1].time, changes=changes,
        error_mm=float(bare[-1]),
        error_known=known, tolerance_mm=tolerance_mm, due=None, moved=moved,
        controlled_mm=None if left_mm is None else max(float(counts[-1]), left_mm),
    )  # fmt: skip
    if tolerance_mm is None or found.over or moved:
        return found
    return replace(found, due=_due(visits, counts, warm, tolerance_mm))


def error_per_degree(measures: CheckMeasures) -> float:
    """[mm/K] by which warmth may move the tool's error: the zeros of all joints, each for itself."""
    return float(ZERO_PER_DEGREE * np.sqrt(sum(row.lever_mm**2 for row in measures.joints)))


def error_scatter(error: Array) -> float:
    """[mm] standard deviation of one check's tool error where the arm does not change."""
    return _scatter("error", error)


def _quantities(visits: Sequence[PastCheck], warm: Array) -> list[tuple[str, str, Array, Array, float]]:
    """Joint, quantity, values (T,) [mm], temperature (T,), and mm per degree that warmth may do."""
    found = []
    first = visits[0].measures
    for j, row in enumerate(first.joints):
        rows = [visit.measures.joints[j] for visit in visits]
        own = np.array([_nan(one.temperature_c) for one in rows])
        zero = ZERO_PER_DEGREE * row.lever_mm
        # Where a joint comes to rest lies within the band of its friction, and may go with the whole of it.
        band = FRICTION_PER_DEGREE * abs(float(np.median([one.hysteresis_mm for one in rows[:FEWEST]])))
        for name, share, least in (
            ("hysteresis", FRICTION_PER_DEGREE, 0.0), ("reversal", 0.0, band),
            ("sag", LOAD_PER_DEGREE, 0.0), ("deviation", LOAD_PER_DEGREE, zero),
        ):  # fmt: skip
            values = [getattr(one, f"{name}_mm") for one in rows]
            if all(value is not None for value in values):
                value = np.array(values, dtype=float)
                found.append((row.joint, name, value, own, least + share * abs(float(np.median(value[:FEWEST])))))
    error = np.array([visit.measures.error_mm for visit in visits])
    return [*found, ("", "error", error, warm, error_per_degree(first))]


def _ranked(drawn: Sequence[Change]) -> tuple[Change, ...]:
    """Put what is to be named as the cause first: the worst state, then the joint that is furthest off.

    Of a joint its friction and sag come first, which say more than how far it stands off.
    Not by the CUSUM: no check adds more to it than `CUT`, so that all joints that wear fast have the same.
    """
    order: tuple[State, ...] = ("alarm", "drifting", "steady", "learning")
    most: dict[tuple[str, str], float] = {}
    for one in drawn:
        key = one.state, one.joint
        most[key] = max(most.get(key, 0.0), abs(one.away))
    return tuple(sorted(drawn, key=lambda one: (
        order.index(one.state), not one.joint, -most[one.state, one.joint], one.quantity == "deviation", -abs(one.away),
    )))  # fmt: skip


def _moved(visits: Sequence[PastCheck]) -> tuple[MovedZero, ...]:
    """Find the joints whose zeros have moved."""
    found = []
    for j, row in enumerate(visits[0].measures.joints):
        rows = [visit.measures.joints[j] for visit in visits]
        deviation = np.array([one.deviation_mm for one in rows])
        others = [np.array([one.reversal_mm for one in rows]), np.array([one.hysteresis_mm for one in rows])]
        if all(one.sag_mm is not None for one in rows):
            others.append(np.array([_nan(one.sag_mm) for one in rows]))
        jump = find_jump(
            deviation, others, np.array([_nan(one.temperature_c) for one in rows]),
            scatter=_scatter("deviation", deviation), per_degree=ZERO_PER_DEGREE * row.lever_mm,
        )  # fmt: skip
        if jump is not None:
            found.append(
                MovedZero(
                    joint=row.joint, degrees=float(np.degrees(jump.way / row.lever_mm)),
                    after=visits[jump.at - 1].time, before=visits[jump.at].time,
                )
            )  # fmt: skip
    return tuple(sorted(found, key=lambda one: -abs(one.degrees)))


def _scatter(name: str, value: Array) -> float:
    """[mm] standard deviation of one check's quantity where the arm does not change."""
    return max(SCATTER_MM[name], SCATTER_SHARE * abs(float(np.median(value[:FEWEST]))))


def _change(visits: Sequence[PastCheck], joint: str, name: str, value: Array, warm: Array, per_degree: float) -> Change:
    drawn: Chart = chart(value, warm, scatter=_scatter(name, value), per_degree=per_degree)
    return Change(
        joint=joint, quantity=name, state=drawn.state, usual_mm=drawn.usual, now_mm=drawn.usual + drawn.change,
        since=None if drawn.since is None else visits[drawn.since].time,
        cusum=float(drawn.cusum[-1]), away=drawn.lately / _scatter(name, value),
    )  # fmt: skip


def _due(visits: Sequence[PastCheck], error: Array, warm: Array, tolerance: float) -> Due | None:
    """Tell when the tolerance is reached: by use where the owner counts it, at the pace seen; else by the calendar."""
    days = np.array([(visit.time - visits[0].time) / timedelta(days=1) for visit in visits])
    hours = np.array([_nan(visit.used_h) for visit in visits])
    grows = bool(np.isfinite(hours).all() and (np.diff(hours) >= 0.0).all())  # else somebody has told them wrongly
    counted = grows and hours[-1] > hours[0] and days[-1] > days[0]
    use = hours if counted else days
    pace = (hours[-1] - hours[0]) / (days[-1] - days[0]) if counted else 1.0
    scatter, per_degree = error_scatter(error), error_per_degree(visits[0].measures)
    left = remaining(use, error, warm, tolerance, scatter=scatter, per_degree=per_degree)
    if left is None:
        return None
    now = visits[-1].time
    early = _after(now, left.early / pace)
    return None if early is None else Due(early=early, middle=_after(now, left.middle / pace),
                                          late=_after(now, left.late / pace))  # fmt: skip


def _after(now: datetime, days: float) -> datetime | None:
    """Return the time so many days later; None for more than a century, which is no prediction."""
    return now + timedelta(days=days) if days < 36500.0 else None


def _nan(value: float | None) -> float:
    return np.nan if value is None else value
