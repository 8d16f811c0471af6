"""The reference: ramps, interpolated paths, queue; straight lines of the tool."""

import numpy as np

from rejoint.arms import mycobot280, tcp_pose
from rejoint.robots.mycobot.motion import ACCELERATION, CARTESIAN_SPEED, FULL_SPEED, Motion, joint_path, line_path

ARM = mycobot280()


def motion(start=(0.0, 0.0)):
    return Motion(np.array(start))


def run(m, duration, step=0.01):
    """Advance and return the references (k, n)."""
    seen = [m.reference.copy()]
    for _ in range(round(duration / step)):
        m.advance(step)
        seen.append(m.reference.copy())
    return np.array(seen)


def test_a_ramp_moves_each_joint_at_its_own_set_speed():
    m = motion()
    m.ramp(np.array([1.0, -0.1]), 0.5)
    m.advance(0.2)
    np.testing.assert_allclose(m.reference, [0.1 * FULL_SPEED, -0.1])
    run(m, 1.0)
    np.testing.assert_array_equal(m.reference, [1.0, -0.1])
    assert not m.moving


def test_joints_on_a_path_arrive_together_within_speed_and_acceleration():
    m = motion()
    m.enqueue(joint_path(m.reference, np.array([1.0, -0.5])), 1.0)
    seen = run(m, 2.0)
    np.testing.assert_allclose(seen[:, 1], -0.5 * seen[:, 0], atol=1e-9)
    speed = np.diff(seen[:, 0]) / 0.01
    assert speed.max() <= FULL_SPEED + 1e-9
    change, last = np.abs(np.diff(speed)), np.flatnonzero(speed)[-1]
    assert change[:last].max() <= ACCELERATION * 0.01 + 1e-6
    assert change[last] <= 1.1 * ACCELERATION * 0.01  # a path ends within a step
    np.testing.assert_array_equal(seen[-1], [1.0, -0.5])
    assert not m.moving


def test_a_queue_passes_every_waypoint_in_order():
    m = motion()
    stops = [np.array([1.0, 0.0]), np.array([1.0, 1.0]), np.array([-1.0, 0.0])]
    for stop in stops:
        assert m.enqueue(joint_path(m.end, stop), 1.0)
    assert len(m.queue) == 2
    seen = run(m, 8.0)
    reached = [int(np.argmax(np.abs(seen - stop).max(axis=1) < 1e-9)) for stop in stops]
    assert 0 < reached[0] < reached[1] < reached[2]
    assert not m.moving


START = np.radians([20.0, 0.0, -85.0, -5.0, 0.0, 0.0])


def test_a_line_is_straight_and_keeps_to_the_tool_speed():
    goal = tcp_pose(ARM, START)
    goal[:3, 3] += [0.0, 0.06, -0.03]
    path, complete = line_path(ARM, START, goal)
    assert complete
    tips = tcp_pose(ARM, path.points)[:, :3, 3]
    way = goal[:3, 3] - tips[0]
    along = (tips - tips[0]) @ way / np.linalg.norm(way)
    off = np.linalg.norm(tips - tips[0] - along[:, None] * way / np.linalg.norm(way), axis=1)
    assert off.max() < 5e-4
    np.testing.assert_allclose(tips[-1], goal[:3, 3], atol=5e-4)
    assert path.duration >= np.linalg.norm(way) / CARTESIAN_SPEED - 1e-9
