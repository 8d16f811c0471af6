"""Laws of paths: they go through their points smoothly, and what an arm cannot do is refused before it moves."""

import numpy as np
import pytest

import orientations
from rejoint.arms import mycobot280, tcp_position
from rejoint.arms.postures import missed_pose
from rejoint.control.moving.reference import (
    Path,
    read_path,
    standard_path,
)
from rejoint.control.moving.tracker import PathPostures
from rejoint.control.targets import Pose, placed
from rejoint.system.errors import InputError

ARM = mycobot280()


def bent():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.1, 0.6, 9))
    return Path(time=time, place=rng.uniform(ARM.targets.lower, ARM.targets.upper, (9, 3)))


def test_a_path_goes_through_its_points_from_time_zero_and_stands_still_outside():
    path = bent()
    assert path.time[0] == 0.0
    assert np.allclose(path.at(path.time), path.place, atol=1e-12)
    assert np.allclose(path.at([-1.0, path.duration + 1.0]), path.place[[0, -1]], atol=1e-15)


def test_a_path_is_smooth_through_its_points():
    path, h = bent(), 1e-6
    knots = path.time[1:-1]
    before, after = (path.at(knots) - path.at(knots - h)) / h, (path.at(knots + h) - path.at(knots)) / h
    assert np.allclose(before, after, atol=1e-4)


def test_a_parabola_is_reproduced_exactly():
    time = np.array([0.0, 0.2, 0.5, 0.6, 1.1])
    curve = lambda t: np.stack([0.2 + 0.1 * t, 0.05 * t**2, 0.2 - 0.03 * t**2], axis=-1)  # noqa: E731
    between = np.linspace(0.0, 1.1, 50)
    assert np.allclose(Path(time=time, place=curve(time)).at(between), curve(between), atol=1e-12)


@pytest.mark.parametrize(
    ("time", "place", "words"),
    [
        ([0.0, 1.0, 1.0], np.zeros((3, 3)), "time 1 s of point 3 is not after 1 s"),
        ([0.0, 1.0], [[0.2, 0.0, np.nan], [0.2, 0.0, 0.2]], "nan"),
        ([0.0, 1.0], [[180, 0, 200], [190, 0, 200]], "millimetres"),
        ([0.0], np.zeros((1, 3)), "T > 1"),
    ],
)
def test_what_is_no_path_is_refused(time, place, words):
    with pytest.raises(InputError, match=words):
        Path(time=np.array(time), place=np.array(place))


def way(*millimetres, end=2.0):
    return Path(time=np.linspace(0.0, end, len(millimetres)), place=1e-3 * np.array(millimetres))


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (
            way([180, 0, 200], [600, 0, 200], [180, 0, 200], end=4.0),
            r"at [12]\.\d\d s: \([\d., ]+\) mm out of reach by",
        ),
        (
            way([180, 0, 100], [180, 0, 10], [180, 0, 100], end=4.0),
            r"at \d\.\d\d s: .* mm in collision: the tool would touch the ground",
        ),
        (way([0.18, 0, 0.2], [0.19, 0, 0.2]), "they look like metres, and millimetres are expected"),
        (way([180, 0, 200], [190, 0, 200], end=5500.0), r"takes 5500 s, 0\.1 to 3600 s were expected; give times in"),
        (way([180, 0, 200], [180, 0, 200], end=1e-9), r"takes 1e-09 s, 0\.1 to 3600 s were expected"),
        (standard_path("circle-0.5s", ARM), r"at \d+\.\d\d s: .* joint\d would have to turn at \d+ deg/s, 120 at most"),
    ],
)
def test_out_of_reach_and_too_fast_are_refused_with_where(path, words):
    with pytest.raises(InputError, match=words):
        path.home(ARM)


def test_postures_reach_their_places_and_depend_on_nothing_else():
    path = standard_path("random-0.5hz", ARM, seed=3)
    places = path.at(np.arange(0.0, path.duration, 0.05))[:, None]
    there = PathPostures(ARM, places[0]).along(places)
    assert np.linalg.norm(tcp_position(ARM, there[:, 0]) - places[:, 0], axis=-1).max() < 1e-5
    back = PathPostures(ARM, places[-1]).along(places[::-1])[::-1]
    assert np.abs(there - back).max() < 1e-3


def test_a_path_turns_the_tool_smoothly_through_what_is_given(tmp_path):
    time = np.linspace(0.0, 4.0, 9)
    place = np.array([0.18, 0.0, 0.2]) + 0.02 * np.sin(time)[:, None] * np.array([0.0, 1.0, 0.5])
    angles = [[180.0 - 8.0 * np.sin(t), 5.0 * np.sin(2 * t), -90.0 + 6.0 * t] for t in time]
    file = tmp_path / "poses.csv"
    lines = [",".join(map(str, [t, *1e3 * p, *a])) for t, p, a in zip(time, place, angles, strict=True)]
    file.write_text("\n".join(["time,x,y,z,rx,ry,rz", *lines]))
    path = read_path(file, ARM)
    wanted = placed(ARM, [Pose(place_m=p, angles_rad=np.radians(a)) for p, a in zip(place, angles, strict=True)])[1]
    assert orientations.angles(wanted, path.poses(time)[1].rotation).max() < 1e-6
    fine = np.linspace(0.0, 4.0, 400)
    ways = orientations.angles(path.poses(fine[1:])[1], path.poses(fine[:-1])[1].rotation) / np.diff(fine)
    assert ways.max() < np.radians(30.0)
    path.home(ARM)
    postures = PathPostures(ARM, path.at(fine[:1]), path.poses(fine[:1])[1])
    found = postures.along(path.at(fine)[:, None], path.poses(fine)[1][:, None])[:, 0]
    off, angle = missed_pose(ARM, found, path.at(fine), path.poses(fine)[1])
    assert (off.max(), angle.max()) < (1e-4, np.radians(0.1))
    back = Path(time=path.time, place=path.place, turn=path.poses(path.time)[1])
    np.testing.assert_allclose(back.poses(fine)[1].rotation, path.poses(fine)[1].rotation, atol=1e-9)
