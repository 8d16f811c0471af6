"""The lens, its derivatives and the poses: against OpenCV, and against finite differences."""

import cv2
import numpy as np
import pytest

from rejoint.arms.camera.board import ON_TOOL
from rejoint.arms.camera.lens import TERMS, Lens, projected
from rejoint.arms.camera.poses import inverse, moved, rotation_vector, turned, turning
from rejoint.arms.camera.sighting import focal_length, homography, place, turn_between
from rejoint.robots.lab.camera.scene import LENS
from rejoint.system.errors import InputError

STRONG = LENS.with_numbers(np.array([1400, 950, 545, -0.2, 0.05, 1e-3, -5e-4]))


def points(seed=0):
    return np.random.default_rng(seed).uniform([-0.2, -0.1, 0.5], [0.2, 0.1, 0.7], (50, 3))


def before_camera(rng, tilt=0.7, away=0.6):
    """Pose of the board on a tool, facing a camera."""
    pose = np.eye(4)
    pose[:3, :3] = turned(rng.uniform(-tilt, tilt, 3))
    pose[:3, 3] = [*rng.uniform(-0.1, 0.1, 2), away] - pose[:3, :3] @ [0.07, 0.05, 0.0]
    return pose


def test_it_projects_as_opencv_does():
    matrix = np.array([[STRONG.f, 0, STRONG.cx], [0, STRONG.f, STRONG.cy], [0, 0, 1]])
    bent = np.array([STRONG.k1, STRONG.k2, STRONG.p1, STRONG.p2])
    expected = cv2.projectPoints(points(), np.zeros(3), np.zeros(3), matrix, bent)[0][:, 0]
    np.testing.assert_allclose(STRONG.project(points()), expected, atol=1e-9)


def test_rays_lead_back():
    np.testing.assert_allclose(STRONG.rays(STRONG.project(points())), points()[:, :2] / points()[:, 2:], atol=1e-8)


def test_derivatives_are_those_of_finite_differences():
    _, by_point, by_terms = projected(STRONG.numbers, points())
    for i, step in enumerate(1e-6 * np.eye(3)):
        finite = (STRONG.project(points() + step) - STRONG.project(points() - step)) / 2e-6
        np.testing.assert_allclose(by_point[..., i], finite, atol=1e-4)
    for i in range(len(TERMS)):
        step = 1e-5 * np.eye(len(TERMS))[i]
        finite = projected(STRONG.numbers + step, points())[0] - projected(STRONG.numbers - step, points())[0]
        np.testing.assert_allclose(by_terms[..., i], finite / 2e-5, atol=1e-4)


def test_poses_turn_and_lead_back():
    rng = np.random.default_rng(1)
    vector = rng.uniform(-1.7, 1.7, (20, 3))  # angles below pi
    np.testing.assert_allclose(rotation_vector(turned(vector)), vector, atol=1e-12)
    np.testing.assert_allclose(rotation_vector(turned(1e-9 * vector)), 1e-9 * vector, rtol=1e-6)
    for i, step in enumerate(1e-6 * np.eye(3)):
        between = turned(vector + step) @ np.swapaxes(turned(vector - step), -1, -2)
        np.testing.assert_allclose(turning(vector)[..., i], rotation_vector(between) / 2e-6, atol=1e-8)
    poses = moved(np.eye(4), rng.normal(size=(5, 6)))
    np.testing.assert_allclose(poses @ inverse(poses), np.tile(np.eye(4), (5, 1, 1)), atol=1e-12)


def test_a_board_is_placed_whichever_way_it_is_tilted():
    rng, corners = np.random.default_rng(2), ON_TOOL.corners
    off = []
    for _ in range(30):
        pose = before_camera(rng)
        pixel = STRONG.project(corners @ pose[:3, :3].T + pose[:3, 3]) + 0.1 * rng.standard_normal((24, 2))
        found = place(STRONG, corners, pixel)
        off.append(found.pose[:3, 3] - pose[:3, 3])
        assert turn_between(found.pose, pose) < np.radians(0.6)
        assert found.rms == pytest.approx(0.1, rel=0.5)
        assert (np.abs(off[-1]) < 4 * np.sqrt(np.diag(found.covariance)[:3])).all()
    assert np.sqrt(np.mean(np.square(off), axis=0)) == pytest.approx([0, 0, 0], abs=5e-4)


def test_corners_on_a_line_and_too_few_are_refused():
    corners = np.stack([np.linspace(0, 0.1, 9), np.zeros(9), np.zeros(9)], axis=-1)
    with pytest.raises(InputError, match="on one line"):
        place(LENS, corners, 900 + 3000 * corners[:, :2])
    with pytest.raises(InputError, match="at least 8"):
        place(LENS, ON_TOOL.corners[:5], np.zeros((5, 2)))


def test_boards_tell_the_focal_length():
    rng, plain = np.random.default_rng(3), Lens(width=1920, height=1080, f=1234.0, cx=0.0, cy=0.0)
    mappings = []
    for _ in range(10):
        pose = before_camera(rng)
        pixel = plain.project(ON_TOOL.corners @ pose[:3, :3].T + pose[:3, 3])
        mappings.append(homography(ON_TOOL.corners[:, :2], pixel))
    assert focal_length(mappings) == pytest.approx(1234.0, rel=1e-6)
