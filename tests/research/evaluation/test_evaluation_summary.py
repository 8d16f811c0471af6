"""From outcomes to rows, pairs and failures: every number worked by hand."""

import dataclasses

import numpy as np
import pytest
from evaluation_samples import outcome

from rejoint.arms import mycobot280
from rejoint.control.comparison.result import Protocol
from rejoint.control.guard import Reason
from rejoint.research.evaluation.failures import FAR, list_failures, what_happened
from rejoint.research.evaluation.summary import make_pair, make_row
from rejoint.system.statistics import wilson

ARM = mycobot280()


def test_a_row_counts_what_it_says():
    settled = np.array([[0.2, 0.4], [0.3, 6.0], [np.nan, 0.5]])
    found = dataclasses.replace(
        outcome(settled, np.array([[1.0, 2.0], [3.0, np.inf], [np.nan, 4.0]])),
        oscillation=np.array([[1e-4, 3e-4], [1e-4, 1e-4], [np.nan, 1e-4]]),
        crossed=np.array([[1.0, 1.0], [0.0, 1.0], [1.0, 0.0]]),
        crossing_error=np.array([[9e-3, 8e-3], [20e-3, 9e-3], [8e-3, 12e-3]]),
        crossing_time=np.array([[1.0, 2.0], [20.0, 2.0], [1.0, 20.0]]),
    )
    row = make_row("worn", "x", [found], Protocol())
    assert (row.variant, row.controller, row.seeds) == ("worn", "x", 1)
    assert row.settled.value == pytest.approx(7.4e-3 / 5)
    assert row.settled_p95 == pytest.approx(np.quantile([0.2, 0.4, 0.3, 6.0, 0.5], 0.95) / 1e3)
    assert row.settled_true.value == pytest.approx((7.4 / 5 + 7.0) / 1e3)
    assert row.true_p95 == pytest.approx(row.settled_p95 + 7e-3)
    assert row.oscillation == pytest.approx(7e-4 / 5)
    assert row.outside.value == pytest.approx(2 / 6)  # 6 mm, and the one that the guard stopped
    assert [one.distance for one in row.within] == [0.010, 0.005, 0.002]
    assert row.within[-1].share.value == pytest.approx(4 / 6)
    assert row.within[-1].median == pytest.approx(3.5)
    assert row.success.value == pytest.approx(4 / 6)
    assert row.crossing_error.value == pytest.approx(66e-3 / 6)
    assert row.cycle_time.value == pytest.approx(10 * (1.5 + 11.0 + 10.5) / 3)  # of ten targets


def test_fewer_than_half_stay_is_never():
    row = make_row("worn", "x", [outcome(np.ones((2, 2)), np.array([[1.0, np.inf], [np.inf, np.inf]]))], Protocol())
    assert row.within[0].median is None
    assert row.within[0].share.value == 0.25


def test_without_the_crossing_protocol_nothing_is_said_of_it():
    none = np.full((2, 2), np.nan)
    found = dataclasses.replace(outcome(np.ones((2, 2))), crossed=none, crossing_error=none, crossing_time=none)
    row = make_row("worn", "x", [found], Protocol())
    assert (row.success, row.cycle_time, row.crossing_error) == (None, None, None)


def test_targets_of_one_arm_do_not_count_as_independent():
    """Arms that fail at all their targets or at none: the interval is that of so many arms."""
    settled = np.repeat(np.where(np.arange(20) < 5, 9.0, 0.3)[:, None], 8, axis=1)
    row = make_row("worn", "x", [outcome(settled)], Protocol())
    arms = wilson(5, 20)
    assert row.outside.value == 0.25
    assert row.outside.low == pytest.approx(arms.low, abs=0.01)
    assert row.outside.high == pytest.approx(arms.high, abs=0.01)


def test_training_seeds_on_the_same_arms_bring_no_new_arms():
    rng = np.random.default_rng(0)
    one = outcome(rng.uniform(0.2, 0.6, (8, 1)).repeat(3, axis=1))
    alone, twice = (make_row("worn", "p", [one] * count, Protocol()) for count in (1, 2))
    assert (alone.seeds, twice.seeds) == (1, 2)
    for end in ("value", "low", "high"):
        assert getattr(twice.settled, end) == pytest.approx(getattr(alone.settled, end))


