"""Planned ways: exact ends, limits of speed, acceleration and jerk, and no contact in MuJoCo's own check."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from benchmarks.postures import GROWN, TOUCH, Judge

from rejoint.arms import (
    Arm,
    Array,
    Box,
    Motors,
    choose_postures,
    gravity_torque,
    load_arm,
    mycobot280,
    so101,
    tcp_position,
)
from rejoint.arms.collision import clearances, clearances_of
from rejoint.arms.planning import SLOWEST, JointTrajectory, plan
from rejoint.arms.postures import body_of, comfortable_postures
from rejoint.control.guard import GuardLimits, guard
from rejoint.control.robot import JointState

BOXES = (
    Box(lower=np.array([0.15, -0.05, 0.0]), upper=np.array([0.2, 0.05, 0.15])),
    Box(lower=np.array([-0.1, 0.15, 0.0]), upper=np.array([0.05, 0.2, 0.3])),
    Box(lower=np.array([-0.25, -0.2, 0.0]), upper=np.array([-0.15, -0.1, 0.35])),
)


@cache
def boxed(name: str) -> Arm:
    return replace(load_arm(name), keep_out=BOXES)


@cache
def postures(name: str) -> Array:
    """Postures with room for the judge's capsules."""
    arm, rng = boxed(name), np.random.default_rng(0)
    drawn = rng.uniform(arm.lower + 0.01, arm.upper - 0.01, (4000, arm.joints))
    clear = clearances_of(arm, body_of(arm).shape, drawn)
    return drawn[(clear[:, : arm.joints] > 0.001).all(axis=1) & (clear[:, arm.joints :] > 2.1 * GROWN).all(axis=1)]


def planned(name: str, count: int) -> list[JointTrajectory]:
    rng, found = np.random.default_rng(1), []
    for _ in range(count):
        start, goal = postures(name)[rng.integers(len(postures(name)), size=2)]
        found.append(plan(boxed(name), start, goal))
        np.testing.assert_array_equal(found[-1].at(np.array([0.0, found[-1].duration])), [start, goal])
    return found


each_name = pytest.mark.parametrize("name", ["mycobot280", "so101"])


@each_name
def test_no_planned_way_touches_in_mujoco(name):
    ways, judge = planned(name, 100), Judge(boxed(name))
    assert sum(len(way.moves) > 1 for way in ways) > 5
    straight = [np.linspace(way.start, way.goal, 60) for way in ways if len(way.moves) > 1]
    assert sum((judge.distances(way) < 0.02).any() for way in straight) > 0.9 * len(straight)
    for way in ways:
        found = judge.nearest(way.at(np.linspace(0.0, way.duration, 60)))
        assert (found > -TOUCH).all()
        np.testing.assert_allclose(*np.maximum(found, 0.0), atol=1e-6)


@each_name
def test_chosen_postures_leave_room_for_the_judge(name):
    arm = boxed(name)
    places = tcp_position(arm, postures(name)[:60]) + np.random.default_rng(3).uniform(-0.05, 0.05, (60, 3))
    goals = choose_postures(arm, places, arm.rest, thorough=False)
    taken = goals.q[[not refusal for refusal in goals.refusals]]
    assert len(taken) > 30
    assert (Judge(arm).distances(taken) > -TOUCH).all()


@each_name
def test_speed_acceleration_and_jerk_keep_their_limits(name):
    arm = boxed(name)
    acceleration = np.minimum(arm.max_speed / 0.1, arm.servo_acceleration)
    for way in planned(name, 20):
        step = 1e-3
        q = way.at(np.arange(-0.01, way.duration + 0.01, step))
        for order, limit in ((1, arm.max_speed), (2, acceleration), (3, acceleration / 0.05)):
            found = np.abs(np.diff(q, order, axis=0)).max(axis=0) / step**order
            assert (found <= limit * 1.001).all()
        np.testing.assert_allclose(np.diff(q, axis=0)[:9], 0.0, atol=1e-12)
        middle = way.at(np.array([0.3, 0.3 + 1e-6]) * way.duration)
        np.testing.assert_allclose(
            np.diff(middle, axis=0)[0] / (1e-6 * way.duration), way.at(0.3 * way.duration, 1), atol=1e-3
        )


@each_name
def test_the_guard_shortens_no_planned_way(name):
    arm = boxed(name)
    limits = GuardLimits.of(arm)
    for way in planned(name, 20):
        commands = way.at(np.arange(0.0, way.duration + 0.05, 0.025))
        sent, speed = commands[:1], np.zeros((1, arm.joints))
        for command in commands[1:, None]:
            state = JointState(time=np.zeros(1), position=sent, age=np.zeros(1))
            answer = guard(limits, command, sent, speed, state, 0.025)
            assert not answer.reasons.any()
            sent, speed = answer.command, answer.speed


def test_a_straight_way_is_straight_and_as_fast_as_its_limits_allow():
    arm = mycobot280()
    goal = arm.rest + np.radians([40.0, 5, -10, 0, 20, 0])
    way = plan(arm, arm.rest, goal)
    q = way.at(np.linspace(0.0, way.duration, 50)) - arm.rest
    np.testing.assert_allclose(q, q[:, :1] / (goal - arm.rest)[0] * (goal - arm.rest), atol=1e-12)
    assert way.duration == pytest.approx(np.radians(40) / arm.max_speed[0] + 0.15, rel=0.01)
    assert plan(replace(arm, max_speed=0.5 * arm.max_speed), arm.rest, goal).duration > 1.5 * way.duration
    assert plan(arm, arm.rest, arm.rest).duration == 0.0


