"""Emulated arms over two years of monthly checks: who is told in time, who for nothing, and whether the dates hold.

An arm is checked five times in its first week and then once a month, in a room whose warmth goes with the seasons and
from day to day. Half of the arms age by `HOURS` of use a month, the others stay as they are. What is judged is what an
owner of a real arm would see: the encoders alone, with the true error hidden. The true errors are then compared at the
same warmth.
"""

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np

from rejoint.arms import load_arm
from rejoint.diagnosis.monitoring.judge import FEWEST, PastCheck, outlook
from rejoint.diagnosis.monitoring.measures import CheckMeasures, measure_check, record_check
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear

ARMS = 100
"""Of each kind"""
SIDE_BY_SIDE = 25
"""Arms of one batch (chosen: of fifty a check takes 0.5 s of processor, of twelve 0.7 s, and more are little faster)"""
MONTHS = 24
HOURS = 6.0
"""[h] of use a month (chosen: the tool's true error then grows by about a millimetre in eight months)"""
FIRST_WEEK = [0.15 * index / (FEWEST - 1) for index in range(FEWEST)]
DATES = [*FIRST_WEEK, *(float(month) for month in range(1, MONTHS + 1))]
"""[months] of all checks of an arm"""
GROWN = 1.0
"""[mm] of true error before which an arm is to be flagged"""
TOLERANCE = 1.5
"""[mm] above the first error: what the owner can bear"""
BEGIN = datetime(2027, 1, 1)

Measured = list[tuple[CheckMeasures, ...]]
"""Checks of one arm after the other"""


def main(arms: int = ARMS, base: int = 100) -> None:
    """Check ``arms`` of each kind; ``base`` is the seed of the first: limits are judged on arms not chosen on."""
    report(
        *(
            [
                each
                for first in range(0, arms, SIDE_BY_SIDE)
                for each in zip(
                    *(
                        checked(range(first, min(first + SIDE_BY_SIDE, arms)), k, hours, seed)
                        for k in range(len(DATES))
                    ),
                    strict=True,
                )
            ]
            for seed, hours in ((base, HOURS), (base + 100, 0.0))
        )
    )


def checked(arms: range, number: int, hours: float, base: int) -> list[CheckMeasures]:
    """Check a batch of arms at one date."""
    arm, month = load_arm("mycobot280"), DATES[number]
    wears = [
        load_wear(f"healthy?seed={seed}&hours={hours * month:g}&ambient={_ambient(seed, number, month):.2f}", arm)
        for seed in (base + index for index in arms)
    ]
    robot = EmulatedRobot(arm, wears, seed=10 * base + number, first=arms.start)
    return [measure_check(arm, log, warm) for log, warm in record_check(robot)]


def report(ageing: Measured, steady: Measured) -> None:
    """Print what an owner would have been told, against what is true."""
    told, early, unflagged = [], 0, 0
    for arm in ageing:
        grown, flagged = grown_at(arm), flagged_at(arm)
        unflagged += flagged is None
        in_time = flagged is not None and flagged <= grown
        early += in_time
        told.append((np.inf if flagged is None else flagged, grown))
    flags = np.array(told)
    last = DATES[len(ageing[0]) - 1]
    share = 100 * early / len(ageing)
    print(
        f"{len(ageing)} ageing arms, {last:g} months: flagged before {GROWN:g} mm of true error {share:.0f} %; "
        f"never flagged {unflagged}; flagged at month {np.median(flags[:, 0]):.0f} (median), "
        f"{GROWN:g} mm at month {np.median(flags[:, 1]):.0f}"
    )
    false = sum(flagged_at(arm) is not None for arm in steady)
    years = len(steady) * DATES[len(steady[0]) - 1] / 12
    print(f"{len(steady)} arms that stay as they are: {false} false alarms in {years:.0f} arm-years")
    jumps = sum(
        bool(outlook(past[:stop]).moved)
        for past in map(history, [*ageing, *steady])
        for stop in range(2, len(past) + 1)
    )
    print(f"zeros said to have moved, of which none has: after {jumps} of all checks")
    for start, stop in ((6, 12), (12, 18), (18, MONTHS)):
        by_arm = [(_reached(arm), dates_hold(arm, start, stop)) for arm in ageing]
        held = [one for _, some in by_arm for one in some]
        if held:
            decided = sum(len(some) for reached, some in by_arm if np.isfinite(reached))
            share = f"{100 * np.mean(held):.0f} % of {len(held)} ({decided} of them decided by the last month)"
            print(
                f"predictions of months {start} to {stop}: {share} 80 % intervals hold when the tolerance was reached"
            )


