"""Laws of paths: they go through their points smoothly, and what an arm cannot do is refused before it moves."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import mycobot280, position_kinematics, tcp_position
from rejoint.arms.posing import missed_pose
from rejoint.control.moving.path import Path, path_of, read_path
from rejoint.control.moving.posture import PathPostures, joint_weights, spread
from rejoint.control.moving.standard import EASE, RADIUS, STANDARD, is_standard, standard_path
from rejoint.control.poses import Pose, placed
from rejoint.system.errors import FileError, InputError

ARM = mycobot280()


def bent(count=9, seed=0):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.1, 0.6, count))
    return Path(time=time, place=rng.uniform(ARM.targets.lower, ARM.targets.upper, (count, 3)))


def test_a_path_goes_through_its_points_from_time_zero_and_stands_still_outside():
    path = bent()
    assert path.time[0] == 0.0
    assert np.allclose(path.at(path.time), path.place, atol=1e-12)
    assert np.allclose(path.at([-1.0, path.duration + 1.0]), path.place[[0, -1]], atol=1e-15)
    assert not path.velocity(np.array([-1.0, path.duration + 1.0])).any()


def test_velocity_and_acceleration_are_derivatives_and_continuous():
    path, h = bent(), 1e-5
    time = np.linspace(0.01, path.duration - 0.01, 97)
    assert np.allclose(path.velocity(time), (path.at(time + h) - path.at(time - h)) / (2 * h), atol=1e-6)
    slope = (path.velocity(time + h) - path.velocity(time - h)) / (2 * h)
    assert np.allclose(path.acceleration(time), slope, atol=1e-3)
    knots, tiny = path.time[1:-1], 1e-9
    assert np.allclose(path.acceleration(knots - tiny), path.acceleration(knots + tiny), atol=1e-4)


def test_a_parabola_is_reproduced_exactly():
    time = np.array([0.0, 0.2, 0.5, 0.6, 1.1])
    curve = lambda t: np.stack([0.2 + 0.1 * t, 0.05 * t**2, 0.2 - 0.03 * t**2], axis=-1)  # noqa: E731
    between = np.linspace(0.0, 1.1, 50)
    assert np.allclose(Path(time=time, place=curve(time)).at(between), curve(between), atol=1e-12)


@pytest.mark.parametrize(
    ("time", "place", "words"),
    [
        ([0.0, 1.0, 1.0], np.zeros((3, 3)), "time 1 s of point 3 is not after 1 s"),
        ([0.0, 1.0], [[0.2, 0.0, np.nan], [0.2, 0.0, 0.2]], "no finite numbers"),
        ([0.0], np.zeros((1, 3)), "T > 1"),
    ],
)
def test_what_is_no_path_is_refused(time, place, words):
    with pytest.raises(InputError, match=words):
        Path(time=np.array(time), place=np.array(place))


def test_out_of_reach_and_too_fast_are_refused_with_where():
    far = Path(time=np.array([0.0, 2.0, 4.0]), place=np.array([[0.18, 0, 0.2], [0.6, 0, 0.2], [0.18, 0, 0.2]]))
    with pytest.raises(InputError, match=r"at 1\.98 s \(600, .* is out of reach, \d+ mm too far"):
        far.require_followable(ARM)
    low = Path(time=np.array([0.0, 2.0, 4.0]), place=np.array([[0.18, 0, 0.1], [0.18, 0, 0.01], [0.18, 0, 0.1]]))
    with pytest.raises(
        InputError, match=r"at \d\.\d\d s \(180, 0, 10\) mm is lower than 20 mm, where the guard keeps the tool"
    ):
        low.require_followable(ARM)
    metres = Path(time=np.array([0.0, 2.0]), place=np.array([[0.18e-3, 0, 0.2e-3], [0.19e-3, 0, 0.2e-3]]))
    with pytest.raises(InputError, match="they look like metres, and millimetres are expected"):
        metres.require_followable(ARM)
    milliseconds = Path(time=np.array([0.0, 5500.0]), place=np.array([[0.18, 0, 0.2], [0.19, 0, 0.2]]))
    with pytest.raises(InputError, match=r"takes 5500 s, 0\.1 to 3600 s were expected; give times in"):
        milliseconds.require_followable(ARM)
    no_time = Path(time=np.array([0.0, 1e-9]), place=np.array([[0.18, 0, 0.2], [0.18, 0, 0.2]]))
    with pytest.raises(InputError, match=r"takes 1e-09 s, 0\.1 to 3600 s were expected"):
        no_time.require_followable(ARM)
    quick = standard_path("circle-0.5s", ARM)
    with pytest.raises(InputError, match=r"at \d+\.\d\d s .* joint\d would have to turn at \d+ deg/s, 120 at most"):
        quick.require_followable(ARM)


def test_files_are_read_in_seconds_and_millimetres_and_wrong_lines_are_named(tmp_path):
    file = tmp_path / "square.csv"
    file.write_text("time,x,y,z\n0,180,0,200\n1.5,190,10,200\n3,180,0,210\n")
    path = read_path(file)
    assert path.name == "square"
    file.write_text("  \n" + file.read_text() + "\n  \n,,,\n")  # as tables leave them
    np.testing.assert_array_equal(read_path(file).place, path.place)
    assert path.duration == 3.0
    assert np.allclose(path.place[1], [0.19, 0.01, 0.2])
    for text, words in (
        ("x,y,z\n1,2,3\n", "expected 'time,x,y,z'"),
        ("time,x,y,z\n0,1,2,3\n1,a,2,3\n", "line 3"),
        ("time,x,y,z\n1,180,0,200\n0,180,0,200\n", "point 2 is not after"),
        ("time,x,y,z,roll\n0,1,2,3,4\n", "expected 'time,x,y,z'"),
        ("time,x,y,z\n0,180,0,200\n", "one point below the header, at least two"),
        ("time,x,y,z\n", "no point below the header, at least two"),
        ("", "it holds nothing, expected the header 'time,x,y,z'; name the columns so"),
        ("time;x;y;z\n0;180,5;0;200\n", "'time;x;y;z', expected 'time,x,y,z'; separate columns by commas"),
        ("t,x,y,z\n0,180,0,200\n", "the header is 't,x,y,z', expected 'time,x,y,z'; name .* in s, mm and deg$"),
        ("%time," + "field.header.seq," * 20 + "\n1,2\n", r"the header is '%time,.{,90}expected 'time,x,y,z'"),
    ):
        file.write_text(text)
        with pytest.raises(FileError, match=words):
            read_path(file)


def test_standard_paths_are_in_the_target_region_and_begin_and_end_at_rest():
    for name in STANDARD:
        path = standard_path(name, ARM)
        assert is_standard(name)
        assert ARM.targets.contains(path.place).all()
        ends = np.array([1e-6, path.duration - 1e-6])
        assert np.abs(path.velocity(ends)).max() < 2e-3
        path.require_followable(ARM)
    circle = standard_path("circle-8s", ARM)
    middle = (ARM.targets.lower + ARM.targets.upper) / 2
    assert np.allclose(np.linalg.norm(circle.place - middle, axis=1), RADIUS)
    running = np.linspace(2 * EASE, 12.0, 50)
    assert np.allclose(np.linalg.norm(circle.velocity(running), axis=1), 2 * np.pi * RADIUS / 8.0, rtol=1e-4)
    assert not is_standard("circle.csv")
    with pytest.raises(InputError, match="circle-20s"):
        standard_path("oval", ARM)


def test_postures_reach_their_places_and_depend_on_nothing_else():
    path = standard_path("random-0.5hz", ARM, seed=3)
    places = path.at(np.arange(0.0, path.duration, 0.05))[:, None]
    there = PathPostures(ARM, places[0]).along(places)
    assert np.linalg.norm(tcp_position(ARM, there[:, 0]) - places[:, 0], axis=-1).max() < 1e-5
    back = PathPostures(ARM, places[-1]).along(places[::-1])[::-1]
    assert np.abs(there - back).max() < 1e-3


def test_light_joints_are_spared():
    weights = joint_weights(ARM)
    assert (weights[:3] == 1.0).all()
    assert (weights[3:] > 1.0).all()
    _, jacobian = position_kinematics(ARM, ARM.rest)
    way = np.array([0.0, 0.01, 0.02])
    motion = spread(ARM, jacobian, way)
    assert np.allclose(jacobian @ motion, way, atol=1e-6)
    assert np.abs(motion[3:]).max() < 0.2 * np.abs(motion[:3]).max()


def test_a_path_turns_the_tool_smoothly_through_what_is_given_whatever_the_signs_of_quaternions(tmp_path):
    time = np.linspace(0.0, 4.0, 9)
    place = np.array([0.18, 0.0, 0.2]) + 0.02 * np.sin(time)[:, None] * np.array([0.0, 1.0, 0.5])
    angles = [[180.0 - 8.0 * np.sin(t), 5.0 * np.sin(2 * t), -90.0 + 6.0 * t] for t in time]
    file = tmp_path / "poses.csv"
    lines = [",".join(map(str, [t, *1e3 * p, *a])) for t, p, a in zip(time, place, angles, strict=True)]
    file.write_text("\n".join(["time,x,y,z,rx,ry,rz", *lines]))
    path = read_path(file).on(ARM)
    wanted = placed(ARM, [Pose(place_m=p, angles_rad=np.radians(a)) for p, a in zip(place, angles, strict=True)])[1]
    assert wanted.angle(path.turn_at(time).rotation).max() < 1e-6
    flipped = replace(path, quaternion=path.quaternion * np.where(np.arange(9) % 2, -1.0, 1.0)[:, None])
    fine = np.linspace(0.0, 4.0, 400)
    np.testing.assert_allclose(flipped.turn_at(fine).rotation, path.turn_at(fine).rotation, atol=1e-12)
    ways = path.turn_at(fine[1:]).angle(path.turn_at(fine[:-1]).rotation) / np.diff(fine)
    assert ways.max() < np.radians(30.0)
    path.require_followable(ARM)
    postures = PathPostures(ARM, path.at(fine[:1]), path.turn_at(fine[:1]))
    found = postures.along(path.at(fine)[:, None], path.turn_at(fine)[:, None])[:, 0]
    off, angle = missed_pose(ARM, found, path.at(fine), path.turn_at(fine))
    assert (off.max(), angle.max()) < (1e-4, np.radians(0.1))
    back = path_of(path.time, path.place, path.turn_at(path.time), "back")
    np.testing.assert_allclose(back.turn_at(fine).rotation, path.turn_at(fine).rotation, atol=1e-9)


def test_a_path_with_an_orientation_out_of_reach_is_refused_with_where(tmp_path):
    time = np.array([0.0, 3.0, 6.0])
    direction = np.array([[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [-1.0, -1.0, 0.3]])
    place = np.array([[0.18, 0.0, 0.2], [0.2, 0.03, 0.22], [0.229, 0.099, 0.249]])
    with pytest.raises(InputError, match=r"at \d\.\d\d s .* mm the tool cannot have direction .* give another"):
        Path(time=time, place=place, direction=direction).on(ARM).require_followable(ARM)
    with pytest.raises(InputError, match="none zero"):
        Path(time=time, place=place, direction=0.0 * direction)
    with pytest.raises(InputError, match="turn round between two points"):
        Path(time=time, place=place, direction=np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    file = tmp_path / "half.csv"
    file.write_text("time,x,y,z,dx,dy,dz\n0,180,0,200,0,0,-1\n1,180,0,200,,,\n")
    with pytest.raises(FileError, match="on every line or on none"):
        read_path(file)


def test_a_path_of_places_alone_asks_for_no_orientation():
    path = bent()
    assert path.on(ARM) is path
    assert path.turn_at(np.linspace(0.0, 1.0, 5)) is None