def test_the_same_seed_gives_the_same_detour():
    arm = boxed("mycobot280")
    way = next(way for way in planned("mycobot280", 30) if len(way.moves) > 1)
    again = plan(arm, way.start, way.goal)
    np.testing.assert_array_equal(again.moves, way.moves)


def test_a_way_avoids_what_the_motors_do_not_lift():
    arm, rng = mycobot280(), np.random.default_rng(4)
    free = comfortable_postures(arm)
    usable = np.array([9.0, 0.5, 9.0, 9.0, 9.0, 9.0])
    light = free[(np.abs(gravity_torque(arm, free)) < 0.9 * usable).all(axis=1)]
    pairs = light[rng.integers(len(light), size=(1000, 2))]
    lines = pairs[:, :1] + np.linspace(0.0, 1.0, 80)[:, None] * np.diff(pairs, axis=1)
    straight = (np.abs(gravity_torque(arm, lines)) / usable).max(axis=(1, 2))
    heavy, driven = np.flatnonzero(straight > 1.0)[:20], []
    for start, goal in pairs[heavy]:
        way = plan(arm, start, goal, motors=Motors(usable, usable))
        along = way.at(np.linspace(0.0, way.duration, 80))
        driven.append((np.abs(gravity_torque(arm, along)) / usable).max())
    assert len(driven) == 20
    assert (np.array(driven) > 1.06).sum() < 4  # a shorter way may be a little heavier
    assert (np.array(driven) <= straight[heavy] + 0.01).all()


def test_a_joint_that_holds_more_than_it_lifts_is_lightened_before_it_lifts():
    arm, rng = mycobot280(), np.random.default_rng(4)
    free = comfortable_postures(arm)
    motors = Motors(np.full(6, 9.0), np.array([9.0, 0.5, 9.0, 9.0, 9.0, 9.0]))
    load = np.abs(gravity_torque(arm, free)[:, 1])
    lifted = []
    for _ in range(30):
        start, goal = free[rng.choice(np.flatnonzero(load > 0.6))], free[rng.choice(np.flatnonzero(load < 0.2))]
        way = plan(arm, start, goal, motors=motors)
        ways = np.linspace(start, goal, 80), way.at(np.linspace(0.0, way.duration, 80))
        lifted.append([np.max(gravity_torque(arm, q[1:])[:, 1] * np.sign(np.diff(q[:, 1]).round(9))) for q in ways])
    straight, driven = np.array(lifted).T
    assert (driven <= np.maximum(straight, 0.5) + 0.02).all()
    assert (driven > 0.55).sum() < 0.5 * (straight > 0.55).sum()


@pytest.mark.parametrize("by_lead", [False, True])
def test_a_way_asks_no_joint_for_more_speed_than_its_motor_and_its_command_have_left(by_lead):
    arm, rng = mycobot280(), np.random.default_rng(5)
    free = comfortable_postures(arm)
    motors = Motors(np.full(6, 1.5), np.full(6, 1.2), back_emf=np.full(6, 0.8))
    if by_lead:  # torques are no limit, but commands that may lead by 15 degrees do not ask for more
        stiffness = motors.limit / np.radians(15.0)
        asked = Motors(np.full(6, 9.0), motors.usable, damping=motors.back_emf, stiffness=stiffness)
    else:
        asked = motors
    slower = []
    for start, goal in free[rng.integers(len(free), size=(40, 2))]:
        way, usual = plan(arm, start, goal, motors=asked), plan(arm, start, goal)
        time = np.linspace(0.0, way.duration, 200)
        torque, speed = gravity_torque(arm, way.at(time)), way.at(time, 1)
        left = motors.limit - np.where(torque * speed > 1e-9, np.abs(torque), 0.0).max(axis=0)
        most = np.maximum(left / motors.back_emf, SLOWEST * arm.max_speed)
        assert (np.abs(speed) <= 1.05 * most).all()  # the torque is looked at in some places
        slower.append(way.duration / usual.duration)
    assert min(slower) >= 1.0
    assert np.median(slower) > 1.2


def test_an_arm_that_touches_something_gets_out_of_it():
    arm = mycobot280()
    start = np.radians([0.0, 0, 150, -150, 0, 0])
    assert clearances(arm, start).min(axis=-1) < 0.0
    way = plan(arm, start, arm.rest)
    distances = clearances_of(arm, body_of(arm).shape, way.at(np.linspace(0.0, way.duration, 300)))
    least = np.minimum(distances[0], 0.0)
    for row in distances[1:]:
        assert (row >= least - 1e-7).all()
        least = np.minimum(np.maximum(least, row), 0.0)


def test_clearance_is_the_smallest_distance():
    arm = so101()
    q = postures("so101")[:20]
    found = clearances(arm, q).min(axis=-1)
    assert found.shape == (20,)
    assert clearances(arm, q[3]).min(axis=-1) == found[3]
    assert (found >= clearances(boxed("so101"), q).min(axis=-1)).all()
