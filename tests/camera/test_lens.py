"""The lens, its derivatives and the poses, against finite differences."""

import numpy as np
import pytest
from camera_scenes import facing

from rejoint.arms.rotations import difference, inverse, moved, pose_of, rotation_error, turned
from rejoint.camera.board import ON_TOOL, BoardView
from rejoint.camera.rig import TERMS, place
from rejoint_lab.cameras import LENS

STRONG = LENS.with_numbers(np.array([1400, 950, 545, -0.2, 0.05, 1e-3, -5e-4]))


def points():
    return np.random.default_rng(0).uniform([-0.2, -0.1, 0.5], [0.2, 0.1, 0.7], (50, 3))


def test_derivatives_are_those_of_finite_differences():
    lever, place = points() - [0.0, 0.0, 0.6], np.array([0.0, 0.0, 0.6])
    _, by_pose, by_terms = STRONG.slopes(lever, pose_of(np.eye(3), place))
    for i, step in enumerate(1e-6 * np.eye(6)):
        ends = [lever @ turned(sign * step[3:]).T + place + sign * step[:3] for sign in (1.0, -1.0)]
        finite = (STRONG.project(ends[0]) - STRONG.project(ends[1])) / 2e-6
        np.testing.assert_allclose(by_pose[:, i], finite.ravel(), atol=1e-3)
    for i, step in enumerate(1e-5 * np.eye(len(TERMS))):
        ends = [STRONG.with_numbers(STRONG.numbers + sign * step).project(points()) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(by_terms[:, i], ((ends[0] - ends[1]) / 2e-5).ravel(), atol=1e-3)


def test_poses_turn_and_lead_back():
    rng = np.random.default_rng(1)
    vector = rng.uniform(-1.7, 1.7, (20, 3))  # angles below pi
    np.testing.assert_allclose(rotation_error(np.eye(3), turned(vector)), vector, atol=1e-12)
    poses, change = moved(np.eye(4), rng.normal(size=(5, 6))), 0.1 * rng.normal(size=(5, 6))
    np.testing.assert_allclose(poses @ inverse(poses), np.tile(np.eye(4), (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(difference(moved(poses, change), poses), change, atol=1e-12)


def test_a_board_is_placed_whichever_way_it_is_tilted():
    rng, corners = np.random.default_rng(2), ON_TOOL.corners
    off = []
    for _ in range(30):
        pose = facing(rng, tilt=0.7, aside=0.1)
        pixel = STRONG.project(corners @ pose[:3, :3].T + pose[:3, 3]) + 0.1 * rng.standard_normal((24, 2))
        found = place(STRONG, ON_TOOL, BoardView(name="seen", number=np.arange(24), pixel=pixel))
        off.append(found.pose[:3, 3] - pose[:3, 3])
        assert np.linalg.norm(difference(found.pose, pose)[3:]) < np.radians(0.6)
        assert found.rms == pytest.approx(0.1, rel=0.5)
        assert (np.abs(off[-1]) < 4 * np.sqrt(np.diag(found.covariance)[:3])).all()
    assert np.sqrt(np.mean(np.square(off), axis=0)) == pytest.approx([0, 0, 0], abs=5e-4)
