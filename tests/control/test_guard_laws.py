"""Whatever comes in, what the guard lets out keeps its laws (see guard_laws.py); benchmarks/guard.py asks millions."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from guard_laws import (
    Case,
    check,
    check_clear,
    clearances,
    draw_cases,
    random_chain,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from arms.test_collision import each_arm
from rejoint.arms import mycobot280, so101
from rejoint.control.guard import TRIPS, GuardLimits, Reason, guard
from rejoint.diagnosis.excitation import plan_excitation
from standin import state_of

ARMS = 8
SEEDS = st.integers(0, 2**32 - 1)


@lru_cache
def limits_of(kind):
    """Limits of the arms of the catalogue, then of some that nobody built."""
    arm = [mycobot280, so101][kind]() if kind < 2 else random_chain(np.random.default_rng(kind))
    return GuardLimits.of(arm)


@settings(max_examples=60)
@given(st.integers(0, ARMS - 1), SEEDS, st.sampled_from([0.0, 0.1, 0.5]))
def test_whatever_comes_in_the_laws_hold(kind, seed, garbage):
    limits = limits_of(kind)
    case, before = (draw_cases(limits, np.random.default_rng(seed), 64, garbage=garbage) for _ in range(2))
    check(limits, case)
    for now, then in zip((*case, case.state.position), (*before, before.state.position), strict=True):
        assert now is case.state or np.array_equal(now, then, equal_nan=True), "what comes in is not changed"


class Adversary:
    """Controllers of B arms that want what they should not, each for some cycles."""

    def __init__(self, arm, count, rng):
        self.arm, self.rng, self.shape = arm, rng, (count, arm.joints)
        self.goal, self.kind = np.zeros(self.shape), np.zeros(count, dtype=int)

    def command(self, cycle, sent):
        rng, arm = self.rng, self.arm
        new = rng.random(len(sent)) < 0.1
        self.kind = np.where(new, rng.integers(0, 5, len(sent)), self.kind)
        self.goal = np.where(new[:, None], rng.uniform(arm.lower - 0.5, arm.upper + 0.5, self.shape), self.goal)
        side = 1.0 if cycle % 2 else -1.0
        wanted = np.stack(
            [
                self.goal,
                sent + side * np.sign(self.goal),
                sent + 0.01 * rng.normal(size=self.shape),
                sent + 0.3 * (self.goal - sent),
                np.full(self.shape, 1e9 * side),
            ]
        )
        wanted = wanted[self.kind, np.arange(len(sent))]
        return np.where(rng.random((len(sent), 1)) < 0.01, np.nan, wanted)


@settings(max_examples=8)
@given(st.integers(0, ARMS - 1), SEEDS)
def test_no_sequence_of_commands_leads_an_arm_into_trouble(kind, seed):
    # As a loop does: what went out is the next call's last command. The arms lag, sag and stumble behind.
    rng, limits = np.random.default_rng(seed), limits_of(kind)
    count, arm = 24, limits.arm
    adversary = Adversary(arm, count, rng)
    sent = np.tile(np.clip(arm.rest, limits.lower, limits.upper), (count, 1))
    speed, position, sag = np.zeros_like(sent), sent.copy(), rng.normal(scale=0.05, size=sent.shape)
    first, seen = np.minimum(clearances(limits, sent), 0.0), 0
    for cycle in range(60):
        period = rng.choice(
            [0.004, 0.02, 0.025, 0.05, 0.1, 2.0, 0.0, np.nan], count, p=[0.1, 0.3, 0.2, 0.2, 0.05, 0.05, 0.05, 0.05]
        )
        position = position + 0.5 * (sent + sag - position) + rng.normal(scale=1e-3, size=sent.shape)
        state = state_of(position)
        out = check(limits, Case(adversary.command(cycle, sent), sent, speed, state, period))
        sent, speed, seen = out.command, out.speed, seen | int(np.bitwise_or.reduce(out.reasons))
        assert ((sent >= limits.lower) & (sent <= limits.upper)).all()
        assert (clearances(limits, sent) >= first - 3e-6).all()
    assert seen & Reason.STEP
    assert seen & Reason.NOT_FINITE


@settings(max_examples=30)
@given(st.integers(0, ARMS - 1), SEEDS)
def test_an_arm_outside_its_limits_comes_back_and_never_goes_farther(kind, seed):
    limits, rng = limits_of(kind), np.random.default_rng(seed)
    arm = limits.arm
    sent = rng.uniform(limits.lower - 0.1, limits.upper + 0.1, (4, arm.joints))
    goal, speed = np.clip(sent, limits.lower + 0.05, limits.upper - 0.05), np.zeros_like(sent)
    away = np.abs(sent - np.clip(sent, limits.lower, limits.upper))
    for _ in range(40):
        out = guard(limits, goal, sent, speed, state_of(np.clip(sent, arm.lower - 0.1, arm.upper + 0.1)), 0.05)
        sent, speed = out.command, out.speed
        now = np.abs(sent - np.clip(sent, limits.lower, limits.upper))
        assert (now <= away).all()
        away = now
    stopped = (clearances(limits, sent) < 1e-3).any(axis=-1)  # on the floor, or by a contact
    assert stopped.any() or (sent == goal).all()
    assert (sent == goal)[~stopped].all()


@each_arm
@pytest.mark.parametrize("period", [0.018, 0.03, 0.05])
def test_a_motion_inside_the_limits_passes_bit_for_bit(arm, period):
    limits, plan = GuardLimits.of(arm), plan_excitation(arm, seed=0)
    times = np.arange(0.0, plan.duration, period)
    sent, speed = plan.command(0.0)[None], np.zeros((1, arm.joints))
    for wanted in plan.command(times):
        out = guard(limits, wanted[None], sent, speed, state_of(sent), period)
        np.testing.assert_array_equal(out.command[0], wanted)
        assert out.reasons[0] == 0
        sent, speed = out.command, out.speed


@pytest.mark.parametrize(
    ("arm", "degrees"),
    [
        (so101(), (0, -100, 96, 75, 0)),
        (mycobot280(), (0, -135, 149, -100, 0, 0)),
        (mycobot280(), (0, 130, -149, 60, 0, 0)),
    ],
)
def test_an_arm_that_was_folded_away_comes_out_unhindered(arm, degrees):
    # Capsules overlap there, and the SO-101's TCP lies on the table: as `move` does, straight to rest.
    limits, folded = GuardLimits.of(arm), np.radians(degrees)
    assert (clearances(limits, folded[None]) < 0.0).any()
    sent, speed = folded[None], np.zeros((1, arm.joints))
    steps = int(np.abs(arm.rest - folded).max() / (0.5 * 0.025)) + 1
    for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
        wanted = folded[None] + share * (arm.rest - folded)
        sent, reasons, speed = guard(limits, wanted, sent, speed, state_of(sent), 0.025)
        assert reasons[0] == 0
    np.testing.assert_allclose(sent[0], arm.rest)


@settings(max_examples=40)
@given(st.integers(0, ARMS - 1), SEEDS)
def test_speeds_and_periods_of_one_arm_are_not_those_of_another(kind, seed):
    limits, rng = limits_of(kind), np.random.default_rng(seed)
    case = draw_cases(limits, rng, 5, garbage=0.0)
    quiet = case._replace(state=state_of(case.state.position))
    batch = guard(limits, *quiet)
    for b in range(5):
        rows = slice(b, b + 1)
        alone = guard(
            limits,
            case.command[rows],
            case.sent[rows],
            case.speed[rows],
            state_of(case.state.position[rows]),
            case.period[rows],
        )
        for found, wanted in zip(alone, batch, strict=True):
            np.testing.assert_array_equal(found[0], wanted[b])


def test_the_laws_would_notice():
    # A checker that lets everything pass would prove nothing: spoil one answer after the other.
    limits = limits_of(0)
    rest = np.tile(limits.arm.rest, (1, 1))
    with pytest.raises(AssertionError):
        check_clear(limits, rest, rest + np.radians([0, -135, 0, 0, 0, 0]))
    loose = replace(limits, max_acceleration=np.full(6, np.inf), collisions=False)
    reversal = Case(rest - 0.05, rest, np.full((1, 6), 2.6), state_of(rest), np.full(1, 0.02))
    assert guard(loose, *reversal).reasons[0] == 0
    assert guard(limits, *reversal).reasons[0] == Reason.ACCELERATION
    assert not int(TRIPS) & int(Reason.ACCELERATION | Reason.COLLISION)