def test_each_seed_meets_each_seed_on_the_same_arm():
    mine = [outcome(np.array([[1.0], [2.0]])), outcome(np.array([[2.0], [3.0]]))]
    rival = [outcome(np.array([[2.0], [4.0]]), cycle=9.0)]
    pair = make_pair("worn", ("policy", mine), ("rival", rival))
    assert pair.settled.value == pytest.approx(-1.0e-3)  # mean of -1 0 -2 -1 mm
    assert pair.cycle_time.value == pytest.approx(-4.0)


def test_a_pair_turned_round_says_the_opposite():
    rng = np.random.default_rng(5)
    groups = [
        (name, [outcome(rng.uniform(0.2, 3.0, (7, 3)), rng.uniform(0.5, 4.0, (7, 3)), cycle=c) for c in cycles])
        for name, cycles in (("a", (5.0, 6.0, 7.0)), ("b", (9.0,)))
    ]
    there, back = make_pair("worn", *groups), make_pair("worn", *groups[::-1])
    assert (there.controller, there.rival) == (back.rival, back.controller) == ("a", "b")
    for field in ("settled", "settled_true", "cycle_time"):
        one, other = getattr(there, field), getattr(back, field)
        assert (one.value, one.low, one.high) == pytest.approx((-other.value, -other.high, -other.low))
    for one, other in zip(there.stay_ratio, back.stay_ratio, strict=True):
        assert (one.value, one.low, one.high) == pytest.approx((1 / other.value, 1 / other.high, 1 / other.low))


def test_failures_are_listed_one_by_one():
    found = list_failures(ARM, "worn", "x", outcome(np.array([[0.4, 5.1], [np.nan, 4.9]])))
    assert [(one.arm, one.target, one.settled_mm) for one in found] == [(10_000, 1, 5.1), (10_001, 0, None)]
    assert [one.true_mm for one in found] == [12.1, None]
    assert {(one.variant, one.controller) for one in found} == {("worn", "x")}


def test_a_hold_fails_beyond_five_millimetres_and_not_at_them():
    at, beyond = np.full((1, 1), 1e3 * FAR), np.full((1, 1), np.nextafter(1e3 * FAR, 6.0))
    assert FAR == 0.005
    assert list_failures(ARM, "worn", "x", outcome(at)) == ()
    assert len(list_failures(ARM, "worn", "x", outcome(beyond))) == 1
    for settled, share in ((at, 0.0), (beyond, 1.0)):  # the row counts what the list lists
        assert make_row("worn", "x", [outcome(settled)], Protocol()).outside.value == share


def told(**changes):
    return what_happened(ARM, dataclasses.replace(outcome(np.full((1, 1), 8.0)), **changes), 0, 0)


def joint(number, value):
    found = np.zeros((1, 1, 6))
    found[0, 0, number - 1] = value
    return found


def one(value):
    return np.full((1, 1), value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "rests, and its command does not change"),
        ({"saturation": joint(4, 0.51)}, "the motor of joint4 is at its limit"),
        ({"saturation": joint(4, 0.50)}, "rests, and its command does not change"),
        ({"lead": joint(3, np.radians(-12.0))}, "joint3 stands while its command leads by -12.0 deg"),
        ({"lead": joint(3, np.radians(2.9))}, "rests, and its command does not change"),
        ({"lead": joint(3, np.radians(12.0)), "swing": joint(3, 2.6 * ARM.encoder_step)},
         "rests, and its command does not change"),
        ({"oscillation": one(4e-3), "swing": joint(5, np.radians(5.0))}, "oscillates by 4.0 mm, joint5 by 5.0 deg"),
        ({"oscillation": one(0.4e-3), "swing": joint(5, np.radians(5.0))}, "rests, and its command does not change"),
        ({"limited": one(float(Reason.POSITION))}, "the guard limits it (position)"),
        ({"approach": one(3e-3)}, "still coming nearer, 3.0 mm in the last second"),
        ({"approach": one(-3e-3)}, "rests, and its command does not change"),
        ({"settled": one(np.nan), "tripped": np.array([float(Reason.TEMPERATURE)])},
         "stopped by the guard (temperature)"),
        # The strongest reason first; a motor at its limit leads because of that, and is not said to stick as well.
        ({"saturation": joint(2, 1.0), "lead": joint(2, np.radians(12.0))}, "the motor of joint2 is at its limit"),
        ({"saturation": joint(2, 1.0), "lead": joint(6, np.radians(9.0)), "approach": one(3e-3)},
         "the motor of joint2 is at its limit; joint6 stands while its command leads by 9.0 deg; "
         "still coming nearer, 3.0 mm in the last second"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_what_happened_is_told_apart(changes, words):
    assert told(**changes) == words
