"""Poses as targets: given in any way, reached by laws that turn the tool, refused where no posture has them."""

from dataclasses import replace

import numpy as np
import pytest

import rejoint
from hearing import Hears
from orientations import angles
from rejoint.arms import Displacement, frames, mycobot280, so101
from rejoint.arms.postures import missed_pose
from rejoint.arms.rotations import quaternion_of, rotation_of, tool_axis
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.correction import Modelled
from rejoint.control.moving.drive import Deployment
from rejoint.control.targets import Pose, in_words, placed, read_targets
from rejoint.robots import open_robot
from rejoint.system.errors import InputError
from targetdrive import deploy

ARM = mycobot280()
DOWN = "direction 0.00 0.00 -1.00"
POSES = (
    Pose(place_m=[0.18, 0.0, 0.2], angles_rad=np.radians([178.0, 4.0, -85.0])),
    Pose(place_m=[0.19, 0.03, 0.19], direction=[0.0, 0.1, -1.0]),
    Pose(place_m=[0.17, -0.02, 0.2]),
)


def test_an_orientation_is_the_same_however_it_is_given():
    angles = np.radians([170.0, 10.0, -60.0])
    (by_angles,) = placed(ARM, [Pose(place_m=[0.18, 0, 0.2], angles_rad=angles)])[1].rotation
    x, y, z = (np.array(axis, dtype=float) for axis in np.eye(3))
    turned = [
        rotation_of(np.array([np.cos(a / 2), *(np.sin(a / 2) * e)])) for a, e in zip(angles, (x, y, z), strict=True)
    ]
    np.testing.assert_allclose(by_angles, turned[2] @ turned[1] @ turned[0], atol=1e-12)  # fixed x, then y, then z
    for sign in (1.0, -3.0):
        given = Pose(place_m=[0.18, 0, 0.2], quaternion=sign * quaternion_of(by_angles))
        np.testing.assert_allclose(placed(ARM, [given])[1].rotation[0], by_angles, atol=1e-12)


@pytest.mark.parametrize("direction", [[0, 0, 2.0], [0, 0, -0.1], [1, 1, 0], [-1, 0, 0]])
@pytest.mark.parametrize("arm", [ARM, so101()])
def test_a_direction_is_where_the_tool_points(arm, direction):
    turn = placed(arm, [Pose(place_m=[0.3, 0, 0.2], direction=direction)])[1]
    np.testing.assert_allclose(turn.rotation[0] @ turn.rotation[0].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn.rotation[0]) == pytest.approx(1.0)
    wanted = np.array(direction, dtype=float)
    np.testing.assert_allclose(turn.rotation[0] @ tool_axis(arm), wanted / np.linalg.norm(wanted), atol=1e-12)


def test_targets_of_a_file_have_orientations_in_degrees_and_points_among_them(tmp_path):
    file = tmp_path / "poses.csv"
    file.write_text("X,Y,Z,dx,dy,dz,weight\n180,0,200,0,0,-5,1.0\n170,10,200,,,,\n")
    points, turns = read_targets(file, ARM)
    np.testing.assert_allclose(points, [[0.18, 0.0, 0.2], [0.17, 0.01, 0.2]])
    assert [in_words(turns[k]) for k in range(2)] == [DOWN, ""]
    assert turns.weight[0] == pytest.approx(1e-3 / np.radians(1.0))
    file.write_text("x,y,z,rx,ry,rz\n180,0,200,180,0,-90\n")
    assert in_words(read_targets(file, ARM)[1][0]) == "rx ry rz 180.0 0.0 -90.0 deg"
    file.write_text("x,y,z,qw,qx,qy,qz\n180,0,200,0,-2,0,0\n")
    assert in_words(read_targets(file, ARM)[1][0]) == "rx ry rz 180.0 0.0 0.0 deg"
    file.write_text("x,y,z\n180,0,200\n")
    assert read_targets(file, ARM)[1] is None


def test_poses_are_reached_and_points_among_them_as_ever():
    points, turns = placed(ARM, POSES)
    job = Deployment(controller="feedforward", targets=points, dwell=6.0, turns=turns)
    robot = open_robot("emulated:worn?seed=10001")
    recording, done = deploy(robot, FeedforwardController(ARM), job)
    first, second, third = done.visits
    assert max(first.turned, second.turned) < np.radians(1.5)
    assert max(visit.error for visit in done.visits) < 3e-3
    assert (third.turned, third.orientation) == (None, "")
    assert done.missed == ()
    last = [np.flatnonzero(recording.target_index[:, 0] == k)[-1] for k in range(3)]
    off, angle = missed_pose(ARM, recording.position[last, 0], points, turns)
    np.testing.assert_allclose(angle[:2], [first.turned, second.turned])
    np.testing.assert_allclose(off, [visit.error for visit in done.visits])
    assert np.isnan(recording.turned[recording.target_index == 2]).all()


def test_a_pose_is_missed_where_only_its_place_is_reached():
    points, turns = placed(ARM, POSES[:1])
    free = replace(turns, weight=np.array([1e-9]))  # asked for, and as good as not weighed
    askew = replace(free, rotation=free.rotation @ rotation_of(np.array([0.9, 0.4, 0.2, 0.0])))
    job = Deployment(controller="feedforward", targets=points, dwell=4.0, turns=askew)
    _, done = deploy(open_robot("emulated:worn?seed=10001"), FeedforwardController(ARM), job)
    assert done.visits[0].error < job.within
    assert done.missed == (1,)
    assert "deg off" in done.visits[0].remark


def test_a_calibration_turns_the_aim_back_by_what_lies_behind_the_encoders():
    known = Displacement.none(ARM)
    known = replace(known, offset=np.array([0.0, 0.02, -0.03, 0.01, 0.02, -0.01]))
    correction = Modelled(ARM, known)
    points, turns = placed(ARM, POSES[:2])
    start = np.broadcast_to(ARM.rest, (2, 6))
    aims, aimed = correction.aim(points, start, np.ones(2, dtype=bool), turn=turns)
    assert (angles(aimed, turns.rotation) > np.radians(0.3)).all()
    from rejoint.arms.postures import find_postures

    posture = find_postures(ARM, aims, start, aimed)
    really = frames(known.moved(ARM), known.joints(ARM, posture))
    np.testing.assert_allclose(really.tcp_position, points, atol=2e-4)
    assert (angles(turns, really.tcp_rotation) < np.radians(0.05)).all()


def test_who_turns_no_tool_leaves_poses_to_the_feedforward():
    said = []
    settings = rejoint.Settings(controller="shelf", dwell=3.0)
    done = rejoint.deploy("emulated:worn", POSES[:1], settings=settings, observer=Hears(message=said.append))
    assert done.controller == "feedforward"
    assert any("shelf does not turn the tool" in line for line in said)
    with pytest.raises(InputError, match="camera"):
        rejoint.deploy("emulated:worn", list(POSES), settings=rejoint.Settings(eye="emulated"))
