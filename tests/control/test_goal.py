"""Laws of ways that move along ways: where they are, when their time begins, and that arms arrive."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import Box, Motors, gravity_torque, link_inertia, mycobot280, plan, tcp_pose, tcp_position
from rejoint.arms.rotations import Orientation
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.loop import Schedule, run
from rejoint.control.reference import UNKNOWN, TargetSequence, beginning_at, lead, pace, waiting, with_ways
from rejoint.control.robot import turned_off
from rejoint.robots import open_robot
from rejoint.system.errors import InputError
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.family import HELD, ArmFamily, targets_anywhere
from runs.test_connect import a_twin
from standin import now_at

ARM = mycobot280()
POSTURES = np.radians([[100.0, 20.0, -70.0, -20.0, 10.0, 0.0], [-60.0, -30.0, -60.0, 10.0, -20.0, 0.0]])


def test_a_goal_leads_its_target_by_the_lag_of_servos_and_both_end_where_they_are_to_be():
    ways = with_ways(ARM, POSTURES[:1], ARM.rest)
    aim, way = tcp_position(ARM, POSTURES[:1]) + 0.005, ways[0]
    turned = tcp_pose(ARM, POSTURES[None, :1])[..., :3, :3]
    turn = Orientation(rotation=turned, whole=np.full((1, 1), True), weight=np.full((1, 1), 0.1), axis=np.eye(3)[2])
    reference = TargetSequence(ARM, aim[None], ways=[ways], turns=turn)
    reference.begin(np.ones(1, dtype=bool), np.zeros(1, dtype=int), ARM.rest[None], ARM.rest[None])
    arrived = reference.advance(now_at(ARM.rest, since=way.duration))
    end = arrived.goal
    np.testing.assert_allclose(tcp_position(ARM, end), aim, atol=1e-4)
    for share in (0.0, 0.3, 0.9):
        since = np.array([share * way.duration])
        now = reference.advance(now_at(ARM.rest, since=since))
        place = way.at(float(since[0])) + share * (end[0] - way.goal)
        np.testing.assert_allclose(now.target[0], tcp_position(ARM, place), atol=1e-4)
        np.testing.assert_allclose(now.turn.rotation[0], tcp_pose(ARM, place)[:3, :3], atol=1e-3)
        np.testing.assert_array_equal(turned_off(ARM, now), turned_off(ARM, arrived))  # of what is wanted in the end
        np.testing.assert_allclose(now.goal[0], way.at(since[0] + UNKNOWN.delay) + place - way.at(since[0]), atol=1e-9)
        assert now.since_target[0] == 0.0
        assert not now.arrived[0]
    late = reference.advance(now_at(ARM.rest, since=way.duration + 0.5))
    assert late.arrived[0]
    np.testing.assert_array_equal(late.goal, end)
    np.testing.assert_array_equal(late.turn.rotation, turned[0])
    np.testing.assert_allclose(late.since_target, 0.5)


def test_a_servo_follows_a_way_by_the_lead_of_its_own_inverse():
    many, mass, step = np.ones(6), link_inertia(ARM, ARM.rest) + 0.02, 2e-4
    stiffness, damping = 8.0 * many, 0.5 * many
    motors = Motors(9.0 * many, 9.0 * many, damping, 0.0 * many, 0.02 * many, stiffness, 0.02)
    way = plan(ARM, ARM.rest, ARM.rest + np.radians([0.0, 0.0, 0.0, 0.0, 0.0, 60.0]), motors=motors)
    q, speed, worst = way.start.copy(), 0.0 * many, 0.0
    for now in np.arange(0.0, way.duration + 0.5, step):
        sent = max(now - motors.delay, 0.0)
        pull = way.at(sent) + lead(ARM, way, sent, 1.0) - q
        speed = speed + step * (stiffness * pull - damping * speed) / mass
        q, worst = q + step * speed, max(worst, abs(q - way.at(now)).max())
    assert worst < np.radians(1.5)
    np.testing.assert_allclose(q, way.goal, atol=np.radians(0.05))


def test_the_time_of_a_target_begins_at_the_end_of_its_way():
    robot = open_robot("emulated:worn")
    ways = with_ways(ARM, POSTURES, ARM.rest)
    targets = tcp_position(ARM, POSTURES)[None]
    recording = run(robot, FeedforwardController(ARM), TargetSequence(ARM, targets, ways=[ways]), Schedule(dwell=3.0))
    for k, way in enumerate(ways):
        rows = np.flatnonzero(recording.target_index[:, 0] == k)
        since, time = recording.since_target[rows, 0], recording.time[rows, 0] - recording.time[rows[0], 0]
        assert (since[time < way.duration - 0.05] == 0.0).all()
        assert time[-1] - way.duration - 0.5 < since[-1] < time[-1] - way.duration + 0.05  # worn joints lag


def test_an_arm_with_a_slow_joint_stays_on_its_way():
    robot = EmulatedRobot(ARM, [load_wear("healthy", ARM)])
    robot.plant.set_speed_limit(np.array([[0.3, 9.0, 9.0, 9.0, 9.0, 9.0]]))
    goal = ARM.rest + np.radians([90.0, 20.0, -40.0, 30.0, 20.0, 10.0])
    ways = with_ways(ARM, goal[None], ARM.rest)
    reference = TargetSequence(ARM, tcp_position(ARM, goal)[None, None], ways=[ways])
    recording = run(robot, FeedforwardController(ARM), reference, Schedule(dwell=2.0))
    moved, way = recording.position[:, 0] - ARM.rest, goal - ARM.rest
    ahead = np.abs(moved - moved[:, :1] / way[0] * way).max()
    assert ahead < np.radians(15.0)
    assert np.abs(recording.position[-1, 0] - goal).max() < np.radians(3.0)


def test_a_way_waits_the_longer_the_more_a_joint_lags_but_not_for_one_that_is_stuck():
    way = with_ways(ARM, POSTURES[:1], ARM.rest)[0]
    half = 0.5 * way.duration
    lags = np.radians([0.0, 5.0, 9.0, 15.0, 25.0, 40.0])
    position = way.at(half) + np.outer(lags, np.eye(6)[2])
    none = np.zeros((6, 6))
    left_out = waiting(ARM, [way] * 6, np.full(6, half), position, none)
    assert (left_out[:2] == 0.0).all()
    assert (np.diff(left_out[1:5]) > 0.0).all()
    assert left_out[4] < 1.0
    assert left_out[5] == 0.0
    assert (waiting(ARM, [way] * 6, np.full(6, way.duration), position, none) == 0.0).all()


def test_joints_may_lag_less_where_there_is_little_room():
    place, above, lag = tcp_position(ARM, ARM.rest), np.array([0.0, 0.0, 0.1]), np.radians([5.0, 0, 0, 0, 0, 0])
    near = replace(ARM, keep_out=(Box(lower=place - 0.05 + above, upper=place + 0.05 + above),))
    stays = plan(ARM, ARM.rest, ARM.rest)
    assert pace(ARM, stays, 0.0, ARM.rest + lag) == 1.0
    assert pace(near, stays, 0.0, ARM.rest) == 1.0
    assert pace(near, stays, 0.0, ARM.rest + lag) < 0.7
    assert pace(near, stays, 0.0, ARM.rest + lag, -lag) == 1.0


def test_a_way_brakes_before_what_it_comes_nearer_to_and_leaves_at_full_speed():
    down = ARM.rest + np.radians([0.0, -35.0, 0.0, 0.0, 0.0, 0.0])
    there, back = plan(ARM, ARM.rest, down), plan(ARM, down, ARM.rest)
    height = tcp_position(ARM, down)[2]
    table = replace(ARM, keep_out=(Box(lower=np.array([0.05, -1.0, -0.1]), upper=np.array([1.0, 1.0, height - 0.03])),))
    late = 0.7 * there.duration
    free = pace(ARM, there, late, there.at(late))
    assert pace(table, there, late, there.at(late)) < 0.5 * free
    assert pace(ARM, back, there.duration - late, there.at(late)) == 1.0


def test_a_way_stops_at_its_end_or_near_something_while_a_joint_is_stuck():
    way = plan(ARM, ARM.rest, ARM.rest + np.radians([0.0, -35.0, 0.0, 0.0, 0.0, 0.0]))
    half, low = 0.5 * way.duration, np.radians([0.0, 0.0, -40.0, 0.0, 0.0, 0.0])
    tool = tcp_position(ARM, way.goal + low)[2]
    table = replace(ARM, keep_out=(Box(lower=np.array([-1.0, -1.0, -0.5]), upper=np.array([1.0, 1.0, tool + 0.02])),))
    assert pace(ARM, way, half, way.at(half) + low) > 0.1
    assert pace(table, way, half, way.at(half) + low) == 0.0
    late = np.array([0.95 * way.duration])
    assert waiting(ARM, [way], late, way.at(late) + low, np.zeros((1, 6)))[0] == 1.0


def test_an_arm_that_is_off_the_start_of_its_way_gets_another_from_where_it_is():
    way, off = plan(ARM, ARM.rest, POSTURES[0]), ARM.rest + np.radians([0.0, 25.0, 0.0, 0.0, 0.0, 0.0])
    assert beginning_at(ARM, way, ARM.rest + 0.1) is way
    fresh = beginning_at(ARM, way, off)
    np.testing.assert_array_equal([fresh.start, fresh.goal], [off, way.goal])


def test_where_no_way_is_clear_a_joint_goes_round_the_other_side():
    turn = 2.0 * np.pi * np.eye(6)[0]
    left, right = (ARM.rest + side * np.eye(6)[0] for side in (-1.5, 1.5))
    wall = Box(lower=np.array([0.06, -0.02, 0.0]), upper=np.array([1.0, 0.02, 1.0]))
    turning = replace(ARM, lower=ARM.lower - turn, upper=ARM.upper + turn, rest=left, keep_out=(wall,))
    with pytest.raises(InputError):
        plan(turning, left, right)
    ways = with_ways(turning, np.array([right, left]), left)
    np.testing.assert_allclose([way.goal for way in ways], [right - turn, left], atol=1e-9)


def test_targets_anywhere_are_reached_and_held_by_their_postures():
    family, twins = ArmFamily(arms=2, targets=2, seed=3), [a_twin(), a_twin()]
    targets, ways = targets_anywhere(ARM, family, twins)
    postures = np.array([[way.goal for way in row] for row in ways])
    np.testing.assert_allclose(tcp_position(ARM, postures), targets, atol=1e-4)
    assert not ((targets >= ARM.targets.lower) & (targets <= ARM.targets.upper)).all(axis=-1).all()
    limit = twins[0].parameters.torque_limit
    assert (np.abs(gravity_torque(ARM, postures)) <= HELD * limit + 1e-9).all()