def _reached(arm: Sequence[CheckMeasures]) -> float:
    """Month in which the error by the encoders has grown by `TOLERANCE`; infinite where it never does."""
    return crossing([one.error_mm for one in arm], arm, TOLERANCE)


def flagged_at(arm: Sequence[CheckMeasures]) -> float | None:
    """Month of the first alarm; None where there is none."""
    past = history(arm)
    for stop in range(FEWEST + 1, len(past) + 1):
        if outlook(past[:stop]).state == "alarm":
            return DATES[stop - 1]
    return None


def grown_at(arm: Sequence[CheckMeasures]) -> float:
    """Month in which the true error has grown by `GROWN` at the same warmth; infinite where it never does."""
    return crossing([one.true_error_mm or np.nan for one in arm], arm, GROWN)


def dates_hold(arm: Sequence[CheckMeasures], start: int, stop: int) -> list[bool]:
    """Whether intervals of predictions in the months from ``start`` to ``stop`` hold what came then, every third one.

    What lies beyond the last month counts as held where the interval does not end before it.
    """
    past, error = history(arm), [one.error_mm for one in arm]
    limit = error[0] + TOLERANCE
    reached = _reached(arm)
    held = []
    for index in range(FEWEST + start - 1, min(FEWEST + stop, len(past)), 3):
        month = DATES[index]
        if reached <= month or month < start:
            continue
        due = outlook(past[: index + 1], limit).due
        if due is None:
            continue
        low = (due.early - BEGIN) / timedelta(days=30.4)
        high = np.inf if due.late is None else (due.late - BEGIN) / timedelta(days=30.4)
        held.append(low <= reached <= high if np.isfinite(reached) else high >= DATES[len(past) - 1])
    return held


def crossing(error: Sequence[float], arm: Sequence[CheckMeasures], grown: float) -> float:
    """Month in which ``error`` passes its start by ``grown`` [mm], warmth taken out: a line beside a cubic."""
    month = np.array(DATES[: len(arm)])
    warm = np.array([one.temperature_c or 0.0 for one in arm])
    design = np.stack([np.ones(len(month)), month, month**2, month**3, warm - warm.mean()], axis=1)
    best = np.linalg.lstsq(design, np.array(error), rcond=None)[0]
    fine = np.linspace(0.0, month[-1], 500)
    smooth = np.stack([fine, fine**2, fine**3], axis=1) @ best[1:4]
    passed = smooth >= grown
    return float(fine[np.argmax(passed)]) if passed.any() else np.inf


def history(arm: Sequence[CheckMeasures]) -> list[PastCheck]:
    """Return the checks as an owner of a real arm has them: nobody knows where the tool is."""
    return [
        PastCheck(
            time=BEGIN + timedelta(days=30.4 * month),
            used_h=HOURS * month,
            measures=replace(one, true_error_mm=None),
        )
        for month, one in zip(DATES[: len(arm)], arm, strict=True)
    ]


def _ambient(seed: int, number: int, month: float) -> float:
    """[deg C] 23 on average, 5 with the seasons, 1.5 from day to day (chosen: a school without air conditioning)."""
    phase = np.random.default_rng([seed, 9]).integers(12)
    season = 23.0 + 5.0 * np.sin(2.0 * np.pi * (month + phase) / 12.0)
    return float(np.clip(season + np.random.default_rng([seed, number, 3]).normal(0.0, 1.5), -10.0, 50.0))
