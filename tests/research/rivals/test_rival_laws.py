"""What each gain of the rivals does, alone, and the cost by which they are tuned: worked by hand."""

import dataclasses

import numpy as np
import pytest

from rejoint.arms import gravity_torque, mycobot280, solve_position, tcp_position
from rejoint.control.comparison.protocols import Holds
from rejoint.control.controller import ControlInput
from rejoint.control.feedforward import NOMINAL_STIFFNESS
from rejoint.control.law import dls_step
from rejoint.control.robot import JointState
from rejoint.research.rivals.adaptive import AdaptiveController, AdaptiveGains
from rejoint.research.rivals.catalogue import RIVALS
from rejoint.research.rivals.scheduled import JointSpeed, ScheduledController, ScheduledGains
from rejoint.research.rivals.tuning import TuningSettings, cost

ARM = mycobot280()
TARGET = np.array([[0.18, 0.02, 0.20], [0.2, -0.05, 0.18]])
ALL = np.ones(2, dtype=bool)
SILENT = ScheduledGains(
    far_rate=0.0, near_rate=0.0, schedule=1.0, deadband=0.0, proportional=0.0, damping=0.0, prediction=0.0, moving=1e9,
    speed=1e9, lead=np.radians(15.0),
)  # fmt: skip


def at(position, time=0.0, sent=None, target=TARGET):
    state = JointState(time=np.full(2, time), position=position, age=np.zeros(2))
    sent = position if sent is None else sent
    return ControlInput(state=state, target=target, sent=sent, since_target=np.full(2, time))


def near(distance):
    """Postures whose tool is ``distance`` [m] off the target, too near for the pull to rest."""
    return solve_position(ARM, TARGET + np.array([distance, 0.0, 0.0]), np.tile(ARM.rest, (2, 1))).q


def plain(position, anchored=False, **gains):
    """A law that has just met its targets in a posture."""
    law = ScheduledController(ARM, "x", dataclasses.replace(SILENT, **gains), anchored=anchored)
    law.reset(at(position), ALL)
    return law


def moved(law, before, after, period=0.025):
    """By how much the command moves in a cycle at whose end the arm is found in ``after``."""
    first = law.command(at(before))  # of a length that is assumed
    return law.command(at(after, period)) - first


def test_nothing_is_integrated_inside_the_dead_zone_and_its_edge_is_continuous():
    inside, outside = near(0.9e-3), near(1.5e-3)
    rates = {"near_rate": 4.0, "far_rate": 4.0, "deadband": 1.0e-3}
    np.testing.assert_array_equal(moved(plain(inside, **rates), inside, inside), 0.0)
    step = dls_step(ARM, outside, TARGET)
    distance = np.linalg.norm(step.error, axis=-1, keepdims=True)
    expected = 0.025 * 4.0 * step.step * (distance - 1e-3) / distance
    np.testing.assert_allclose(moved(plain(outside, **rates), outside, outside), expected, atol=1e-12)


def test_the_rate_is_half_way_at_the_distance_of_the_schedule():
    posture = near(5e-3)
    step = dls_step(ARM, posture, TARGET)
    distance = np.linalg.norm(step.error, axis=-1)
    law = plain(posture, near_rate=2.0, far_rate=6.0, schedule=distance[0])
    np.testing.assert_allclose(moved(law, posture, posture)[0], 0.025 * 4.0 * step.step[0], atol=1e-12)


def test_what_is_integrated_is_bounded_in_speed_and_in_lead():
    posture = near(9e-3)
    rates = {"near_rate": 50.0, "far_rate": 50.0}
    slow = moved(plain(posture, **rates, speed=0.1), posture, posture, 0.02)
    np.testing.assert_allclose(np.abs(slow).max(axis=-1), 0.1 * 0.02)  # of the fastest joint
    law = plain(posture, **rates, lead=np.radians(2.0))
    for k in range(1, 200):
        ahead = law.command(at(posture, 0.02 * k)) - posture
    assert np.abs(ahead).max() == pytest.approx(np.radians(2.0)), "the arm does not move, and the command stops"


def test_proportional_and_damping_terms_pass_and_are_not_remembered():
    posture = near(5e-3)
    step = dls_step(ARM, posture, TARGET).step
    law = plain(posture, proportional=0.3)
    for k in (1, 2, 3):
        np.testing.assert_allclose(law.command(at(posture, 0.02 * k)) - posture, 0.3 * step, rtol=1e-9)
    law = plain(posture, damping=0.1)
    law.command(at(posture))
    first = law.command(at(posture + 0.01, 0.02)) - posture
    np.testing.assert_allclose(first, np.full((2, 6), -0.1 * 0.5 * 0.01 / 0.02))  # half of the newest difference
    assert np.abs(law.command(at(posture + 0.01, 0.04)) - posture).max() < np.abs(first).max()


