"""Inverse kinematics: what it promises about limits, targets and least squares."""

import numpy as np

from rejoint.arms import dls, mycobot280, position_kinematics, solve_position, tcp_position
from rejoint.arms.kinematics import tcp_pose
from rejoint.arms.rotations import Orientation, rotation_error, tool_axis

ARM = mycobot280()


def test_dls_equals_the_papers_form() -> None:
    q = np.random.default_rng(1).uniform(ARM.lower, ARM.upper, (30, 6))
    j, e = position_kinematics(ARM, q)[1], np.random.default_rng(2).normal(size=(30, 3))
    paper = [np.linalg.solve(a.T @ a + 0.05**2 * np.eye(6), a.T @ b) for a, b in zip(j, e, strict=True)]
    np.testing.assert_allclose(dls(j, e), paper, rtol=1e-9)


def test_the_whole_target_box_is_reachable() -> None:
    axes = [np.linspace(low, high, 7) for low, high in zip(ARM.targets.lower, ARM.targets.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    solution = solve_position(ARM, grid, ARM.rest)
    assert solution.converged.all()
    np.testing.assert_allclose(tcp_position(ARM, solution.q), grid, atol=2e-5)
    assert ((solution.q >= ARM.lower) & (solution.q <= ARM.upper)).all()


def test_full_pose_finds_the_pose_of_a_nearby_posture() -> None:
    rng = np.random.default_rng(3)
    wanted = ARM.rest + rng.uniform(-0.4, 0.4, (50, 6))
    pose = tcp_pose(ARM, wanted)
    turn = Orientation(rotation=pose[:, :3, :3], whole=np.ones(50, bool), weight=np.ones(50), axis=tool_axis(ARM))
    solution = solve_position(ARM, pose[:, :3, 3], ARM.rest, turn=turn)
    assert solution.converged.mean() > 0.95
    found = tcp_pose(ARM, solution.q[solution.converged])
    np.testing.assert_allclose(found, pose[solution.converged], atol=3e-5)


def test_an_unreachable_target_is_reported_and_kept_inside_limits() -> None:
    solution = solve_position(ARM, np.array([1.0, 0.0, 0.2]), ARM.rest)
    assert not solution.converged
    assert solution.error > 0.5
    assert ((solution.q >= ARM.lower) & (solution.q <= ARM.upper)).all()


def test_the_null_space_does_not_drift_over_many_targets() -> None:
    targets = ARM.targets.sample(np.random.default_rng(4), (300,))
    q = ARM.rest
    for target in targets:
        q = solve_position(ARM, target, q).q
    straight = solve_position(ARM, targets[-1], ARM.rest).q
    assert np.abs(q - straight).max() < np.radians(20)


def test_rotation_error_of_a_known_turn() -> None:
    c, s = np.cos(0.3), np.sin(0.3)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(rotation_error(np.eye(3), turned), [0, 0, 0.3], atol=1e-12)
    np.testing.assert_allclose(rotation_error(turned, turned), [0, 0, 0], atol=1e-12)
