"""Charts and first passages on numbers drawn by hand: what is steady stays so, what moves is found."""

import numpy as np
import pytest

from rejoint.diagnosis.monitoring.judge import ALARM, FEWEST, chart, remaining

SCATTER = 0.1
COLD = np.full(40, np.nan)


def seasons(rng, count):
    return 23 + 5 * np.sin(2 * np.pi * (np.arange(count) + rng.integers(12)) / 12) + rng.normal(0, 1.5, count)


def test_an_arm_that_does_not_change_is_hardly_ever_an_alarm():
    """Of twenty quantities and more one may call out in fifty arm-years; two years of warmth are in all of them."""
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(400):
        warm = seasons(rng, 29)
        value = 3.0 + SCATTER * rng.normal(size=29) + rng.uniform(-0.1, 0.1) * SCATTER / 0.25 * (warm - 23)
        found = chart(value, warm, scatter=SCATTER, per_degree=0.1 * SCATTER / 0.25)
        alarms += bool((np.abs(found.cusum) >= ALARM).any())
    assert alarms <= 3


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_step_is_an_alarm_and_dated(sign):
    rng = np.random.default_rng(2)
    value = SCATTER * rng.normal(size=30)
    value[18:] += sign * 6 * SCATTER
    drawn = chart(value, COLD[:30], scatter=SCATTER, per_degree=0.1)
    assert drawn.state == "alarm"
    assert np.sign(drawn.cusum[-1]) == sign
    assert 17 <= drawn.since <= 18


def test_a_single_odd_check_is_a_drift_and_no_part_of_the_norm():
    value = np.append(np.full(FEWEST, 3.0), 3 * [-90.0])
    some = [chart(value[:k], COLD[:k], scatter=SCATTER, per_degree=0.1) for k in range(FEWEST + 1, len(value) + 1)]
    assert [one.state for one in some] == ["drifting", "drifting", "alarm"]
    assert some[-1].usual == 3.0


def test_warmth_is_no_wear_and_wear_no_warmth():
    """A slope over temperature is learnt; a change over time in the same seasons is still found."""
    rng = np.random.default_rng(3)
    alarms, found = 0, 0
    for _ in range(60):
        warm = seasons(rng, 26)
        value = 0.08 * warm + SCATTER * rng.normal(size=26)
        alarms += chart(value, warm, scatter=SCATTER, per_degree=0.1).state == "alarm"
        wear = np.maximum(np.arange(26) - 8, 0) * 0.08
        found += chart(value + wear, warm, scatter=SCATTER, per_degree=0.1).state == "alarm"
    assert alarms <= 1
    assert found >= 57
    blind = [chart(0.08 * seasons(rng, 26), COLD[:26], scatter=SCATTER, per_degree=0.1).state for _ in range(20)]
    assert blind.count("alarm") >= 5  # what the test above would find where warmth is not told apart


def test_the_tolerance_is_reached_in_the_interval():
    """Brownian motions with drift, seen with scatter: the interval holds the real first passage in about 80 %."""
    rng = np.random.default_rng(4)
    held = made = 0
    for _ in range(120):
        drift, spread = rng.uniform(0.08, 0.2), 0.12
        path = np.cumsum(np.r_[0.0, drift + spread * rng.normal(size=400)])
        tolerance = path[:14].max() + 1.0
        left = remaining(
            np.arange(14.0),
            path[:14] + SCATTER * rng.normal(size=14),
            COLD[:14],
            tolerance,
            scatter=SCATTER,
            per_degree=0.1,
        )
        if left is None:
            continue
        made += 1
        passed = int(np.argmax(path >= tolerance)) - 13
        held += left[0] - 1 <= passed <= left[-1] + 1
        assert (np.sort(left) == left).all()
    assert made >= 100
    assert 0.7 <= held / made <= 0.95


def test_an_arm_that_does_not_wear_is_given_no_date():
    rng = np.random.default_rng(5)
    told = [
        remaining(np.arange(20.0), SCATTER * rng.normal(size=20), COLD[:20], 3.0, scatter=SCATTER, per_degree=0.1)
        for _ in range(20)
    ]
    assert sum(one is not None for one in told) <= 4  # of 90 % one-sided limits, one in ten is chance
    few = remaining(np.arange(4.0), np.arange(4.0), COLD[:4], 9.0, scatter=SCATTER, per_degree=0.1)
    assert few is None