def test_a_joint_that_is_on_its_way_is_not_pushed():
    posture = near(9e-3)
    rates = {"near_rate": 4.0, "far_rate": 4.0, "moving": 0.1}
    there = dls_step(ARM, posture, TARGET).step
    moving = posture + 0.05 * there / np.abs(there).max()  # every joint in its own right direction
    right = np.sign(dls_step(ARM, moving, TARGET).step) == np.sign(there)
    fast = np.abs(moving - posture) * 0.5 / 0.02 > 0.1
    pushed = moved(plain(posture, **rates), posture, moving, 0.02)
    assert (right & fast).any()
    np.testing.assert_array_equal(pushed[right & fast], 0.0)
    assert (pushed[~right & fast] != 0.0).all()


def test_a_share_of_what_was_learned_goes_on_to_the_next_target():
    posture, later = near(5e-3), TARGET + np.array([0.0, 0.002, 0.0])
    after = {}
    for carry in (0.0, 1.0):
        law = plain(posture, anchored=True, near_rate=4.0, far_rate=4.0, carry=carry)
        for k in range(1, 20):
            sent = law.command(at(posture, 0.02 * k))
        law.reset(at(posture, 0.4, sent, later), ALL)
        goal = solve_position(ARM, later, posture).q
        silent = dataclasses.replace(at(posture, 0.4, sent, later), since_target=np.full(2, 100.0))
        after[carry] = np.linalg.norm(tcp_position(ARM, law.command(silent)) - tcp_position(ARM, goal), axis=-1)
    assert (after[0.0] < 2e-3).all(), "without it the command is the goal, but for one cycle"
    assert (after[1.0] > 2 * after[0.0]).all()


def test_the_raised_posture_is_approached_along_a_ramp():
    start = np.tile(ARM.rest, (2, 1))
    law = plain(start, anchored=True, ramp=0.5, feedforward=1.0)
    goal = solve_position(ARM, TARGET, start).q
    way = goal + gravity_torque(ARM, goal) / NOMINAL_STIFFNESS - start
    np.testing.assert_allclose(law.command(at(start, 0.2)) - start, np.clip(way, -0.1, 0.1), atol=1e-12)
    assert (np.abs(way) > 0.1).any()


def test_speeds_are_smoothed_over_two_cycles():
    speed, period = JointSpeed(), np.full((1, 1), 0.02)
    assert speed.observe(np.zeros((1, 2)), 0 * period).tolist() == [[0.0, 0.0]]
    found = [speed.observe(np.array([[0.02 * k, 0.0]]), period)[0, 0] for k in range(1, 6)]
    assert found == pytest.approx([0.5, 0.75, 0.875, 0.9375, 0.96875])  # of 1 rad/s
    same = speed.observe(np.array([[9.0, 0.0]]), 0 * period)
    assert same[0, 0] == pytest.approx(0.96875), "no time has passed, so nothing is known of a speed"


ADAPTIVE = AdaptiveGains(
    softness_rate=20.0, load_rate=5.0, offset_rate=3.0, scale=1.0, damping=0.0, dead_zone=np.radians(0.5),
    proportional=0.0, derivative=0.0, prior=0.7,
)  # fmt: skip


def test_the_adaptive_law_begins_with_its_prior_and_learns_nothing_inside_its_dead_zone():
    start = np.tile(ARM.rest, (2, 1))
    goal = solve_position(ARM, TARGET, start).q
    law = AdaptiveController(ARM, "adaptive", ADAPTIVE)
    law.reset(at(start), ALL)
    raised = goal + 0.7 * gravity_torque(ARM, goal) / NOMINAL_STIFFNESS
    np.testing.assert_allclose(law.command(at(goal)), raised)
    for k in range(1, 50):
        np.testing.assert_allclose(law.command(at(goal + np.radians(0.4), 0.02 * k)), raised)
    for k in range(50, 60):
        last = law.command(at(goal - np.radians(2.0), 0.02 * k))
    assert (last > raised + 1e-3).all(), "every joint that is below its goal is raised"


def test_the_cost_is_the_time_to_stay_and_the_settled_error():
    settings = TuningSettings(hold=3.0, settled_weight=2.0, settled_cap=0.010)
    stay = np.array([[1.0, np.inf, np.nan, 2.0]])
    settled = np.array([[0.5e-3, 4e-3, np.nan, 50e-3]])
    none = np.full((1, 4, 3), np.nan)
    holds = Holds(
        settled=settled,
        settled_true=settled,
        oscillation=settled,
        stay=stay[None],
        away=none,
        away_true=none,
        modelled=np.full((3, 1, 4), np.nan),
        turned=none,
    )
    # late + 2 s/mm: 1 + 1; never within 3 s and 4 mm; stopped: the worst of both; 50 mm count as 10
    np.testing.assert_allclose(cost(holds, settings), [[2.0, 11.0, 23.0, 22.0]])


@pytest.mark.parametrize("name", list(RIVALS))
def test_gains_of_the_catalogue_lie_within_their_bounds(name):
    rival = RIVALS[name]
    assert set(rival.gains) == set(rival.intervals)
    for gain, value in rival.gains.items():
        low, high = rival.intervals[gain]
        assert 0.0 < low < value < high, gain
