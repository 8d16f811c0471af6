"""Laws of orientations: errors, their derivatives, and postures that turn a tool as wanted."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rejoint.arms import Arm, collides, frames, mycobot280, position_kinematics, so101, solve_position
from rejoint.arms.compiled import missing_turn
from rejoint.arms.inertia import loaded
from rejoint.arms.kinematics import goals_of, task
from rejoint.arms.postures import NEAR, TURNED, find_postures, missed_pose
from rejoint.arms.rotations import (
    WEIGHT,
    Orientation,
    between_directions,
    quaternion_of,
    rotation_of,
    same_side,
    tool_axis,
    turned,
)

ARMS = (mycobot280(), so101())
KINDS = [(arm, whole) for arm in ARMS for whole in (True, False)]


def shown(arm: Arm, q: np.ndarray, whole: bool) -> Orientation:
    """Orientations that postures (B, n) show."""
    rotation = frames(arm, q).tcp_rotation
    count = len(q)
    return Orientation(
        rotation=rotation, whole=np.full(count, whole), weight=np.full(count, WEIGHT), axis=tool_axis(arm)
    )


def postures(arm: Arm, count: int, seed: int) -> np.ndarray:
    drawn = np.random.default_rng(seed).uniform(arm.lower, arm.upper, (20 * count, arm.joints))
    return drawn[~collides(arm, drawn)][:count]


def test_the_tool_points_where_it_stands_off_the_arm():
    np.testing.assert_array_equal(tool_axis(ARMS[0]), [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(tool_axis(ARMS[1]), [1.0, 0.0, 0.0])
    bent = loaded(ARMS[0], None, [0.1, 0.0, 0.0])
    np.testing.assert_array_equal(tool_axis(bent), [0.0, 0.0, 1.0], "a tool that was told turns nothing")


each_kind = pytest.mark.parametrize(("arm", "whole"), KINDS)


@each_kind
def test_where_a_pose_is_reached_both_errors_are_zero(arm, whole):
    q = postures(arm, 40, 1)
    turn, place = shown(arm, q, whole), frames(arm, q).tcp_position
    off, angle = missed_pose(arm, q, place, turn)
    assert off.max() == 0.0
    assert angle.max() < 1e-7
    found = solve_position(arm, place, q + np.random.default_rng(2).uniform(-0.1, 0.1, q.shape), turn=turn).q
    off, angle = missed_pose(arm, found, place, turn)
    assert (np.median(off), np.median(angle)) < (1e-4, 1e-3)


@each_kind
def test_rows_are_the_derivatives_of_the_error(arm, whole):
    q, h = postures(arm, 10, 3), 1e-6
    turn, place = shown(arm, q, whole), frames(arm, q).tcp_position
    jacobian = task(arm, q, place, turn)[1]
    for j in range(arm.joints):
        step = h * np.eye(arm.joints)[j]
        slope = (task(arm, q + step, place, turn)[0] - task(arm, q - step, place, turn)[0]) / (2 * h)
        np.testing.assert_allclose(slope, -jacobian[..., j], atol=1e-7)


@each_kind
def test_the_error_is_the_weighted_turn_that_scipy_finds(arm, whole):
    q, start = postures(arm, 10, 3), postures(arm, 10, 4)
    turn, place, f = shown(arm, q, whole), frames(arm, q).tcp_position, frames(arm, start)
    error = task(arm, start, place, turn)[0]
    np.testing.assert_allclose(error[:, :3], place - f.tcp_position, atol=1e-12)
    between = Rotation.from_matrix(turn.rotation @ np.swapaxes(f.tcp_rotation, -1, -2)).as_rotvec()
    axes = between_directions(f.tcp_rotation @ turn.axis, turn.rotation @ turn.axis)
    np.testing.assert_allclose(error[:, 3:] / WEIGHT, between if whole else axes, atol=1e-10)


@pytest.mark.parametrize("whole", [True, False])
def test_the_error_is_the_angle_of_a_known_turn_up_to_half_of_one(whole):
    arm, q = ARMS[0], postures(ARMS[0], 5, 4)
    turn, own = shown(arm, q, whole), frames(arm, q).tcp_rotation
    across = own @ np.array([1.0, 0.0, 0.0])  # at right angles to the tool
    for angle in (1e-6, 0.3, 2.0, np.pi - 1e-6, np.pi):
        there = turned(angle * across) @ own
        goals, shown_as = goals_of(np.zeros((5, 3)), turn), np.concatenate([there, np.zeros((5, 3, 1))], axis=-1)
        errors = np.stack([missing_turn(goal, frame) for goal, frame in zip(goals, shown_as, strict=True)])
        np.testing.assert_allclose(np.linalg.norm(errors, axis=-1), angle, atol=2e-6)
        np.testing.assert_allclose(turned(errors) @ there @ turn.axis, own @ turn.axis, atol=1e-5)


def test_a_direction_leaves_the_turn_about_the_tool_free_and_no_weight_everything():
    arm, q = ARMS[0], postures(ARMS[0], 6, 5)
    turn, f = shown(arm, q, whole=False), frames(arm, q)
    spun = turned(f.tcp_rotation @ turn.axis) @ f.tcp_rotation
    other, free = replace(turn, rotation=spun), replace(turn, weight=np.zeros(6))
    assert missed_pose(arm, q, f.tcp_position, other)[1].max() < 1e-7
    whole = replace(other, whole=np.ones(6, dtype=bool))
    assert (missed_pose(arm, q, f.tcp_position, whole)[1] > 0.9).all()
    assert np.isnan(missed_pose(arm, q, f.tcp_position, replace(other, weight=np.zeros(6)))[1]).all()
    error, jacobian = task(arm, q, f.tcp_position + 0.01, free)
    assert not error[:, 3:].any()
    assert not jacobian[:, 3:].any()
    np.testing.assert_array_equal(jacobian[:, :3], position_kinematics(arm, q)[1])


def test_both_signs_of_a_quaternion_are_one_orientation():
    quaternions = np.random.default_rng(6).normal(size=(30, 4))
    for one in quaternions:
        np.testing.assert_array_equal(rotation_of(one), rotation_of(-one))
    unit = np.stack([quaternion_of(rotation_of(one)) for one in quaternions])
    flipped = unit * np.random.default_rng(7).choice([-1.0, 1.0], (30, 1))
    np.testing.assert_allclose(same_side(flipped), same_side(unit) * np.sign(flipped[0, 0] / unit[0, 0]))
    assert ((np.diff(same_side(unit), axis=0) ** 2).sum(axis=-1) <= 2.0 + 1e-12).all()


@each_kind
def test_poses_that_an_arm_shows_are_found_from_rest_within_its_limits(arm, whole):
    q = postures(arm, 25, 8)
    turn, place = shown(arm, q, whole), frames(arm, q).tcp_position
    found = find_postures(arm, place, np.broadcast_to(arm.rest, q.shape), turn)
    off, angle = missed_pose(arm, found, place, turn)
    assert ((off < NEAR) & (angle < TURNED)).sum() >= 24
    assert ((found >= arm.lower) & (found <= arm.upper)).all()
    assert collides(arm, found).sum() <= 1


def test_without_an_orientation_postures_are_those_of_points_to_the_bit():
    arm = ARMS[0]
    places = arm.targets.sample(np.random.default_rng(9), (20,))
    start = np.broadcast_to(arm.rest, (20, 6))
    np.testing.assert_array_equal(find_postures(arm, places, start, None), solve_position(arm, places, start).q)
    error, jacobian = task(arm, start, places, None)
    tcp, expected = position_kinematics(arm, start)
    np.testing.assert_array_equal(error, places - tcp)
    np.testing.assert_array_equal(jacobian, expected)
